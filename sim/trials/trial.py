"""One flight of a batch: make the scene, plan it, fly the plan, say in one row what came of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from time import perf_counter
from typing import TypeAlias

from flockopt.bundles.bundles import bundle_compactness, insertion_cost, tasks_per_drone_std
from flockopt.certificate import Plan
from flockopt.certificate.judge import certify
from flockopt.errors import FlockError
from flockopt.planning.pipeline import plan
from flockopt.planning.planners import ANY_ANGLE, Planner
from flockopt.planning.replan import FREEZE_S
from flockopt.planning.settings import PlanSettings
from flockopt.records.status import Status
from flockopt.scene import Scene
from flockopt.scene.families.generate import generate
from flockopt.travel import Travel
from flockopt.travel.compute import compute_travel
from sim.mission.events import DroneLate, DroneLost, Event, EventSettings, TaskAdded, TaskRemoved, schedule
from sim.mission.execution import Execution
from sim.mission.mission import Mission, MissionOutcome
from sim.mission.wind import Gust
from sim.physics.settings import FlightSettings
from sim.trials.status import TrialStatus

__all__ = ["COLUMNS", "TIMINGS", "TRACKING_MARGIN_M", "Result", "Trial", "run_trial"]

Value: TypeAlias = str | int | float | None

#: Columns of the table of flights. ``episode_steps`` is the paper's number of allocation steps: planners that allocate all
#: tasks at once have none.
COLUMNS = (
    "scene", "planner", "status", "planner_coverage", "execution_completion", "contacts", "min_clearance", "min_separation",
    "mean_tracking_error", "max_tracking_error", "cost", "length", "lower_bound", "gap", "tasks_per_distance",
    "bundle_compactness", "insertion_cost", "episode_steps", "tasks_per_drone_std", "makespan", "energy", "family", "seed",
    "drones", "tasks", "sha256", "failed", "events", "tasks_added", "tasks_removed", "drones_lost", "drones_late", "gusts",
    "replans", "swaps", "swaps_certified", "refused", "unserved", "unexplained", "reasons",
)  # fmt: skip

#: Columns of the table of times, which differ from run to run and are kept apart.
TIMINGS = (
    "scene", "travel_s", "allocate_s", "generate_s", "bound_s", "decode_s", "deconflict_s", "certify_s", "plan_s", "flight_s",
    "measure_s", "real_time_factor", "attempts", "replan_s", "slow_replans",
)  # fmt: skip

#: Room that plans keep for tracking errors unless told otherwise, metres.
TRACKING_MARGIN_M = 0.03

STAGES = ("travel", "allocate", "generate", "bound", "decode", "deconflict", "certify")

#: Digits that tell scenes apart.
DIGEST_DIGITS = 12


@dataclass(frozen=True)
class Trial:
    """A flight to be made.

    Attributes:
        family: Of the scene, as are the next three.
        drones: How many.
        tasks: How many.
        seed: For the scene and the planner.
        planner: Who plans: a name, or the planner itself.
        time_limit_s: For the planner, seconds; None lets it stop by itself, the same way on every machine.
        settings: How to fly.
        force: Whether plans are flown that are not certified.
        tracking_margin_m: Room that plans keep for tracking errors, metres.
        paths: What drones fly along, see `flockopt.planning.pipeline.plan`.
        events: What happens in flight, or None for nothing.
    """

    family: str
    drones: int
    tasks: int
    seed: int
    planner: Planner | str = "classical"
    time_limit_s: float | None = None
    settings: FlightSettings = field(default_factory=FlightSettings)
    force: bool = False
    tracking_margin_m: float = TRACKING_MARGIN_M
    paths: str = ANY_ANGLE
    events: EventSettings | None = None

    @property
    def key(self) -> str:
        """Its name, one of a kind in its batch: that of its scene."""
        return f"{self.family}-{self.drones}x{self.tasks}-{self.seed}"

    @property
    def planning(self) -> PlanSettings:
        """How its plan is made.

        Raises:
            SettingsError: On a value that is out of range.
        """
        return PlanSettings(
            planner=self.planner, time_limit_s=self.time_limit_s, seed=self.seed, tracking_margin_m=self.tracking_margin_m,
            paths=self.paths,
        )  # fmt: skip

    def scene(self) -> Scene:
        """The scene itself.

        Raises:
            SettingsError: On an unknown family or a size it cannot have.
        """
        return generate(self.family, drones=self.drones, tasks=self.tasks, seed=self.seed)

    def plan(self, scene: Scene) -> Plan:
        """The plan to be flown in it."""
        return plan(scene, self.planning)

    def happenings(self, scene: Scene, made: Plan) -> tuple[Event, ...]:
        """What happens to the plan in flight."""
        return () if self.events is None else schedule(scene, made, self.seed, self.events)

    def fly(self, scene: Scene, made: Plan, events: Sequence[Event], *, travel: Travel | None = None) -> MissionOutcome:
        """Fly the plan, answer what happens, and fly again for tasks that are then still open."""
        with Mission(
            scene, made, self.settings, travel=travel, seed=self.seed, tracking_margin_m=self.tracking_margin_m,
            force=self.force,
        ) as mission:  # fmt: skip
            return mission.fly(events)

    def terms(self) -> dict[str, object]:
        """Everything that it shares with the other flights of a batch."""
        return {name: value for name, value in asdict(self).items() if name != "seed"}

    def blank_row(self) -> dict[str, Value]:
        """A row of `COLUMNS` for a flight that was not made."""
        planner = self.planner.name if isinstance(self.planner, Planner) else self.planner
        known = {"scene": self.key, "planner": planner, "family": self.family, "seed": self.seed, "drones": self.drones}
        nothing = {
            "status": TrialStatus.ERROR,
            "planner_coverage": 0.0,
            "execution_completion": 0.0,
            "tasks": self.tasks,
            "failed": "",
        }
        return dict.fromkeys(COLUMNS) | known | nothing


@dataclass(frozen=True)
class Result:
    """What came of a flight: its rows of `COLUMNS` and `TIMINGS`."""

    key: str
    row: Mapping[str, Value]
    timing: Mapping[str, Value]


def run_trial(trial: Trial) -> Result:
    """Plan and fly; what flockopt raises on purpose becomes a row with status ``error``."""
    row = trial.blank_row()
    timing: dict[str, Value] = dict.fromkeys(TIMINGS) | {"scene": trial.key, "attempts": 1}
    try:
        scene = trial.scene()
        made = trial.plan(scene)
        travel = compute_travel(scene)
        row |= _plan_columns(scene, made, travel)
        timing |= {f"{stage}_s": made.timing.get(stage) for stage in STAGES} | {"plan_s": made.timing["total"]}
        if row["status"] == TrialStatus.CERTIFIED or (trial.force and made.flights):
            events = trial.happenings(scene, made)
            begun = perf_counter()
            mission = trial.fly(scene, made, events, travel=travel)
            flown = perf_counter()
            row |= _flight_columns(mission.flight) | _event_columns(events, mission)
            timing |= {"flight_s": flown - begun, "measure_s": perf_counter() - flown} | _event_timings(mission)
            timing["real_time_factor"] = mission.flight.real_time_factor
    except FlockError as fault:
        row |= {"status": TrialStatus.ERROR, "failed": f"{type(fault).__name__}: {fault}"}
    return Result(trial.key, row, timing)


def _plan_columns(scene: Scene, made: Plan, travel: Travel) -> dict[str, Value]:
    number = {task.id: index for index, task in enumerate(scene.tasks)}
    routes = [[number[task] for task in made.routes.get(drone.id, ())] for drone in scene.drones]
    planned = sum(len(route) for route in routes)
    status = TrialStatus(made.status)
    clauses = () if made.certificate is None else made.certificate.clauses
    columns: dict[str, Value] = {
        "sha256": scene.sha256[:DIGEST_DIGITS],
        "status": status,
        "planner_coverage": planned / scene.num_tasks if scene.num_tasks else 1.0,
        "failed": " ".join(clause.name for clause in clauses if not clause.holds) or made.reason,
    }
    if status is TrialStatus.INFEASIBLE:
        return columns
    return columns | {
        "cost": made.cost.travel,
        "length": made.cost.length,
        "lower_bound": made.cost.lower_bound,
        "gap": made.cost.gap,
        "makespan": made.cost.makespan,
        "tasks_per_distance": planned / made.cost.travel if made.cost.travel > 0.0 else None,
        "bundle_compactness": bundle_compactness(routes, scene.task_positions),
        "insertion_cost": insertion_cost(travel, routes),
        "episode_steps": made.episode_steps,
        "tasks_per_drone_std": tasks_per_drone_std(routes),
    }


def _flight_columns(flight: Execution) -> dict[str, Value]:
    measures = flight.measures
    return {
        "execution_completion": measures.completion,
        "contacts": len(flight.touches),
        "min_clearance": measures.min_clearance,
        "min_separation": measures.min_separation,
        "mean_tracking_error": measures.mean_tracking_error,
        "max_tracking_error": measures.max_tracking_error,
        "energy": float(flight.energy.sum()),
    }


def _event_columns(events: Sequence[Event], mission: MissionOutcome) -> dict[str, Value]:
    """What happened and what came of it; swaps are judged anew, not by what they say of themselves."""
    kinds = {"tasks_added": TaskAdded, "tasks_removed": TaskRemoved, "drones_lost": DroneLost, "drones_late": DroneLate}
    return {
        "events": len(events),
        **{column: sum(isinstance(event, kind) for event in events) for column, kind in kinds.items()},
        "gusts": sum(isinstance(event, Gust) for event in events),
        "replans": len(mission.answers),
        "swaps": len(mission.swapped),
        "swaps_certified": sum(certify(answer.scene, answer.plan).certified for answer in mission.swapped),
        "refused": sum(answer.plan.status != Status.CERTIFIED for answer in mission.answers),
        "unserved": len(mission.unserved),
        "unexplained": len(mission.unexplained),
        "reasons": "; ".join(f"{task}: {reason}" for task, reason in mission.unserved.items()),
    }


def _event_timings(mission: MissionOutcome) -> dict[str, Value]:
    """The longest replanning, and how many took longer than the old plan is flown on."""
    seconds = [answer.seconds for answer in mission.answers]
    return {"replan_s": max(seconds, default=None), "slow_replans": sum(second > FREEZE_S for second in seconds)}
