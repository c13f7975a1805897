"""What the student minimises: the paper's two terms, and in fine-tuning a penalty on ways that come too near."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from flockopt.errors import SettingsError
from flockopt.records import checks
from learned.networks.diffusion import add_noise, ddim_step, noise_levels, signal_levels
from learned.networks.obstacle_distance import signed_distance
from learned.student.network.denoiser import Conditions
from learned.student.network.model import Student
from learned.student.network.scene_encoder import SceneTokens
from learned.student.scenes.batch import NOTHING, FleetBatch, WayBatch

__all__ = ["LossWeights", "StudentLoss", "allocation_loss", "clearance_loss", "detour_weights", "diffusion_loss"]

#: The room that the penalty asks for beyond what is required, as a share of radius + clearance.
MARGIN = 0.3

#: Steps of DDIM that are trained for: this share of the noise levels are those that so many steps pass.
TRAINED_STEPS, TRAINED_STEPS_SHARE = 2, 0.5

#: In fine-tuning, the weight of the squared error where the student goes on from what it drew itself: which way it took
#: is its own choice then, and need not be the demonstrated one.
OWN_WEIGHT = 0.1

#: One drone in so many goes on from its own in fine-tuning.
OWN_PART = 4

#: Numbers of drones are filled up to multiples of this, so that few shapes of tensors occur.
ROWS_STEP = 32


def allocation_loss(log_probs: Tensor, assignment: Tensor, teaches: Tensor) -> Tensor:
    """The paper's L_alloc: cross-entropy (B, M, N) against drones (B, M), a mean over tasks of scenes (B,) that teach."""
    counted = (assignment != NOTHING) & teaches[:, None]
    picked = log_probs.gather(2, assignment.clamp(min=0)[..., None])[..., 0]
    return -torch.where(counted, picked, torch.zeros_like(picked)).sum() / counted.sum().clamp(min=1)


def diffusion_loss(denoised: Tensor, clean: Tensor, weights: Tensor) -> Tensor:
    """The paper's L_diff: squared error (B, N, T, 3) summed over xyz, a mean over samples of active drones.

    ``weights`` (B, N) are m in the paper: 1 for active drones, 0 for others; values between count as much.
    """
    squares = (denoised - clean).square().sum(dim=-1).mean(dim=-1)  # (B, N)
    total = weights.sum()
    return (squares * weights).sum() / torch.where(total > 0, total, torch.ones_like(total))


def detour_weights(clean: Tensor, active: Tensor) -> Tensor:
    """(B, N): less weight for wide detours (B, N, T, 3), whose errors would drown those of near misses."""
    return active / (1.0 + clean.square().mean(dim=(2, 3)))


def clearance_loss(ways: WayBatch, points: Tensor) -> Tensor:
    """How far points (B, N, T, 3) m and the middles between them intrude on the room they should keep.

    Intrusions are squared, in units of radius + clearance, and averaged over samples of blocked legs.
    """
    middles = (points[:, :, 1:] + points[:, :, :-1]) / 2
    blocked = ways.blocked & ways.active[..., None]
    where = torch.cat([blocked, blocked[:, :, 1:]], dim=2)  # (B, N, 2 T - 1); a middle counts to the later sample's leg
    dense = torch.cat([points, middles], dim=2)
    gaps = signed_distance(ways.obstacles[:, None, None], dense[..., None, :]).amin(dim=-1)
    need = ways.needs[..., None]
    outside = torch.maximum(ways.lower[:, None, None] - dense, dense - ways.upper[:, None, None]).amax(dim=-1)
    intrusion = torch.relu((1.0 + MARGIN) - gaps / need) + torch.relu(outside / need)
    return (intrusion.square() * where).sum() / where.sum().clamp(min=1)


@dataclass(frozen=True)
class LossWeights:
    """The paper's lambdas, and that of the clearance penalty."""

    allocation: float = 1.0
    diffusion: float = 1.0
    clearance: float = 0.0

    def __post_init__(self) -> None:
        checks.store(self, checks.number, SettingsError, "allocation", "diffusion", "clearance", least=0.0)


