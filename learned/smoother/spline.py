"""The smoothest stages near what the network asks for: a linear problem for given durations, solved exactly.

How much a joint's state costs in jerk depends on the fifth power of how short its pieces are, so that small errors of a network
in states make large ones in jerk. Therefore the network's states are wishes: of all chains of quintics with its durations,
the one is flown that minimises the squared jerk's integral, as a share of the given stage's, and the squared distance to the
wishes. Ends, positions at tasks and the places that pieces pass inside are held. For given durations this is linear least
squares (minimum-jerk splines, after Richter, Bry and Roy 2016), the same matrix for each axis, and differentiable.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flockopt.flights.smoothing.stages import hermite
from learned.demonstrations.timed_shards import NO_PHASE
from learned.smoother.batch import StageBatch
from learned.smoother.frame import at_phase, bernstein, control_points, quadratic_products, squared_jerk

__all__ = ["WISHES", "flyable", "slowing", "smoothest"]

#: Weights of the squared distance to wished positions, velocities and accelerations, in the drone's units, against the squared
#: jerk as a share of the given.
WISHES = (10.0, 3.0, 0.3)

#: Phases of a piece at which limits are looked at.
LIMIT_PHASES = 9

#: How often pieces that exceed their limits get more time, and how much more at a time at the most.
RETIMINGS, MOST_MORE = 3, 1.3

#: Weight of what is held.
HELD = 1e7


def smoothest(batch: StageBatch, wished: Tensor, durations: Tensor, weights: Tensor) -> Tensor:
    """States (B, J, 3, 3) of the smoothest chain near what is wished.

    Args:
        batch: The given stages.
        wished: (B, J, 3, 3) states.
        durations: (B, P).
        weights: (B, J, 3) of wished positions, velocities and accelerations, > 0.

    Returns:
        The states; NaN for stages whose wishes or durations are not finite.
    """
    exact = wished.double()
    times = torch.where(batch.pieces, durations.double(), 1.0)
    jerk = squared_jerk(batch.states.double(), batch.durations.double(), batch.pieces).clamp(min=1e-9)
    held = _held(batch)
    # The normal equations of weighted least squares. What is held is a wish as well, of so great a weight that it gives way
    # by less than single precision shows: the matrix stays positive definite, and one Cholesky factor serves all axes.
    pull = torch.where(held, HELD, weights.double())  # (B, J, 3)
    target = torch.where(held[..., None], batch.states.double(), exact)
    matrix = _assembled(_jerk_form(times) * (batch.pieces / jerk[:, None])[..., None, None])
    matrix = matrix + torch.diag_embed(pull.flatten(1))
    right = (pull[..., None] * target).flatten(1, 2)  # (B, 3 J, 3)
    rows, passing = _passing(batch, times)
    places = at_phase(batch.states, batch.durations, batch.phases).double()
    matrix = matrix + HELD * _assembled(rows[..., :, None] * rows[..., None, :] * passing[..., None, None])
    right = right + HELD * _scattered(rows * passing[..., None], places)
    factor, failed = torch.linalg.cholesky_ex(matrix)  # NaN must not raise: whoever proposed it is left alone with it
    factor = torch.where(failed[:, None, None] > 0, torch.nan, factor)
    return torch.cholesky_solve(right, factor).unflatten(1, (-1, 3)).to(wished.dtype)


def flyable(
    batch: StageBatch, wished: Tensor, durations: Tensor, weights: Tensor, retimings: int = RETIMINGS
) -> tuple[Tensor, Tensor]:
    """States and durations (B, P) of the smoothest chain near what is wished, more time being given where limits ask for it.

    What is still exceeded afterwards is for the whole stage to be flown slower.
    """
    states = smoothest(batch, wished, durations, weights)
    for _ in range(retimings):
        factors = slowing(control_points(states, durations), durations, batch)
        durations = durations * factors.clamp(1.0, MOST_MORE)
        states = smoothest(batch, wished, durations, weights)
    return states, durations


def slowing(control: Tensor, durations: Tensor, batch: StageBatch) -> Tensor:
    """(B, P): how many times slower each piece has to be flown to keep its limits; below 1 where there is time to spare."""
    phases = torch.linspace(0.0, 1.0, LIMIT_PHASES, device=control.device)
    factors = []
    # Flown k times slower, a derivative of order n falls by k^n: so its excess asks for the n-th root of it.
    for order, limit in ((1, 1.0), (2, 1.0), (3, batch.max_jerk[:, None])):
        scale = float((5, 20, 60)[order - 1]) / durations**order
        curve = torch.einsum("qi,bpia->bpqa", bernstein(phases, 5 - order), control.diff(n=order, dim=2))
        norms = (curve.square().sum(dim=-1) + 1e-12).sqrt() * (scale * batch.pieces)[..., None]
        factors.append((norms.amax(dim=2) / limit).clamp(min=1e-3) ** (1.0 / order))
    return torch.stack(factors).amax(dim=0)


def _held(batch: StageBatch) -> Tensor:
    """(B, J, 3) bool: of which joints position, velocity and acceleration stay what they are."""
    ends = (~batch.inner)[..., None].expand(-1, -1, 3)
    at_tasks = batch.anchored[..., None] & torch.tensor([True, False, False], device=ends.device)
    return ends | at_tasks


def _local_powers(times: Tensor) -> Tensor:
    """(B, P, 6): what (p, v, a, p, v, a) at a piece's ends are multiplied by to be per piece."""
    return times[..., None] ** torch.tensor([0, 1, 2, 0, 1, 2], device=times.device)


