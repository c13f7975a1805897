"""Run many flights side by side, each once: what a journal holds is not flown again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from flockopt.batches.workers import MOST_DEATHS, done_by_workers
from sim.trials.journal import Journal
from sim.trials.trial import TIMINGS, Result, Trial, run_trial

__all__ = ["run_batch"]


def run_batch(
    trials: Sequence[Trial],
    journal: Journal,
    *,
    jobs: int = 1,
    backend: str = "loky",
    work: Callable[[Trial], Result] = run_trial,
    done: Callable[[Result], None] = lambda result: None,
    warn: Callable[[str], None] = lambda words: None,
) -> None:
    """Fly all trials that the journal does not hold yet; a flight that kills its workers becomes a row with status ``error``.

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
    pending = [trial for trial in trials if trial.key not in journal]
    for result, attempts in done_by_workers(
        pending, work, key=lambda trial: trial.key, given_up=_given_up, jobs=jobs, backend=backend, warn=warn
    ):
        if attempts > 1:
            result = Result(result.key, result.row, {**result.timing, "attempts": attempts})
        journal.add(result)
        done(result)


def _given_up(trial: Trial) -> Result:
    row = trial.blank_row() | {"failed": f"it brought {MOST_DEATHS} workers down"}
    return Result(trial.key, row, dict.fromkeys(TIMINGS) | {"scene": trial.key, "attempts": MOST_DEATHS})
