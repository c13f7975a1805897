"""One iteration of training: play a batch of episodes, judge every decision, improve actor and critic."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from learned.teacher import ppo
from learned.teacher.actors.critic import CentralCritic
from learned.teacher.actors.magnnet import MagnnetActor
from learned.teacher.actors.policy import TeacherActor
from learned.teacher.episodes import Moment, play
from learned.teacher.problems import Problems
from learned.teacher.training.settings import AllocatorTrainingSettings

__all__ = ["IterationFigures", "PPOLearner"]


@dataclass(frozen=True)
class IterationFigures:
    """Figures of one iteration.

    Attributes:
        episode_return: Mean return of the episodes.
        num_steps: Mean steps of an episode.
        entropy: Mean entropy of the decisions between two actions or more, nats.
        policy_loss: Mean clipped surrogate loss.
        value_loss: Mean loss of the critic.
        explained: Share of the returns' variance that the critic explained.
        divergence: Mean approximate Kullback-Leibler divergence from the policy that acted.
    """

    episode_return: float
    num_steps: float
    entropy: float
    policy_loss: float
    value_loss: float
    explained: float
    divergence: float


@dataclass(frozen=True, eq=False)
class _Batch:
    """Episodes with what is to be learned from them; lists are by step, entries as in `Moment`."""

    moments: list[Moment]
    advantages: list[Tensor]
    returns: list[Tensor]


class PPOLearner:
    """Actor, critic and their optimiser.

    Args:
        actor: A `TeacherActor` or `MagnnetActor`.
        critic: The central critic.
        settings: How to train.
        generator: Of everything random.
    """

    def __init__(
        self,
        actor: TeacherActor | MagnnetActor,
        critic: CentralCritic,
        settings: AllocatorTrainingSettings,
        generator: torch.Generator,
    ) -> None:
        self.actor, self.critic, self.settings, self.generator = actor, critic, settings, generator
        self.parameters = [*actor.parameters(), *critic.parameters()]
        self.optimiser = torch.optim.Adam(self.parameters, lr=settings.learning_rate, eps=1e-5)

    def iterate(self, problems: Problems, share_left: float) -> IterationFigures:
        """Learn from one batch of problems.

        Args:
            problems: The fleets to play.
            share_left: Of the training that is still to come, 1 to 0: learning rate and entropy bonus fall with it.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * share_left
        batch, figures = self._collect(problems)
        sums = torch.zeros(4)
        count = 0
        for _ in range(self.settings.num_epochs):
            for rows in torch.randperm(len(problems), generator=self.generator).chunk(self.settings.num_minibatches):
                sums += self._update(batch, rows.sort().values, self.settings.entropy_bonus * share_left)
                count += 1
        means = (sums / count).tolist()
        return IterationFigures(*figures[:2], means[2], means[0], means[1], figures[2], means[3])

    def _collect(self, problems: Problems) -> tuple[_Batch, tuple[float, float, float]]:
        with torch.no_grad():
            slots, step_cost = self.settings.slots, self.settings.step_cost
            moments = list(play(self.actor, problems, generator=self.generator, slots=slots, step_cost=step_cost))
            shape = len(moments), len(problems)
            rewards, values = torch.zeros(shape), torch.zeros(shape)
            active = torch.zeros(shape, dtype=torch.bool)
            for k, moment in enumerate(moments):
                rewards[k, moment.rows] = moment.outcome.reward
                values[k, moment.rows] = self.critic(moment.observed, moment.memory, moment.num_to_serve)
                active[k, moment.rows] = True
        advantages, returns = ppo.generalised_advantages(rewards, values, active, discount=1.0, trace=self.settings.trace)
        spread = ppo.normalised(advantages[active])
        advantages = advantages.masked_scatter(active, spread)
        variance = returns[active].var(unbiased=False)
        explained = 1.0 - (returns - values)[active].var(unbiased=False) / variance.clamp(min=1e-12)
        rows = [moment.rows for moment in moments]
        batch = _Batch(moments, [advantages[k, r] for k, r in enumerate(rows)], [returns[k, r] for k, r in enumerate(rows)])
        return batch, (float(rewards.sum(0).mean()), float(active.sum(0).float().mean()), float(explained))

    def _update(self, batch: _Batch, rows: Tensor, entropy_bonus: float) -> Tensor:
        """One step of the optimiser on some episodes, through all their steps; the figures of it."""
        log_probs, old, advantages, entropies, values, returns = self._replay(batch, rows)
        policy = ppo.clipped_policy_loss(log_probs, old, advantages, self.settings.clip)
        value = ppo.value_loss(values, returns)
        surprise = entropies.mean()
        loss = policy + self.settings.value_weight * value - entropy_bonus * surprise
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.parameters, self.settings.most_gradient)
        self.optimiser.step()
        # the second-order estimate of KL(old || new): never negative, and of little variance
        divergence = (log_probs.detach() - old).square().mean() / 2
        return torch.stack([policy.detach(), value.detach(), surprise.detach(), divergence])

    def _replay(self, batch: _Batch, rows: Tensor) -> list[Tensor]:
        """Decide again with the present weights, memories included; entries of all steps in a row.

        Of the decisions only those between two actions or more count: log-probabilities, the old ones, advantages and
        entropies (K,), then values and returns (L,) of all steps.
        """
        parts: list[tuple[Tensor, ...]] = []
        here = rows
        memory = torch.zeros(len(rows), batch.moments[0].actions.shape[1], self.actor.memory_width)
        for moment, advantage, returns in zip(batch.moments, batch.advantages, batch.returns, strict=True):
            runs = torch.isin(here, moment.rows)
            here, memory = here[runs], memory[runs]
            if not len(here):
                break
            at = torch.searchsorted(moment.rows, here)
            observed = moment.observed[at]
            scores, memory = self.actor(observed, memory)
            log_probs = ppo.masked_log_softmax(scores, observed.allowed)
            value = self.critic(observed, memory.detach(), moment.num_to_serve[at])
            free = observed.allowed.sum(dim=2) > 1  # (R, N)
            chosen = log_probs.gather(2, moment.actions[at][..., None])[..., 0]
            spread = advantage[at][:, None].expand_as(chosen)
            parts.append(
                (chosen[free], moment.log_probs[at][free], spread[free], ppo.entropy(log_probs)[free], value, returns[at])
            )
        return [torch.cat(column) for column in zip(*parts, strict=True)]