def _to_control(times: Tensor) -> Tensor:
    """(6, 6): control points from the scaled states at both ends."""
    begin, end = (torch.from_numpy(part).to(times) for part in hermite())
    return torch.cat([begin, end], dim=1)


def _jerk_form(times: Tensor) -> Tensor:
    """(B, P, 6, 6): the squared jerk's integral over a piece as a form of the states at its ends."""
    third = 60.0 * _to_control(times).diff(n=3, dim=0)  # (3, 6), see `learned.smoother.frame.squared_jerk`
    powers = _local_powers(times)
    return (
        third.T @ quadratic_products(times) @ third * powers[..., :, None] * powers[..., None, :] / times[..., None, None] ** 5
    )


def _passing(batch: StageBatch, times: Tensor) -> tuple[Tensor, Tensor]:
    """(B, P, 6) of the states at a piece's ends in where it is at its task's phase; (B, P) which pieces pass one."""
    basis = bernstein(batch.phases.clamp(0.0, 1.0).double(), 5)
    return basis @ _to_control(times) * _local_powers(times), ((batch.phases != NO_PHASE) & batch.pieces).double()


def _assembled(blocks: Tensor) -> Tensor:
    """(B, 3 J, 3 J): blocks (B, P, 6, 6) of neighbouring joints added up."""
    batch, num_pieces = blocks.shape[:2]
    size = 3 * (num_pieces + 1)
    at = 3 * torch.arange(num_pieces, device=blocks.device)[:, None] + torch.arange(6, device=blocks.device)  # (P, 6)
    places = (at[:, :, None] * size + at[:, None, :]).flatten()
    return blocks.new_zeros(batch, size * size).index_add(1, places, blocks.flatten(1)).view(batch, size, size)


def _scattered(rows: Tensor, places: Tensor) -> Tensor:
    """(B, 3 J, 3): rows (B, P, 6) times places (B, P, 3), added up at the joints."""
    batch, num_pieces = rows.shape[:2]
    at = 3 * torch.arange(num_pieces, device=rows.device)[:, None] + torch.arange(6, device=rows.device)
    products = (rows[..., None] * places[:, :, None]).flatten(1, 2)  # (B, 6 P, 3)
    return rows.new_zeros(batch, 3 * (num_pieces + 1), 3).index_add(1, at.flatten(), products)
