"""Many scenes by planners with networks: asked once for all, and answering as they answer one by one."""

from __future__ import annotations

import pytest

pytest.importorskip("torch", reason="torch comes with the extra 'learned'")

import torch

from flockopt import Planner, generate, plan, plan_many
from flockopt.planning.planners import Request, find_planner
from flockopt.travel.compute import compute_travel
from learned.networks.threads import one_thread
from learned.teacher import planner as teacher

#: Scenes of several sizes, one of them without tasks.
SCENES = [
    generate("forest", drones=4, tasks=9, seed=2), generate("rooms", drones=2, tasks=5, seed=0),
    generate("forest", drones=3, tasks=0, seed=1), generate("corridor", drones=5, tasks=7, seed=3),
    generate("forest", drones=4, tasks=9, seed=5),
]  # fmt: skip

NAMES = ("teacher", "magnnet", "magnnet-bundling", "learned", "hybrid")


@pytest.mark.parametrize("name", NAMES)
def test_many_are_planned_as_one_by_one(name):
    with one_thread():
        alone = [plan(scene, planner=name, seed=3) for scene in SCENES]
    for row, made in zip(plan_many(SCENES, planner=name, seed=3), alone, strict=True):
        assert (row.planner, row.status, row.unserved) == (name, made.status, len(made.unserved)), row.reason
        assert row.cost == pytest.approx(made.cost.travel) and row.bound == pytest.approx(made.cost.lower_bound)
        assert row.makespan == pytest.approx(made.cost.makespan, abs=1e-3)
        assert row.seconds.keys() == made.timing.keys()


@pytest.mark.parametrize("name", ["teacher", "hybrid"])
def test_jobs_make_no_difference(name):
    scenes = [generate("forest", drones=3, tasks=5, seed=seed) for seed in range(20)]
    assert list(plan_many(scenes, planner=name, jobs=2)) == list(plan_many(scenes, planner=name))


@pytest.mark.parametrize("name", NAMES)
def test_proposals_for_many_are_those_for_each(name):
    planner = find_planner(name)
    requests = [Request(scene, compute_travel(scene), None, seed) for seed, scene in enumerate(SCENES)]
    threads = torch.get_num_threads()
    for request, proposal in zip(requests, planner.propose_many(requests), strict=True):
        alone = planner.propose(request)
        assert proposal.bundles == alone.bundles and proposal.episode_steps == alone.episode_steps
        assert (proposal.samples is None) == (alone.samples is None) and proposal.made_with == alone.made_with
        assert proposal.samples is None or proposal.samples == pytest.approx(alone.samples, abs=1e-4)
    assert torch.get_num_threads() == threads


def test_the_networks_decide_once_for_all(monkeypatch):
    asked = []

    class Counted:
        def __init__(self, method):
            self.inner = inner(method)

        def bundles(self, scenes, travels):
            asked.append((len(scenes), torch.get_num_threads()))
            return self.inner.bundles(scenes, travels)

    inner = teacher.allocator
    monkeypatch.setattr(teacher, "allocator", Counted)
    assert all(row.certified for row in plan_many(SCENES, planner="teacher"))
    assert asked == [(len(SCENES), 1)]


def test_other_paths_are_found_for_many_too():
    (many,) = plan_many(SCENES[:1], planner="teacher", paths="voxel26", tracking_margin_m=0.02)
    alone = plan(SCENES[0], planner="teacher", paths="voxel26", tracking_margin_m=0.02)
    assert isinstance(find_planner("teacher"), Planner)
    assert (many.cost, many.makespan) == (pytest.approx(alone.cost.travel), pytest.approx(alone.cost.makespan))
