"""Orders, lags, delays and any other setting, chosen in free run on a hold-out of another excitation."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, Progress, SettingsError, require_one_of, require_whole, silent
from softneck.core._blas_threads import one_blas_thread
from softneck.core._shown import Shown
from softneck.signals import Recording
from softneck.signals.recording._recording import require_same_robot

from ..models._fitting import known_rows, row_hashes
from ..models._model import WARM_UP, Model
from ._trials import Estimator, Trial, attempt, settings_of

if TYPE_CHECKING:
    import pandas as pd


STRATEGIES = ("grid", "coordinate")
RULES = ("one_standard_error", "best")
# A table of more fits than this is no search but a mistake; coordinates need far fewer.
_MOST_TRIALS = 20_000
# Half is aligned and not scored; what is left of fewer says nothing of a free run.
MIN_HOLD_OUT = 2 * WARM_UP
_SAME_EXCITATION = (
    "the hold-out goes on where the training rows end: it is the same excitation, on which a choice looks better than "
    "it is. Hold out a recording of another signal."
)


@dataclass(frozen=True, eq=False, repr=False)
class Search(Shown):
    """All that a search tried, and what it chose.

    Attributes:
        estimator: the settings that all trials share.
        vary: what was varied, the values of each in the order given.
        trials: each fit, in the order of the grid, or in that of the steps.
        rule: how `best` is chosen.
        remarks: what a reader must know of the hold-out.
        interrupted: whether Ctrl-C ended it; `trials` holds what was done by then.
        train: the recording that every trial, and `model`, was fitted on.
    """

    estimator: Any
    vary: Mapping[str, Sequence[Any]]
    trials: tuple[Trial, ...]
    rule: str
    remarks: tuple[str, ...]
    interrupted: bool
    train: Recording

    @cached_property
    def chosen(self) -> Trial:
        """The trial of rule "best", or "one_standard_error": the smallest as good as it.

        As good: not worse than the best by more than the best's standard error (Breiman et al. 1984, section
        3.4.3); of equally small ones the best.
        """
        usable = [trial for trial in self.trials if np.isfinite(trial.score)]
        best = max(usable, key=lambda trial: trial.score)
        if self.rule == "best":
            return best
        as_good = [trial for trial in usable if trial.score >= best.score - best.error]
        return min(as_good, key=lambda trial: (trial.size, -trial.score))

    @property
    def best(self) -> dict[str, Any]:
        """The chosen values of the settings that were varied."""
        return dict(self.chosen.settings)

    @property
    def curves(self) -> dict[str, list[list[Any]]]:
        """Each varied setting -> rows (value, free-run fit of pitch, of roll, one-step fit of both).

        A row is the best trial with that value, whatever the others are; fits are None where none ran free. Of another
        robot those of its outputs, all in free run first.
        """
        axes = self.train.robot.outputs.names
        return {name: [_curve_row(self.trials, name, v, axes) for v in values] for name, values in self.vary.items()}

    @cached_property
    def model(self) -> Model:
        """The model of the chosen settings, fitted again on `train` alone: the hold-out stays unseen.

        Its findings hold the whole search.
        """
        model = dataclasses.replace(self.estimator, **self.best).fit(self.train)
        return dataclasses.replace(model, findings={**model.findings, "search": self.as_dict()})

    def frame(self) -> pd.DataFrame:
        """Return the cost table: settings, fits on the hold-out [%], size, time and why a trial has no fit."""
        import pandas as pd

        rows = [
            {
                **{name: _cell(value) for name, value in trial.settings.items()},
                **{f"free_run_{axis}": fit for axis, fit in trial.free_run.items()},
                **{f"one_step_{axis}": fit for axis, fit in trial.one_step.items()},
                "score": trial.score,
                "error": trial.error,
                "size": trial.size,
                "seconds": trial.seconds,
                "diverged": trial.diverged,
                "reason": trial.reason,
                "chosen": trial is self.chosen,
            }
            for trial in self.trials
        ]
        return pd.DataFrame(rows)

    def as_dict(self) -> dict[str, Any]:
        """Return the search as JSON values."""
        return {
            "best": self.best,
            "rule": self.rule,
            "fitted_on": f"{len(self.train)} training rows; the hold-out is not among them",
            "remarks": list(self.remarks),
            "interrupted": self.interrupted,
            "curves": self.curves,
            "trials": [trial.as_dict() for trial in self.trials],
        }


@one_blas_thread
def search(
    estimator: Estimator,
    vary: Mapping[str, Sequence[Any]],
    train: Recording,
    hold_out: Recording,
    *,
    strategy: str = "grid",
    rule: str = "one_standard_error",
    workers: int = 2,
    progress: Progress = silent,
) -> Search:
    """Fit an estimator with many settings on `train` and score each by its free run over `hold_out`.

    Trials run in threads: what takes long in a fit is compiled or BLAS, and lets go of Python's lock. Ctrl-C keeps
    what was done if any trial has a fit.

    Args:
        estimator: settings object, such as `Rls()` or `SetMembership(form="lags")`.
        vary: field of the estimator -> values to try.
        train: what each trial is fitted on.
        hold_out: a recording of another excitation, which no trial sees.
        strategy: "grid", all combinations; or "coordinate": from the first values, the best of one setting after
            the other, forth and back until a sweep changes nothing.
        rule: "one_standard_error", the smallest model as good as the best, or "best".
        workers: threads.
        progress: told how much is done.

    Raises:
        SettingsError: an unknown field, nothing to vary, or too many trials.
        DataError: a hold-out of another robot, that is too short or holds training rows, or no trial can run free.
    """
    require_same_robot(hold_out.robot, train.robot, "the recordings of a search")
    require_one_of("strategy", strategy, STRATEGIES)
    require_one_of("rule", rule, RULES)
    require_whole("workers", workers, 1, 256)
    given = {name: list(values) for name, values in vary.items()}
    _check(estimator, given, strategy)
    if all(len(run) <= MIN_HOLD_OUT for run in hold_out.runs()):
        raise DataError(f"no run of the hold-out is longer than {MIN_HOLD_OUT} rows; record a longer one.")
    seen = int(known_rows(hold_out, row_hashes(train)).sum())
    if seen:
        raise DataError(f"{seen} rows of the hold-out are training rows; hold out a recording of another excitation.")
    runner = _Runner(estimator, given, train, hold_out, workers, progress)
    interrupted = False
    try:
        runner.sweep() if strategy == "coordinate" else runner.run(itertools.product(*runner.ranges))
    except KeyboardInterrupt:
        interrupted = True
        if not any(np.isfinite(trial.score) for trial in runner.done.values()):
            raise
    order = sorted(runner.done) if strategy == "grid" else list(runner.done)
    trials = tuple(runner.done[index] for index in order)
    if not any(np.isfinite(trial.score) for trial in trials):
        raise DataError(f"none of {len(trials)} settings can run free on the hold-out; the first: {trials[0].reason}")
    remarks = (_SAME_EXCITATION,) if _continues(train, hold_out) else ()
    return Search(estimator, given, trials, rule, remarks, interrupted, train)


class _Runner:
    """The trials of one search, each done once."""

    def __init__(
        self,
        estimator: Any,
        vary: dict[str, list[Any]],
        train: Recording,
        hold_out: Recording,
        workers: int,
        progress: Progress,
    ) -> None:
        self.estimator, self.vary, self.train, self.hold_out = estimator, vary, train, hold_out
        self.workers, self.progress = workers, progress
        self.ranges = [range(len(values)) for values in vary.values()]
        self.done: dict[tuple[int, ...], Trial] = {}

    def run(self, indices: Iterator[tuple[int, ...]] | list[tuple[int, ...]]) -> None:
        """Do all trials of `indices` that are not done yet; on Ctrl-C those that are done stay done."""
        todo = [index for index in indices if index not in self.done]
        ready: dict[tuple[int, ...], Trial] = {}
        with ThreadPoolExecutor(self.workers) as pool:
            try:
                futures: dict[Future[Trial], tuple[int, ...]] = {
                    pool.submit(attempt, self.estimator, settings_of(self.vary, i), self.train, self.hold_out): i
                    for i in todo
                }
                for future in as_completed(futures):
                    ready[futures[future]] = trial = future.result()
                    words = ", ".join(f"{name}={value}" for name, value in trial.settings.items())
                    self.progress(len(ready) / len(todo), words)
            finally:
                # What runs ends by itself; what waits never starts.
                pool.shutdown(wait=False, cancel_futures=True)
                # In their order, whichever thread was first.
                self.done |= {index: ready[index] for index in todo if index in ready}

    def sweep(self) -> None:
        """Go along one coordinate after the other, forth and back, until nothing changes."""
        here = tuple(0 for _ in self.ranges)
        while True:
            before = here
            for axis in [*range(len(here)), *reversed(range(len(here) - 1))]:
                line = [(*here[:axis], i, *here[axis + 1 :]) for i in self.ranges[axis]]
                self.run(line)
                here = max(line, key=lambda index: self.done[index].score)
            if here == before:
                return


def _check(estimator: Any, vary: dict[str, list[Any]], strategy: str) -> None:
    fields = sorted(field.name for field in dataclasses.fields(estimator))
    for name, values in vary.items():
        if name not in fields:
            raise SettingsError(f"there is no setting `{name}` to search; this kind has {', '.join(fields)}.")
        if not values:
            raise SettingsError(f"there is no value of `{name}` to try.")
    if not vary:
        raise SettingsError("there is nothing to vary; name a setting and its values.")
    count = int(np.prod([float(len(values)) for values in vary.values()]))
    if strategy == "grid" and count > _MOST_TRIALS:
        raise SettingsError(f"a grid of {count} settings is too large; take strategy `coordinate`.")


def _continues(train: Recording, hold_out: Recording) -> bool:
    """Whether a run of the hold-out starts at the sample after the end of a run of the training rows."""
    ends = [(run.time[-1], run.set_points[-1]) for run in train.runs()]
    for run in hold_out.runs():
        for time, _ in ends:
            if abs(run.time[0] - time - train.sample_time) < 0.5 * train.sample_time:
                return True
    return False


def _curve_row(trials: Sequence[Trial], name: str, value: Any, axes: Sequence[str]) -> list[Any]:
    there = [trial for trial in trials if trial.settings[name] == value]
    best = max(there, key=lambda trial: trial.score, default=None)
    if best is None:
        return [_cell(value), *[None] * (2 * len(axes))]
    return [_cell(value), *best.free_run.values(), *best.one_step.values()]


def _cell(value: Any) -> Any:
    """Return a value as JSON, CSV and a table can hold it."""
    return value if isinstance(value, int | float | str) or value is None else str(value)
