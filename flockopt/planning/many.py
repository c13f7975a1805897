"""Many scenes planned side by side, each once: the way in for Monte-Carlo studies."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from flockopt.batches.backends import BACKENDS, open_backend, outcomes
from flockopt.batches.journal import Journal
from flockopt.certificate import Plan
from flockopt.errors import FlockError, SettingsError
from flockopt.planning.pipeline import plan
from flockopt.planning.planners import find_planner
from flockopt.planning.settings import PlanSettings
from flockopt.records import checks
from flockopt.scene import Scene

__all__ = ["PlanRow", "plan_many"]

#: The status of a scene that could not be read or planned at all; the row's reason says why.
ERROR = "error"

#: Scenes handed out beyond what has come back, for each worker.
AHEAD = 2


@dataclass(frozen=True)
class PlanRow:
    """What became of one scene of many.

    Attributes:
        index: Where it came among the scenes, from 0.
        scene: Its name, or its file where it could not be read.
        sha256: Its digest; empty where it could not be read.
        status: As of `flockopt.Plan`, or ``error``.
        reason: Why it is not certified; empty otherwise.
        travel: As all that follow but the last two, of `flockopt.certificate.Cost`: metres; None without a plan.
        length: Metres.
        lower_bound: Metres; None where none is proven.
        gap: Of travel to the bound.
        makespan: Seconds.
        seconds: By stage, of planning.
    """

    index: int
    scene: str
    sha256: str
    status: str
    reason: str = ""
    travel: float | None = None
    length: float | None = None
    lower_bound: float | None = None
    gap: float | None = None
    makespan: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """What tells it from all others of a run."""
        return f"{self.index}-{self.sha256[:16]}"


@dataclass(frozen=True)
class _Job:
    """A scene to plan."""

    index: int
    scene: Scene

    @property
    def key(self) -> str:
        return f"{self.index}-{self.scene.sha256[:16]}"


def plan_many(
    scenes: Iterable[Scene | Path | str],
    settings: PlanSettings | None = None,
    *,
    out: Path | str | None = None,
    keep_plans: bool = False,
    jobs: int = 1,
    workers: str = "loky",
    **keywords: Any,
) -> Iterator[PlanRow]:
    """Plan scene after scene, several at a time, and give a row of each as it comes.

    Scenes are taken one by one as there is room, so that a generator of a million scenes takes no memory; rows come in the
    order in which they are done (`PlanRow.index` tells which is which). A scene that cannot be read or planned, or that kills
    its worker twice, becomes a row with the status ``error`` and holds up no other. The plans of a seed are the same for any
    number of jobs.

    Args:
        scenes: Scenes, or files of them.
        settings: How to plan, as for `flockopt.plan`; the same for all.
        out: A folder for the rows, ``rows.jsonl``, a line each, written through as they come. A run that was stopped and is
            begun again on the same terms gives the rows that it has, and goes on with the others.
        keep_plans: Whether to write plan files as well: ``plans/INDEX-NAME.json`` in that folder.
        jobs: How many plans are made at a time.
        workers: Where: ``loky`` for processes of this machine, ``threading``, ``dask`` or ``ray``.
        **keywords: Fields of `PlanSettings`, as for `flockopt.plan`.

    Raises:
        SettingsError: On a bad setting; if the folder cannot be used, is in use, or holds a run on other terms.
        MissingExtra: If what the planner or the workers need is not installed.
    """
    settings = PlanSettings.of(settings, keywords)
    jobs = checks.integer(SettingsError, "jobs", jobs, least=1)
    checks.choice(SettingsError, "workers", workers, known=BACKENDS)
    if keep_plans and out is None:
        raise SettingsError("keep_plans", "is set", "plans are written to a folder", "give out a folder")
    find_planner(settings.planner).check(settings.paths, settings.backend)
    return _rows(scenes, settings, None if out is None else Path(out), keep_plans, jobs, workers)


def _rows(
    scenes: Iterable[Scene | Path | str], settings: PlanSettings, out: Path | None, keep_plans: bool, jobs: int, workers: str
) -> Iterator[PlanRow]:
    with ExitStack() as until_done:
        journal = None if out is None else until_done.enter_context(_journal(out, settings))
        known: deque[PlanRow] = deque()  # rows that need no planning
        plans = out / "plans" if out is not None and keep_plans else None
        if plans is not None:
            plans.mkdir(exist_ok=True)
        jobs_left = _jobs(scenes, known, journal)
        for row in _planned(jobs_left, partial(_work, settings=settings, plans=plans), known, jobs, workers):
            if journal is not None:
                journal.add(row.key, {"row": asdict(row)})
            yield row


def _journal(out: Path, settings: PlanSettings) -> Journal:
    planner = settings.planner if isinstance(settings.planner, str | None) else settings.planner.name
    terms = {"version": version("flockopt"), "planner": planner} | settings.to_dict()
    return Journal(out, terms, "plans", ("row",))


def _jobs(scenes: Iterable[Scene | Path | str], known: deque[PlanRow], journal: Journal | None) -> Iterator[_Job]:
    """Scenes still to plan; the rows of others go to ``known``."""
    for index, given in enumerate(scenes):
        try:
            job = _Job(index, given if isinstance(given, Scene) else Scene.load(given))
        except FlockError as fault:
            known.append(PlanRow(index, str(given), "", ERROR, str(fault)))
            continue
        if journal is not None and job.key in journal:
            known.append(PlanRow(**journal.records[job.key]["row"]))
        else:
            yield job


def _planned(jobs_left: Iterator[_Job], work: Any, known: deque[PlanRow], jobs: int, workers: str) -> Iterator[PlanRow]:
    """Rows of all jobs as they come, and those that are known between them; dead workers are replaced."""
    is_done = False
    while not is_done:
        under_way: dict[str, _Job] = {}
        with open_backend(workers, jobs) as place:
            try:
                for row in outcomes(place, work, jobs_left, AHEAD * jobs, partial(_note, under_way)):
                    while known:
                        yield known.popleft()
                    under_way.pop(row.key)
                    yield row
                is_done = True
            except place.deaths:
                pass
        for job in under_way.values():  # nobody knows which of them did it: each is planned alone, once more
            with open_backend(workers, 2) as place:
                try:
                    yield next(outcomes(place, work, [job], 1))
                except place.deaths:
                    yield PlanRow(job.index, job.scene.name, job.scene.sha256, ERROR, "it brought two workers down")
    while known:
        yield known.popleft()


def _note(under_way: dict[str, _Job], job: _Job) -> None:
    under_way[job.key] = job


def _work(job: _Job, *, settings: PlanSettings, plans: Path | None) -> PlanRow:
    """Plan one scene, and write its plan if there is a folder for it."""
    scene = job.scene
    try:
        made = plan(scene, settings)
        if plans is not None:
            made.save(plans / f"{job.index}-{''.join(c if c.isalnum() or c in '-_' else '_' for c in scene.name)[:80]}.json")
    except Exception as fault:  # whatever goes wrong in one scene is its row, and not the end of a study
        words = str(fault) if isinstance(fault, FlockError) else f"{type(fault).__name__}: {fault}"
        return PlanRow(job.index, scene.name, scene.sha256, ERROR, words)
    costs = {} if made.certificate is None else {name.name: getattr(made.cost, name.name) for name in fields(made.cost)}
    costs.pop("travel_revision", None)
    return PlanRow(
        job.index, scene.name, scene.sha256, str(made.status), _reason(made), **costs,
        seconds={stage: float(seconds) for stage, seconds in made.timing.items()},
    )  # fmt: skip


def _reason(made: Plan) -> str:
    failed = () if made.certificate is None else made.certificate.failed
    return "; ".join([*([made.reason] if made.reason else []), *(f"{clause.name}: {clause.detail}" for clause in failed)])
