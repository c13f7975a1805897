"""The actors and their critic: masks, permutations, padding, any size."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

from learned.teacher.actors.critic import CentralCritic  # noqa: E402
from learned.teacher.actors.networks import make_actor  # noqa: E402
from learned.teacher.descriptors import DRONE_FEATURES, PAIR_FEATURES, observe  # noqa: E402
from learned.teacher.environment import choices, num_to_serve, reset, step  # noqa: E402
from learned.teacher.episodes import decide, play  # noqa: E402
from learned.teacher.ppo import masked_log_softmax  # noqa: E402
from learned.teacher.problems import Problems, random_problems  # noqa: E402 - torch may be missing

METHODS = ("teacher", "magnnet")
WIDTH = 64


def new_actor(method):
    torch.manual_seed(1)
    actor = make_actor(method, WIDTH)
    torch.nn.init.normal_(actor.score.weight)  # scores that differ clearly
    return actor


def middle_state(problems):
    """The observation after a step in which every other drone named its nearest task, the state, and what was taken."""
    state = reset(problems)
    options = choices(problems, state)
    nearest = options.cost.masked_fill(~options.allowed[..., :-1], torch.inf).argmin(dim=2)
    idles = torch.arange(problems.num_drones) % 2 == 1
    can = options.allowed[..., :-1].any(dim=2)
    state, outcome = step(problems, state, options, torch.where(can & ~idles, nearest, problems.num_tasks))
    return observe(problems, state, choices(problems, state), outcome.taken), state, outcome.taken


def scores_of(actor, observed, memory=None):
    with torch.no_grad():
        memory = torch.ones(*observed.drone.shape[:2], actor.memory_width) if memory is None else memory
        return actor(observed, memory)


def relabelled(problems, drones, tasks):
    """The same problems with drones and tasks in another order."""
    by_drone = ("starts", "capacity", "max_distance", "start_end", "drone_class", "drone_mask")
    changes = {name: getattr(problems, name)[:, drones] for name in by_drone}
    changes |= {name: getattr(problems, name)[:, tasks] for name in ("tasks", "demand", "task_mask")}
    changes |= {name: getattr(problems, name)[:, drones][:, :, tasks] for name in ("start_task", "task_end")}
    return problems.replace(**changes, task_task=problems.task_task[:, :, tasks][:, :, :, tasks])


def test_observations_have_the_features_they_name():
    observed, _, _ = middle_state(random_problems(3, 4, 9, torch.Generator().manual_seed(0)))
    assert observed.pair.shape[3] == len(PAIR_FEATURES)
    assert observed.drone.shape[2] == len(DRONE_FEATURES)
    assert torch.isfinite(observed.pair).all() and torch.isfinite(observed.drone).all()


def test_the_costs_in_observations_by_hand():
    """Three drones at 1, 2 and 4 from the only task: each rival's cost, and who is how much cheaper."""
    problems = random_problems(1, 3, 1, torch.Generator().manual_seed(0))
    problems = problems.replace(start_task=torch.tensor([[[1.0], [2.0], [4.0]]]), scale=torch.ones(1))
    state = reset(problems)
    observed = observe(problems, state, choices(problems, state), torch.full((1, 3), -1))
    told = dict(zip(PAIR_FEATURES, observed.pair[0, :, 0].sinh().T.tolist(), strict=True))
    assert told["marginal cost"] == pytest.approx([1.0, 2.0, 4.0])
    assert told["cheapest rival's cost"] == pytest.approx([2.0, 1.0, 1.0])
    assert told["cost above the cheapest rival's"] == pytest.approx([-1.0, 1.0, 3.0])
    assert told["cost above the second rival's"] == pytest.approx([-3.0, -2.0, 2.0])
    assert told["drones that are cheaper"] == pytest.approx([0.0, 1.0, 2.0])


@pytest.mark.parametrize("method", METHODS)
def test_masked_actions_have_probability_exactly_zero_and_are_never_taken(method):
    problems = random_problems(50, 4, 7, torch.Generator().manual_seed(0))
    actor, generator = new_actor(method), torch.Generator().manual_seed(1)
    with torch.no_grad():
        for moment in play(actor, problems, generator=generator):
            scores, _ = scores_of(actor, moment.observed)
            probs = masked_log_softmax(scores, moment.observed.allowed).exp()
            assert bool((probs[~moment.observed.allowed] == 0.0).all())
            assert moment.observed.allowed.gather(2, moment.actions[..., None]).all()


