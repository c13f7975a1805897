"""What the network of timed flights minimises: first the distance to the teacher's stages, then the cost itself.

The cost is that of `flockopt.flights.smoothing.smooth`: shares of duration and squared jerk, after the stage has been slowed
until it keeps its limits, and a penalty on what would have it refused: too near to obstacles, out of bounds, slower than
before.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from flockopt.flights.smoothing.improve import JERK_WEIGHT, TIME_WEIGHT
from learned.networks.diffusion import add_noise
from learned.networks.obstacle_distance import signed_distance
from learned.smoother.batch import StageBatch
from learned.smoother.features import stage_features
from learned.smoother.frame import bernstein, control_points, flat_frames, free, residuals, squared_jerk
from learned.smoother.model import TimedNetwork
from learned.smoother.spline import slowing

__all__ = ["TimedLoss", "Verdict", "imitation_loss", "stage_cost", "verdicts"]

#: Parts of a piece that room is looked at in: anywhere within each while training, in their middles otherwise.
ROOM_PARTS = 10

#: Weights of an intrusion by one unit at the worst place and on the average, of what pieces exceed their limits by on the
#: average, and of taking longer than `LONGEST`.
WORST_WEIGHT, MEAN_WEIGHT, OVER_WEIGHT, SLOWER_WEIGHT = 6.0, 20.0, 2.0, 8.0

#: A stage may not take longer than it was given; this share of that is what it is to keep to.
LONGEST = 0.996

#: Residuals farther off than this many spreads count linearly.
HUBER = 3.0


@dataclass(frozen=True)
class Verdict:
    """What would become of a stage.

    Attributes:
        cost: (B,) as a share of the given stage's.
        time: (B,) as a share of the given stage's.
        over: (B, P) how much slower than it is every piece has to be flown to keep its limits, as a share.
        intrusion: (B, P, Q) how much nearer to an obstacle or farther out of bounds it is than it may be, units.
    """

    cost: Tensor
    time: Tensor
    over: Tensor
    intrusion: Tensor

    @property
    def accepted(self) -> Tensor:
        """(B,) bool: cheaper, no slower, and clear where it was looked at."""
        return (self.cost < 1.0) & (self.time <= 1.0) & (self.intrusion.amax(dim=(1, 2)) <= 0.0)

    @property
    def penalty(self) -> Tensor:
        """(B,) for what would have the stage refused."""
        worst = self.intrusion.amax(dim=(1, 2))
        limits = OVER_WEIGHT * self.over.mean(dim=1) + SLOWER_WEIGHT * torch.relu(self.time - LONGEST)
        return WORST_WEIGHT * worst + MEAN_WEIGHT * self.intrusion.mean(dim=(1, 2)) + limits


def imitation_loss(clean: Tensor, target: Tensor, chosen: Tensor) -> Tensor:
    """Huber's loss between residuals (B, J, 10) in units of their spread, a mean over those that are chosen freely."""
    losses = nn.functional.huber_loss(clean, target, reduction="none", delta=HUBER)
    return (losses * chosen).sum() / chosen.sum().clamp(min=1.0)


def intrusions(control: Tensor, batch: StageBatch, need: Tensor, offsets: Tensor) -> Tensor:
    """(B, P, Q): how much nearer to an obstacle than ``need`` (B,), or out of bounds, the curve is; 0 where it is not."""
    phases = (torch.arange(ROOM_PARTS, device=control.device) + offsets) / ROOM_PARTS  # (Q,)
    points = torch.einsum("qi,bpia->bpqa", bernstein(phases, 5), control)
    gaps = signed_distance(batch.obstacles[:, :, None], points[..., None, :]).amin(dim=-1)
    lower, upper = (batch.bounds[:, side, None, None] for side in (0, 1))
    outside = torch.maximum(lower - points, points - upper).amax(dim=-1)
    return (torch.relu(need[:, None, None] - gaps) + torch.relu(outside)) * batch.pieces[..., None]


def verdicts(
    batch: StageBatch, states: Tensor, durations: Tensor, extra: Tensor, generator: torch.Generator | None = None
) -> Verdict:
    """What would become of stages with these states (B, J, 3, 3) and durations (B, P).

    Args:
        batch: What was given.
        states: In the drones' units.
        durations: In the drones' units.
        extra: (B,) room to keep beyond ``batch.need``.
        generator: Where room is looked at, at random; in the middle of parts without one.
    """
    control = control_points(states, durations)
    factors = slowing(control, durations, batch)
    slower = factors.amax(dim=1).clamp(min=1.0)
    given = squared_jerk(batch.states, batch.durations, batch.pieces).clamp(min=1e-9)
    # slowed down as a whole: jerk falls by the cube, its square by the sixth power, and the time to integrate over grows
    jerk = squared_jerk(states, durations, batch.pieces) / slower**5 / given
    total = (durations * batch.pieces).sum(dim=1) * slower
    time = total / (batch.durations * batch.pieces).sum(dim=1)
    offsets = torch.full((ROOM_PARTS,), 0.5) if generator is None else torch.rand(ROOM_PARTS, generator=generator)
    room = intrusions(control, batch, batch.need + extra, offsets.to(control.device))
    return Verdict(TIME_WEIGHT * time + JERK_WEIGHT * jerk, time, torch.relu(factors - 1.0), room)


def stage_cost(verdict: Verdict) -> Tensor:
    """The mean of cost and penalty; what a stage could cost beyond twice the given cost does not count."""
    return (verdict.cost.clamp(max=2.0) + 0.02 * verdict.cost.clamp(2.0, 50.0) + verdict.penalty).mean()


class TimedLoss(nn.Module):
    """The whole loss."""

    def __init__(self, network: TimedNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, batch: StageBatch, imitation: float, cost: float, room_m: float, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms by name.

        Args:
            batch: Stages with their teacher's.
            imitation: Weight of the distance to the teacher.
            cost: Weight of the cost.
            room_m: Where it is the cost that counts, extra room is asked for, up to this much, metres.
            generator: Of noise, its levels, and extra room, on the CPU.
        """
        network, device = self.network, batch.states.device
        frames, chosen = flat_frames(batch), free(batch)
        room = torch.rand(len(batch.need), generator=generator).to(device) * room_m / batch.length_m
        extra = room if cost > 0.0 else torch.zeros_like(room)
        target = residuals(batch, frames) / network.spread
        levels = network.settings.num_noise_levels
        level, noisy = torch.full((len(extra),), levels, device=device), torch.zeros_like(target)
        if network.settings.mode == "diffusion":
            noise = torch.randn(target.shape, generator=generator).to(device)
            level = torch.randint(1, levels + 1, (len(extra),), generator=generator).to(device)
            noisy = add_noise(target, noise, level, levels) * chosen
        clean = network(noisy, level, stage_features(batch, frames, extra), batch.joints).float() * chosen
        terms = {}
        if imitation > 0.0:
            terms["imitation"] = imitation * imitation_loss(clean, target, chosen)
        if cost > 0.0:
            states, durations = network.decoded(batch, frames, clean * network.spread)
            terms["cost"] = cost * stage_cost(verdicts(batch, states, durations, extra, generator))
        return torch.stack(list(terms.values())).sum(), {name: term.detach() for name, term in terms.items()}
