"""Stages as tensors, the smoothest chain near what is wished, the cost, and the network of timed flights."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from flockopt.flights.smoothing.stages import Stage  # noqa: E402 - torch may be missing
from learned.demonstrations.timed_shards import NO_PHASE, StageRecord  # noqa: E402
from learned.smoother.batch import collate_stages, unit_stage  # noqa: E402
from learned.smoother.frame import (  # noqa: E402
    at_phase,
    control_points,
    flat_frames,
    free,
    into_frames,
    out_of_frames,
    residuals,
    squared_jerk,
    states_of,
)
from learned.smoother.loss import TimedLoss, intrusions, verdicts  # noqa: E402
from learned.smoother.model import TimedNetwork  # noqa: E402
from learned.smoother.settings import TimedNetworkSettings  # noqa: E402
from learned.smoother.spline import smoothest  # noqa: E402
from tests.timed_stages import records  # noqa: E402

TINY = TimedNetworkSettings(width=32, blocks=1, heads=2)


@pytest.fixture(scope="module")
def some():
    return records("corridor", seed=1) + records("city", seed=2)


@pytest.fixture(scope="module")
def batch(some):
    return collate_stages([unit_stage(record) for record in some])


@pytest.fixture
def network():
    torch.manual_seed(0)
    network = TimedNetwork(TINY).eval()
    network.spread.fill_(0.1)
    torch.nn.init.normal_(network.joint_out.weight, std=0.3)
    return network


def none(batch):
    return torch.zeros_like(batch.need)


def test_shapes_and_masks(batch, some):
    assert batch.states.shape == (len(some), max(len(record.states) for record in some), 3, 3)
    assert batch.inner.sum() == sum(len(record.states) - 2 for record in some)
    chosen = free(batch)
    assert float(chosen[:, 0, :9].abs().max()) == 0.0
    assert float(chosen[..., 9].sum()) == sum(len(record.durations) for record in some)


def test_control_points_and_jerk_are_those_of_stages(batch, some):
    control, jerk = control_points(batch.states, batch.durations), squared_jerk(batch.states, batch.durations, batch.pieces)
    for row, record in enumerate(some):
        stage = Stage(record.durations, record.states, ())
        time = record.limits[0] / record.limits[1]
        length = float(batch.length_m[row])
        given = control[row, : len(stage.durations)].numpy() * length + record.states[0, 0]
        np.testing.assert_allclose(given.transpose(0, 2, 1), stage.control, atol=1e-4)
        assert float(jerk[row]) * length**2 / time**5 == pytest.approx(stage.squared_jerk, rel=1e-2)


def test_frames_and_residuals_go_there_and_back(batch):
    frames = flat_frames(batch)
    torch.testing.assert_close(out_of_frames(frames, into_frames(frames, batch.states)), batch.states, atol=1e-5, rtol=0.0)
    generator = torch.Generator().manual_seed(0)
    changes = 0.1 * torch.randn(*batch.joints.shape, 10, generator=generator) * free(batch)
    states, durations = states_of(batch, frames, changes)
    taught = dataclasses.replace(batch, teacher_states=states, teacher_durations=durations)
    torch.testing.assert_close(residuals(taught, frames), changes, atol=1e-4, rtol=0.0)


def test_the_smoothest_chain_keeps_ends_and_tasks_and_costs_less_jerk(batch):
    states = smoothest(batch, batch.states, batch.durations, torch.tensor([10.0, 3.0, 0.3]).expand(*batch.joints.shape, 3))
    for part in (states[:, 0], states[torch.arange(len(states)), batch.joints.sum(dim=1) - 1]):
        assert bool(torch.isfinite(part).all())
    torch.testing.assert_close(states[:, 0], batch.states[:, 0], atol=1e-4, rtol=0.0)
    passes = (batch.phases != NO_PHASE) & batch.pieces
    assert bool(passes.any())
    before, after = (at_phase(each, batch.durations, batch.phases)[passes] for each in (batch.states, states))
    torch.testing.assert_close(after, before, atol=1e-3, rtol=0.0)
    jerks = [squared_jerk(each, batch.durations, batch.pieces) for each in (batch.states, states)]
    assert bool((jerks[1] <= jerks[0] * 1.001).all())
    assert float((jerks[1] / jerks[0]).median()) < 0.9


def test_strong_wishes_are_flown_as_they_are(batch):
    wished = batch.states + 0.01 * batch.inner[..., None, None] * ~batch.anchored[..., None, None]
    batch = dataclasses.replace(batch, phases=torch.full_like(batch.phases, NO_PHASE))
    states = smoothest(batch, wished, batch.durations, torch.full((*batch.joints.shape, 3), 1e6))
    torch.testing.assert_close(states[batch.joints], wished[batch.joints], atol=1e-3, rtol=0.0)


def test_verdict_on_stages_as_they_are_and_on_worse_ones(batch):
    given = verdicts(batch, batch.states, batch.durations, none(batch))
    torch.testing.assert_close(given.cost, torch.ones_like(given.cost), atol=0.1, rtol=0.0)
    assert float(given.intrusion.max()) < 1e-3
    slow = verdicts(batch, batch.states * torch.tensor([1.0, 0.5, 0.25])[:, None], 2.0 * batch.durations, none(batch))
    torch.testing.assert_close(slow.time, torch.full_like(slow.time, 2.0), atol=0.05, rtol=0.0)
    assert not bool(slow.accepted.any())
    below = batch.states.clone()
    below[:, :, 0, 2] -= 100.0
    assert not bool(verdicts(batch, below, batch.durations, none(batch)).accepted.any())


def test_intrusion_into_a_ball_by_hand():
    ball = np.array([[2.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 1.0, 0.0]])
    states = np.zeros((2, 3, 3))
    states[:, 0, 0] = -1.0, 1.0  # through the middle of a ball of radius 0.5 about the origin
    record = StageRecord(
        ball, np.array([[-9.0] * 3, [9.0] * 3]), 0.2, np.array([1.0, 1.0, 1.0]), states, np.array([4.0]),
        np.array([NO_PHASE]), np.zeros(2, dtype=bool),
    )  # fmt: skip
    batch = collate_stages([unit_stage(record)])
    found = intrusions(control_points(batch.states, batch.durations), batch, batch.need, torch.full((10,), 0.5))
    phases = (torch.arange(10) + 0.5) / 10
    along = -1.0 + 2.0 * phases**3 * (10.0 - 15.0 * phases + 6.0 * phases**2)
    torch.testing.assert_close(found[0, 0], torch.relu(0.7 - along.abs()), atol=1e-4, rtol=0.0)


def test_padding_and_company_change_nothing(some, network):
    together = collate_stages([unit_stage(record) for record in some])
    with torch.inference_mode():
        states, durations = network.propose(together, none(together))
        for row in (0, len(some) - 1):
            alone = collate_stages([unit_stage(some[row])])
            own, times = network.propose(alone, none(alone))
            torch.testing.assert_close(states[row, : own.shape[1]], own[0], atol=2e-3, rtol=0.0)
            torch.testing.assert_close(durations[row, : times.shape[1]], times[0], atol=2e-3, rtol=0.0)


def test_stages_in_another_order_are_answered_in_that_order(batch, network):
    order = torch.randperm(len(batch.need), generator=torch.Generator().manual_seed(1))
    fields = {field.name: getattr(batch, field.name)[order] for field in dataclasses.fields(batch)}
    shuffled = dataclasses.replace(batch, **fields)
    with torch.inference_mode():
        states, _ = network.propose(batch, none(batch))
        again, _ = network.propose(shuffled, none(shuffled))
    torch.testing.assert_close(again, states[order], atol=2e-3, rtol=0.0)


def turned(record, angle):
    """A record turned about the vertical; its bounds are wide enough not to matter."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    table = record.obstacles.copy()
    table[:, 1:4] = table[:, 1:4] @ turn.T
    table[:, 7:9] = table[:, 7:9] @ turn[:2, :2].T
    return dataclasses.replace(record, states=record.states @ turn.T, obstacles=table)


