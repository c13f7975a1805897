"""Many scenes, each planned once, by several workers; what was planned when a run stopped is not planned again.

Rows go to the journal of the run's folder as they come and are given in the order of the scenes. Whoever reads them pulls:
scenes are taken from where they come as there is room for them, and let go when their row is written.
"""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sized
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from flockopt.batches.backends import BACKENDS
from flockopt.batches.journal import Journal, table
from flockopt.batches.progress import ProgressBar
from flockopt.batches.workers import done_by_workers
from flockopt.errors import SceneError, SettingsError
from flockopt.planning.groups import PLANS, Asked, Group, Made, Work, each_alone, name_of
from flockopt.planning.pipeline import ready_planner
from flockopt.planning.plan_row import COLUMNS, FIELDS, PlanRow
from flockopt.planning.planners import find_planner
from flockopt.planning.settings import PlanSettings
from flockopt.records import checks, files
from flockopt.records.status import Status
from flockopt.scene import Scene

__all__ = ["TABLE", "TOGETHER", "plan_many", "scene_files"]

#: The table in the folder of a run.
TABLE = "rows.csv"

#: How many scenes a planner that can is asked about at once. Who they are is a matter of their order alone, and so are plans.
TOGETHER = 16

Source: TypeAlias = Scene | str | Path


def plan_many(
    scenes: Iterable[Source] | Source,
    settings: PlanSettings | None = None,
    *,
    out: str | Path | None = None,
    jobs: int = 1,
    workers: str = "loky",
    keep_plans: bool = False,
    progress: bool = False,
    **keywords: Any,
) -> Iterator[PlanRow]:
    """Plan many scenes, and give a row for each, in their order.

    A scene that cannot be read or planned gives a row with status ``error`` and the reason, and stops no other. Rows are the
    same, but for their seconds, however many jobs there are, unless there is a time limit. A planner that can proposes for
    `TOGETHER` scenes at once; with a time limit, which is for each scene, it does not.

    Args:
        scenes: Scenes and scene files, taken as rows are; or a folder of files, see `scene_files`.
        settings: How to plan, as of `flockopt.plan`.
        out: A folder that keeps what is done: ``rows.jsonl``, a line a scene as it is done, and at the end ``rows.csv``, all
            rows in their order. A run that was stopped goes on where it stopped when it is started again; scenes that gave
            an error are tried again then. None keeps nothing.
        jobs: How many workers; 1 plans in this process.
        workers: What they are, one of `flockopt.batches.backends.BACKENDS`: processes (``loky``), threads, Dask or Ray.
        keep_plans: Whether to keep each plan as a plan file, beneath ``out``.
        progress: Whether to say on stderr how far it is.
        **keywords: Fields of `PlanSettings`, such as ``planner``, ``seed`` and ``time_limit_s``.

    Raises:
        SettingsError: On a setting or an argument that is none or out of range; while rows are read, if ``out`` cannot be used,
            is in use, or holds another run.
        MissingExtra: If what workers or smoothing needs is not installed.
    """
    settings = PlanSettings.of(settings, keywords)
    if settings.planner is None:
        settings = replace(settings, planner=find_planner(None).name)
    planner = ready_planner(settings)
    jobs = checks.integer(SettingsError, "jobs", jobs, least=1)
    checks.choice(SettingsError, "workers", workers, known=BACKENDS)
    if checks.flag(SettingsError, "keep_plans", keep_plans) and out is None:
        raise SettingsError("keep_plans", "is true without a folder", "plans are kept beneath out", "give out, or leave it out")
    together = TOGETHER if planner.propose_many is not None and settings.time_limit_s is None else 1
    if isinstance(scenes, Scene | str | Path):
        scenes = [scenes] if isinstance(scenes, Scene) else scene_files(scenes)
    work = Work(settings, planner.name, keep_plans)
    return _rows(scenes, work, together, None if out is None else Path(out), _Place(jobs, workers), progress)


def scene_files(*places: str | Path) -> list[Path]:
    """Scene files: each place that is a file, and of each that is a folder the files that end in ``.json``, by name.

    Raises:
        SettingsError: If there is nothing at a place, or no such file in a folder.
    """
    found: list[Path] = []
    for place in map(Path, places):
        inside = sorted(path for path in place.glob("*.json") if path.is_file()) if place.is_dir() else [place]
        if not inside or not place.exists():
            seen = f"are {place}, which {'holds no .json file' if place.exists() else 'is not there'}"
            raise SettingsError("scenes", seen, "must be scene files, or folders of them", "check the path")
        found += inside
    return found


class _Place(NamedTuple):
    """Where scenes are planned: by how many workers, and what they are."""

    jobs: int
    workers: str