class StudentLoss(nn.Module):
    """The whole loss as one module, so that it can be trained in parallel.

    A student without fleet attention learns from the drones whose straight way is blocked: the others have nothing
    to draw, and at inference they are not asked.
    """

    def __init__(self, student: Student) -> None:
        super().__init__()
        self.student = student

    def forward(self, batch: FleetBatch, weights: LossWeights, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms by name. Noise and its levels come from ``generator``, on the CPU."""
        student = self.student
        tokens = student.encoder(batch)
        log_probs = student.allocate(batch, tokens)
        terms = {"allocation": allocation_loss(log_probs, batch.assignment, batch.teaches_allocation)}
        ways, conditions = self._ways(batch, tokens)
        clean = student.clean_samples(ways)
        noisy, level = self._noised(clean, generator)
        weights_of_drones = detour_weights(clean, ways.active) if student.settings.frame == "leg" else ways.active.float()
        if weights.clearance > 0.0 and self._draws_alone and student.settings.objective == "diffusion":
            own = len(clean) // OWN_PART
            noisy[:own], level[:own] = self._own(noisy[:own], conditions.rows(slice(own)), generator)
            weights_of_drones = torch.cat([OWN_WEIGHT * weights_of_drones[:own], weights_of_drones[own:]])
        denoised = student.denoiser(noisy, level, conditions).float()
        terms["diffusion"] = diffusion_loss(denoised, clean, weights_of_drones)
        if weights.clearance > 0.0:
            terms["clearance"] = clearance_loss(ways, student.points(ways, denoised))
        return sum(getattr(weights, name) * term for name, term in terms.items()), {
            name: term.detach() for name, term in terms.items()
        }

    @property
    def _draws_alone(self) -> bool:
        return not self.student.settings.fleet_attention

    def _ways(self, batch: FleetBatch, tokens: SceneTokens) -> tuple[WayBatch, Conditions]:
        """What is learned from: whole fleets, or blocked drones, their number filled up by inactive ones to a round one."""
        if not self._draws_alone:
            return self.student.condition(batch, None, tokens)
        places = (batch.ways.active & batch.ways.blocked.any(dim=-1)).nonzero()  # (R, 2)
        count = len(places)
        filled = torch.nn.functional.pad(places, (0, 0, 0, -count % ROWS_STEP))
        ways, conditions = self.student.condition(batch, (filled[:, 0], filled[:, 1]), tokens)
        is_there = torch.arange(len(filled), device=places.device)[:, None] < count
        return replace(ways, active=ways.active & is_there), conditions

    def _noised(self, clean: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Clean samples (B, N, T, 3) with noise, and its levels (B,): any, or one that `TRAINED_STEPS` of DDIM pass."""
        num_levels, count = self.student.settings.num_noise_levels, len(clean)
        noise = torch.randn(clean.shape, generator=generator).to(clean.device)
        if self.student.settings.objective == "regression":
            return torch.zeros_like(clean), torch.full((count,), num_levels, device=clean.device)
        # few steps are asked for at inference: half of the draws are of the levels that these pass
        passed = torch.tensor(noise_levels(TRAINED_STEPS, num_levels)[:-1])
        level = torch.randint(1, num_levels + 1, (count,), generator=generator)
        chosen = passed[torch.randint(len(passed), (count,), generator=generator)]
        is_passed = torch.rand(count, generator=generator) < TRAINED_STEPS_SHARE
        level = torch.where(is_passed, chosen, level).to(clean.device)
        return add_noise(clean, noise, level, num_levels), level

    @torch.no_grad()
    def _own(self, noisy: Tensor, conditions: Conditions, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Samples as DDIM passes them at its last level, made of noise by the student itself; and that level (R,)."""
        num_levels = self.student.settings.num_noise_levels
        first, last = noise_levels(TRAINED_STEPS, num_levels)[-3:-1]
        noise = torch.randn(noisy.shape, generator=generator).to(noisy.device)
        level = torch.full((len(noise),), first, device=noise.device)
        clean = self.student.denoiser(noise, level, conditions).float()
        signal = signal_levels(num_levels).tolist()
        return ddim_step(noise, clean, signal[first], signal[last]), torch.full_like(level, last)