def test_a_turned_scene_turns_the_answer(some, network):
    wide = np.array([[-1e3] * 3, [1e3] * 3])
    plain = [dataclasses.replace(record, bounds=wide) for record in some]
    angle = 0.7
    batches = [collate_stages([unit_stage(each) for each in group]) for group in (plain, [turned(p, angle) for p in plain])]
    with torch.inference_mode():
        (states, durations), (others, times) = (network.propose(each, none(each)) for each in batches)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float32)
    torch.testing.assert_close(others, states @ turn.T, atol=5e-3, rtol=0.0)
    torch.testing.assert_close(times, durations, atol=2e-3, rtol=0.0)


def test_a_mirrored_batch_has_mirrored_features(batch):
    mirrored = batch.mirrored()
    flip = torch.tensor([1.0, -1.0, 1.0])
    torch.testing.assert_close(mirrored.states, batch.states * flip)
    for one, other in ((batch, mirrored), (batch, batch.mirrored().mirrored())):
        torch.testing.assert_close(
            verdicts(other, other.states, other.durations, none(batch)).intrusion,
            verdicts(one, one.states, one.durations, none(batch)).intrusion, atol=1e-4, rtol=0.0,
        )  # fmt: skip


@pytest.mark.parametrize("mode", ["regression", "diffusion"])
def test_the_loss_is_finite_and_moves_every_weight(batch, mode):
    torch.manual_seed(0)
    network = TimedNetwork(dataclasses.replace(TINY, mode=mode))
    torch.nn.init.normal_(network.joint_out.weight, std=0.1)
    total, terms = TimedLoss(network)(batch, 1.0, 1.0, 0.05, torch.Generator().manual_seed(0))
    total.backward()
    assert set(terms) == {"imitation", "cost"}
    assert all(parameter.grad is not None and bool(torch.isfinite(parameter.grad).all()) for parameter in network.parameters())