def _rows(
    sources: Iterable[Source], work: Work, together: int, out: Path | None, place: _Place, progress: bool
) -> Iterator[PlanRow]:
    """See `plan_many`; without a folder the journal is in a temporary one."""
    with ExitStack() as opened:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory())) if out is None else out
        study = _Study(opened.enter_context(Journal(folder, work.terms(), "plans", FIELDS, _stands)), work)
        bar = None
        if progress:
            bar = ProgressBar(len(sources) if isinstance(sources, Sized) else None)
            opened.callback(bar.close)
        done = opened.enter_context(
            closing(
                done_by_workers(
                    study.groups(sources, together), work, key=name_of, given_up=work.given_up, jobs=place.jobs,
                    backend=place.workers, parts=each_alone, warn=(lambda words: None) if bar is None else bar.note,
                )
            )
        )  # fmt: skip
        for returned, _ in done:
            study.keep(returned)
            yield from study.ready(bar)
        yield from study.ready(bar)
        if study.fault is not None:
            raise study.fault
        if out is not None:
            files.write_whole(SettingsError, folder / TABLE, table(COLUMNS, study.cells()))


def _stands(record: Mapping[str, Any]) -> bool:
    """Whether a row that is found is let stand."""
    return record["status"] != Status.ERROR


class _Listed(NamedTuple):
    """A scene in the order of all: its key, the file that it came from, and whether its row was there before."""

    key: str
    source: str
    is_known: bool


@dataclass
class _Study:
    """How far a run is.

    Attributes:
        journal: The rows that are there.
        work: What is done with scenes.
        listed: The scenes so far, in their order; `waiting` are those of them whose rows were not given yet.
        taken: Keys of all of them.
        fault: What the scenes' source raised in place of one more.
    """

    journal: Journal
    work: Work
    listed: list[_Listed] = field(default_factory=list)
    waiting: deque[_Listed] = field(default_factory=deque)
    taken: set[str] = field(default_factory=set)
    fault: Exception | None = None

    def groups(self, sources: Iterable[Source], together: int) -> Iterator[Group]:
        """Scenes to be planned, so many at a time; groups of which all rows are there are left out.

        A scene that was there before is not planned twice. A fault of the source is kept until all before it is done.
        """
        group: list[Asked] = []
        for asked in self._asked(sources):
            group.append(asked)
            if len(group) == together:
                yield from self._missing(group)
                group = []
        yield from self._missing(group)

    def keep(self, made: Iterable[Made]) -> None:
        """Write rows, and their plans before them."""
        for one in made:
            if one.text and one.key not in self.journal:
                (self.journal.folder / PLANS).mkdir(exist_ok=True)
                files.write_whole(SettingsError, self.journal.folder / one.row.plan, one.text)
            self.journal.append(one.key, one.row.to_dict())

    def ready(self, bar: ProgressBar | None) -> Iterator[PlanRow]:
        """The next rows in their order, as far as they are there."""
        while self.waiting and self.waiting[0].key in self.journal:
            listed = self.waiting.popleft()
            row = self._row(listed)
            if bar is not None:
                bar.advance(f"{row.scene} {row.status}", is_new=not listed.is_known)
            yield row

    def cells(self) -> Iterator[dict[str, Any]]:
        """All rows in their order, for a table."""
        return (self._row(listed).cells() for listed in self.listed)

    def _row(self, listed: _Listed) -> PlanRow:
        return replace(PlanRow.from_dict(self.journal[listed.key]), source=listed.source)

    def _missing(self, group: list[Asked]) -> list[Group]:
        return [tuple(group)] if any(one.key not in self.journal for one in group) else []

    def _asked(self, sources: Iterable[Source]) -> Iterator[Asked]:
        """The scenes that are met for the first time; files that cannot be read have their rows at once."""
        try:
            for number, source in enumerate(sources):
                asked = self._read(number, source)
                listed = _Listed(asked.key, _file_of(source), asked.key in self.journal)
                self.listed.append(listed)
                self.waiting.append(listed)
                if isinstance(asked, Made):
                    self.keep([asked])
                elif asked.key not in self.taken:
                    self.taken.add(asked.key)
                    yield asked
        except Exception as fault:  # raised again when the rows of all scenes before it are given
            self.fault = fault

    def _read(self, number: int, source: object) -> Asked | Made:
        if not isinstance(source, Scene | str | Path):
            seen = f"is {checks.shown(source)}"
            raise SettingsError(f"scenes[{number}]", seen, "must be a Scene or the path of a scene file", "give one")
        try:
            scene = source if isinstance(source, Scene) else Scene.load(source)
        except SceneError as fault:
            return Made(f"file {source}", self.work.unread(str(source), f"SceneError: {fault}"))
        return Asked(scene.sha256, scene, _file_of(source))


def _file_of(source: Source) -> str:
    return "" if isinstance(source, Scene) else str(source)