def test_likeliest_and_random_decisions():
    log_probs = torch.tensor([0.2, 0.5, 0.3, 0.0]).log()
    assert int(decide(log_probs, None)) == 1
    drawn = decide(log_probs.expand(4000, -1), torch.Generator().manual_seed(0)).bincount(minlength=4) / 4000
    assert drawn.tolist() == pytest.approx([0.2, 0.5, 0.3, 0.0], abs=0.03)
    assert drawn[3] == 0.0


@pytest.mark.parametrize("method", METHODS)
def test_a_permutation_of_drones_or_tasks_permutes_the_scores(method):
    problems = random_problems(5, 4, 7, torch.Generator().manual_seed(2))
    actor = new_actor(method)
    drones, tasks = torch.randperm(4), torch.randperm(7)
    results = []
    for one in (problems, relabelled(problems, drones, tasks)):
        state = reset(one)
        observed = observe(one, state, choices(one, state), torch.full((5, 4), -1))
        results.append(scores_of(actor, observed))
    (scores, memory), (permuted, permuted_memory) = results
    assert torch.allclose(permuted, scores[:, drones][:, :, [*tasks.tolist(), 7]], atol=1e-4)
    assert torch.allclose(permuted_memory, memory[:, drones], atol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_a_permutation_permutes_whole_episodes(method):
    problems = random_problems(20, 5, 9, torch.Generator().manual_seed(3))
    actor = new_actor(method)
    drones, tasks = torch.randperm(5), torch.randperm(9)
    with torch.no_grad():
        plain = [m.outcome.taken for m in play(actor, problems) if len(m.rows) == 20]
        other = [m.outcome.taken for m in play(actor, relabelled(problems, drones, tasks)) if len(m.rows) == 20]
    assert len(plain) == len(other) >= 1
    for ours, theirs in zip(plain, other, strict=True):
        renamed = torch.where(theirs >= 0, tasks[theirs.clamp(min=0)], -1)
        assert torch.equal(renamed, ours[:, drones])


def padded(problems, drones, tasks):
    """The same problems with more drones and tasks that are not there."""

    def grown(name, values):
        sizes = [{problems.num_drones: drones, problems.num_tasks: tasks}.get(size, size) for size in values.shape[1:]]
        if name in ("starts", "tasks"):
            sizes[-1] = 3
        result = torch.zeros(len(values), *sizes, dtype=values.dtype)
        result[(slice(None), *(slice(size) for size in values.shape[1:]))] = values
        return result

    names = [name for name in problems.__dataclass_fields__ if name != "scale"]
    return Problems(**{name: grown(name, getattr(problems, name)) for name in names}, scale=problems.scale)


@pytest.mark.parametrize("method", METHODS)
def test_padding_changes_nothing(method):
    problems = random_problems(6, 4, 7, torch.Generator().manual_seed(4))
    actor = new_actor(method)
    critic = CentralCritic(WIDTH, actor.memory_width)
    results = []
    for one in (problems, padded(problems, 6, 11)):
        observed, _, _ = middle_state(one)
        results.append((*scores_of(actor, observed), critic(observed, scores_of(actor, observed)[1], num_to_serve(one))))
    (scores, memory, value), (more_scores, more_memory, more_value) = results
    kept = scores.shape[2] - 1
    assert torch.allclose(more_scores[:, :4, [*range(kept), -1]], scores, atol=1e-4)
    assert torch.allclose(more_memory[:, :4], memory, atol=1e-4)
    assert torch.allclose(more_value, value, atol=1e-5)


def test_the_memory_knows_what_was_taken():
    problems = random_problems(8, 4, 7, torch.Generator().manual_seed(5))
    actor = new_actor("teacher")
    observed, state, taken = middle_state(problems)
    assert observed.has_taken.any()
    _, memory = scores_of(actor, observed)
    _, without = scores_of(actor, observe(problems, state, choices(problems, state), torch.full_like(taken, -1)))
    differs = (memory - without).abs().amax(dim=2) > 1e-6
    assert torch.equal(differs, observed.has_taken)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("drones", "tasks"), [(1, 1), (1, 5), (7, 2), (25, 60)])
def test_any_size_can_be_played(method, drones, tasks):
    problems = random_problems(2, drones, tasks, torch.Generator().manual_seed(6))
    with torch.no_grad():
        taken = sum(int((m.outcome.taken >= 0).sum()) for m in play(new_actor(method), problems))
    assert taken == 2 * tasks
