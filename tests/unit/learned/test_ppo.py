"""The parts of proximal policy optimisation against numbers worked by hand."""

from __future__ import annotations

import math

import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from learned.teacher import ppo  # noqa: E402 - torch may be missing


def test_a_masked_action_has_probability_zero():
    scores = torch.tensor([0.0, math.log(3.0), 50.0])
    log_probs = ppo.masked_log_softmax(scores, torch.tensor([True, True, False]))
    assert log_probs.exp().tolist() == pytest.approx([0.25, 0.75, 0.0])
    assert float(log_probs.exp()[2]) == 0.0


def test_masking_keeps_gradients_finite():
    scores = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    log_probs = ppo.masked_log_softmax(scores, torch.tensor([True, False, True]))
    (ppo.entropy(log_probs) + log_probs[0]).backward()
    assert torch.isfinite(scores.grad).all()
    assert float(scores.grad[1]) == 0.0


def test_entropy_by_hand():
    allowed = torch.tensor([[True, True, False], [True, False, False]])
    values = ppo.entropy(ppo.masked_log_softmax(torch.zeros(2, 3), allowed))
    assert values.tolist() == pytest.approx([math.log(2.0), 0.0])


def test_advantages_by_hand():
    """Two steps in the first episode, one in the second; gamma 0.9, lambda 0.8.

    Last step: 2 - 1 = 1. First: 1 + 0.9 * 1 - 0.5 = 1.4, and 1.4 + 0.9 * 0.8 * 1 = 2.12. Second episode: 3 - 1 = 2.
    """
    rewards = torch.tensor([[1.0, 3.0], [2.0, 7.0]])
    values = torch.tensor([[0.5, 1.0], [1.0, 9.0]])
    active = torch.tensor([[True, True], [True, False]])
    advantages, returns = ppo.generalised_advantages(rewards, values, active, discount=0.9, trace=0.8)
    assert advantages.flatten().tolist() == pytest.approx([2.12, 2.0, 1.0, 0.0])
    assert returns.flatten().tolist() == pytest.approx([2.62, 3.0, 2.0, 0.0])


def test_without_discount_and_with_full_trace_returns_are_sums():
    rewards, values = torch.randn(5, 3), torch.randn(5, 3)
    active = torch.ones(5, 3, dtype=torch.bool)
    _, returns = ppo.generalised_advantages(rewards, values, active, discount=1.0, trace=1.0)
    assert torch.allclose(returns, rewards.flip(0).cumsum(0).flip(0), atol=1e-5)


def test_normalising_by_hand():
    assert ppo.normalised(torch.tensor([1.0, 3.0])).tolist() == [-1.0, 1.0]
    assert ppo.normalised(torch.tensor([4.0, 4.0])).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "learns"),
    [
        (1.5, 1.0, -1.2, False),  # already much likelier: no reward for more
        (0.5, 1.0, -0.5, True),
        (0.5, -1.0, 0.8, False),  # already much less likely
        (1.5, -1.0, 1.5, True),
        (1.1, 2.0, -2.2, True),
    ],
)
def test_the_clipped_loss_by_hand(ratio, advantage, loss, learns):
    log_probs = torch.tensor([math.log(0.2 * ratio)], requires_grad=True)
    value = ppo.clipped_policy_loss(log_probs, torch.tensor([math.log(0.2)]), torch.tensor([advantage]), 0.2)
    assert float(value.detach()) == pytest.approx(loss, rel=1e-5)
    value.backward()
    assert (float(log_probs.grad.abs()) > 0.0) == learns


def test_the_critics_loss_by_hand():
    assert float(ppo.value_loss(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 2.0]))) == 1.0
