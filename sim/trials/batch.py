"""Run many flights side by side, each once: what a journal holds is not flown again, and dead workers are replaced.

After a worker's death nobody knows which of the flights under way brought it down. They are flown again one at a time,
so that the next death has one name; a flight that kills three workers becomes a row with status ``error``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from flockopt.batches.backends import run_round
from sim.trials.journal import Journal
from sim.trials.trial import TIMINGS, Result, Trial, run_trial

__all__ = ["MOST_DEATHS", "run_batch"]

#: How many workers a flight may bring down before it is given up.
MOST_DEATHS = 3

Report = Callable[[str], None]


def run_batch(
    trials: Sequence[Trial],
    journal: Journal,
    *,
    jobs: int = 1,
    backend: str = "loky",
    work: Callable[[Trial], Result] = run_trial,
    done: Callable[[Result], None] = lambda result: None,
    warn: Report = lambda words: None,
) -> None:
    """Fly all trials that the journal does not hold yet.

    Args:
        trials: The flights; their keys are all different.
        journal: Takes every result as soon as it is there.
        jobs: Workers.
        backend: One of `flockopt.batches.backends.BACKENDS`.
        work: What a worker does with a trial.
        done: Told of every result.
        warn: Told, in words, of every dead worker.

    Raises:
        SettingsError: On an unknown backend.
        MissingExtra: If its package is not installed.
    """
    deaths: Counter[str] = Counter()

    def take(result: Result) -> None:
        attempts = {"attempts": min(1 + deaths[result.key], MOST_DEATHS)} if deaths[result.key] else {}
        journal.add(Result(result.key, result.row, {**result.timing, **attempts}))
        done(result)

    while pending := [trial for trial in trials if trial.key not in journal]:
        suspects = [trial for trial in pending if deaths[trial.key]]
        for trial in suspects:
            if deaths[trial.key] >= MOST_DEATHS:
                take(_given_up(trial))
        suspects = [trial for trial in suspects if trial.key not in journal]
        fallen = _round(suspects or [trial for trial in pending if trial.key not in journal], jobs, backend, work, take,
                        alone=bool(suspects))  # fmt: skip
        if fallen:
            deaths.update(fallen)
            warn(f"a worker died; flying again: {', '.join(fallen)}")


def _round(
    trials: Sequence[Trial],
    jobs: int,
    backend: str,
    work: Callable[[Trial], Result],
    take: Callable[[Result], None],
    *,
    alone: bool,
) -> list[str]:
    """Fly trials until all are done or a worker dies; the keys of those that were under way when it did."""
    under_way: list[str] = []
    # One job would fly in this process, which is not to die with it.
    workers = max(jobs, 2) if alone else jobs
    ahead = 1 if alone else 2 * workers

    def landed(result: Result) -> None:
        under_way.remove(result.key)
        take(result)

    is_done = run_round(backend, workers, work, trials, landed, ahead=ahead, begun=lambda trial: under_way.append(trial.key))
    return [] if is_done else under_way


def _given_up(trial: Trial) -> Result:
    row = trial.blank_row() | {"failed": f"it brought {MOST_DEATHS} workers down"}
    return Result(trial.key, row, dict.fromkeys(TIMINGS) | {"scene": trial.key, "attempts": MOST_DEATHS})
