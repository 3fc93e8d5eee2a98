"""Honest validation: every model beside persistence and the best linear one, one step, k steps and in simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    ReprMixin,
    SettingsError,
    Vector,
    one_blas_thread,
    require_one_of,
    resolve,
    silent,
    to_si,
)
from softneck.robot import Robot, load_for_robot
from softneck.signals import Recording, RecordingLike, open_recording

from ..models._fitting import known_rows
from ..models._model import Model
from ..models._validity import with_tolerance
from ._baselines import Baselines, baselines
from ._error_statistics import (
    ResidualTests,
    calibrated_bounds,
    judged_bounds,
    judged_validity,
    residual_tests,
    useful_parts,
)
from ._score_tables import (
    INFINITE,
    Rows,
    ScoredSegment,
    coverage_tables,
    divergence,
    free_run_bounds,
    interval_tables,
    join_segments,
    outside_table,
    predict,
    run_tables,
    score_tables,
    unseen_segments,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_HORIZONS = (1, 5, 25, INFINITE)
# Kinds whose bounds are guaranteed under an assumption.
_GUARANTEED_KINDS = ("nlsm",)

Scores = dict[str, dict[str, float | None]]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Validation(ReprMixin):
    """The scores of one model on one recording.

    Scores are tables horizon -> axis -> value ("1", ..., "inf"; "pitch", "roll"), None where the simulation diverged or
    nothing was measured or moved; all but `per_run` are over the rows of all runs together.

    Attributes:
        model, data: their names.
        rows_scored, rows_left_out: rows judged, and rows left out because the model was trained on them.
        rows_trained: rows judged although the model was trained on them (`include_training`).
        rows_by_horizon: rows judged at each horizon: those with so much past, and of long records not all.
        persistence, fits: fit [%] of repeating the last sample, and of the model.
        rmse_deg, r2: root mean square error [deg], of another robot in its `display_unit`; R2 = 1 - SSE/SST.
        worst_deg, worst_time: largest absolute error [deg] and when it was [s].
        intervals: 95 % interval [low, high] of `fits` by a bootstrap over blocks.
        best_linear: fit [%] that no linear model of the set-points beats on these rows (see `best_linear`).
        per_run: the same scores for each segment of rows that follow each other, with its `stretch`, `run`,
            `start_s`, `rows_scored` and `diverged`.
        cold_fits: fit [%] of a simulation that knows the first row only, as an FMU starts, on the same rows; None where
            it diverged.
        diverged: time [s] at which the first simulation left the data's range, or None.
        residual_tests: of the one-step errors; `white` and `uncorrelated` are their verdicts.
        coverage_pct, mean_width_deg: of kinds with bounds in simulation: axis -> measured samples within them [%], and
            their mean distance [deg], None where that is more than the range of the data; None for other kinds.
        bounds_remarks: where these bounds are of no use or do not hold what they promise.
        calibrated_bounds: of every kind, from nine or more segments: see `_error_statistics`; else why there are none.
        outside_pct: axis -> measured samples [%] outside what the model has seen: of set membership where its bounds
            are wider than training's usually are (see `is_extrapolating`), of other kinds where a set-point lies beyond
            those that it was trained on; None where the model does not know.
        validity: least and mean of the model's own in simulation, and how well it foretold errors within its tolerance
            (see `judged_validity`); None where the model has none.
        time, run: (time,) [s] and the number of the segment, for plots: no line joins two of them.
        measured, free_run, one_step: (time, 2) [rad], NaN where nothing is scored.
        lower, upper: (time, 2) [rad] bounds of the simulation, NaN where none is narrower than the data.
        robot: whose outputs these are; of another than the neck they have its number and SI unit.
    """

    model: str
    data: str
    rows_scored: int
    rows_left_out: int
    rows_trained: int
    rows_by_horizon: dict[str, int]
    persistence: Scores
    fits: Scores
    rmse_deg: Scores
    r2: Scores
    worst_deg: Scores
    worst_time: Scores
    intervals: dict[str, dict[str, list[float] | None]]
    best_linear: Scores
    per_run: list[dict[str, Any]]
    cold_fits: dict[str, float | None]
    diverged: float | None
    residual_tests: ResidualTests
    coverage_pct: dict[str, float] | None
    mean_width_deg: dict[str, float | None] | None
    bounds_remarks: tuple[str, ...]
    calibrated_bounds: dict[str, Any]
    outside_pct: dict[str, float] | None
    validity: dict[str, Any] | None
    time: Vector
    run: np.ndarray
    measured: Matrix
    free_run: Matrix
    one_step: Matrix
    lower: Matrix
    upper: Matrix
    robot: Robot = field(default_factory=Robot.preset)

    def summary(self) -> str:
        """Return two lines: model, data and rows, and the simulation fits."""
        fits = self.fits.get("inf", {})
        said = ", ".join(f"{axis} {'-' if fit is None else f'{fit:.1f} %'}" for axis, fit in fits.items())
        return f"{self.model} on {self.data}, {self.rows_scored} rows judged\nfree run: {said or 'not asked for'}"

    def plot(self, title: str = "") -> Figure:
        """Return a matplotlib figure of measurement, simulation and one-step prediction, with bounds and errors."""
        bounds = (self.lower, self.upper) if np.isfinite(self.lower).any() else None
        draw = resolve("softneck.plots:validation_figure")
        return draw(
            self.time, self.measured, {"simulation": self.free_run, "one step": self.one_step},
            title or f"{self.model} on {self.data}", bounds=bounds, run=self.run, robot=self.robot,
        )  # fmt: skip

    @property
    def white(self) -> bool:
        """Whether the one-step errors are white noise, as far as 25 lags tell (99 %)."""
        return self.residual_tests.white

    @property
    def uncorrelated(self) -> bool:
        """Whether the one-step errors follow no input at lags 0 to 25 (99 %)."""
        return self.residual_tests.uncorrelated

    @property
    def measured_range(self) -> dict[str, list[float] | None]:
        """Output -> smallest and largest value that was scored, in its display unit; None where none was."""
        shown = self.measured / to_si(self.robot.outputs.display_unit)[0]
        there = np.isfinite(shown)
        return {
            name: [float(y[good].min()), float(y[good].max())] if good.any() else None
            for name, y, good in zip(self.robot.outputs.names, shown.T, there.T, strict=True)
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of the public face's JSON; of outputs in another unit than deg `rmse_deg` is `rmse`."""
        entry = self._entry()
        unit = self.robot.outputs.display_unit
        if unit == "deg":
            return entry
        runs = [_without_deg(part) for part in entry["per_run"]]
        return {**_without_deg(entry), "per_run": runs, "unit": unit}

    def _entry(self) -> dict[str, Any]:
        return {
            "model": self.model,
            "data": self.data,
            "rows_scored": self.rows_scored,
            "rows_left_out": self.rows_left_out,
            "rows_trained": self.rows_trained,
            "rows_by_horizon": self.rows_by_horizon,
            "measured_range": self.measured_range,
            "fits": {"persistence": self.persistence, "model": self.fits, "best_linear": self.best_linear},
            "intervals": self.intervals,
            "rmse_deg": self.rmse_deg,
            "worst_deg": self.worst_deg,
            "worst_time_s": self.worst_time,
            "r2": self.r2,
            "diverged": self.diverged,
            "cold_fits": self.cold_fits,
            "residuals": {
                "white": self.white,
                "uncorrelated_with_inputs": self.uncorrelated,
                **self.residual_tests.as_dict(self.robot.outputs.names),
            },
            "coverage_pct": self.coverage_pct,
            "mean_width_deg": self.mean_width_deg,
            "bounds_remarks": list(self.bounds_remarks),
            "calibrated_bounds": self.calibrated_bounds,
            "outside_pct": self.outside_pct,
            "validity": self.validity,
            "per_run": self.per_run,
        }


def _without_deg(table: dict[str, Any]) -> dict[str, Any]:
    return {key.removesuffix("_deg"): value for key, value in table.items()}


@dataclass(frozen=True, slots=True)
class Rules:
    """How models are judged; see `validate`."""

    horizons: tuple[int | str, ...] = _HORIZONS
    motors: str = "simulated"
    include_training: bool = False
    tolerance: float | None = None

    def __post_init__(self) -> None:
        require_one_of("motors", self.motors, ("simulated", "measured"))
        for horizon in self.horizons:
            if horizon != INFINITE and (not isinstance(horizon, int) or horizon < 1):
                raise DataError(f"a horizon is a number of samples from 1, or `inf`; got {horizon!r}.")


@one_blas_thread
def validate(
    model: Model | str | Path,
    recording: RecordingLike,
    *,
    names: tuple[str, str] | None = None,
    horizons: Sequence[int | str] = _HORIZONS,
    motors: str = "simulated",
    include_training: bool = False,
    tolerance: float | None = None,
) -> Validation:
    """Judge a model on the rows of a recording that it was not trained on.

    Each segment of unseen rows starts from 25 measured samples, which are not scored. A simulation then has the
    set-points alone, or the logged motor positions as well (`motors="measured"`). `cold_fits` are of a simulation that
    had the first row only.

    Args:
        model: of any kind, or its file.
        recording: at the model's sample time, its file, or what else `identify` takes; its runs are never joined.
        names: of model and data, for reports; the files' where files are given.
        horizons: samples ahead; "inf" is the simulation.
        motors: "simulated" or "measured".
        include_training: whether rows that the model was trained on are judged too.
        tolerance: error that `validity` is to allow, in the unit in which people see the outputs; None: the model's.

    Raises:
        FileFormatError: no such file, or not one of ours.
        DataError: nothing is left to judge, another sample time, no motor positions to measure, or a horizon longer
            than every segment.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> train, rest = recording.split(0.7)
        >>> found = softneck.validate(softneck.identify("rls", train), rest)
        >>> bool(found.fits["inf"]["pitch"] > 50.0)  # simulation [%]
        True
    """
    rules = Rules(tuple(horizons), motors, include_training, tolerance)
    if names is None:
        model_name, data_name = (str(of) if isinstance(of, str | Path) else None for of in (model, recording))
        names = (model_name or "model", data_name or "data")
    judged: Model = load_for_robot(model, "model")
    parts = judged_parts(judged, open_recording(recording), rules)
    return judge(judged, parts, rules, names=names)


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """The scored part of a recording, with its baselines."""

    segments: list[ScoredSegment]
    left_out: int
    trained: int
    rows: Rows
    baselines: Baselines


def judged_parts(
    model: Model, recording: Recording, rules: Rules, known: dict[bytes, Baselines] | None = None
) -> Parts:
    """Return the segments without training rows; `known` keeps the baselines of equal rows."""
    model.check(recording)  # its sample time, before anything is computed
    if rules.motors == "measured" and not recording.has_motor_positions:
        raise DataError(
            "motors=measured needs logged motor positions and the recording has none; judge it with --motors simulated."
        )
    if not np.isfinite(recording.outputs).any():
        names = " nor ".join(recording.robot.outputs.names)
        raise DataError(f"neither {names} was ever measured; there is nothing to judge.")
    hashes = np.zeros(0, dtype=np.uint64) if rules.include_training else model.training_rows
    segments, left_out = unseen_segments(recording, hashes)
    trained = int(known_rows(recording, model.training_rows).sum()) if rules.include_training else 0
    longest = max(len(s.recording) for s in segments)
    finite = [int(h) for h in rules.horizons if h != INFINITE]
    if finite and max(finite) >= longest:
        raise DataError(
            f"a horizon of {max(finite)} samples is longer than what is judged: the longest segment of rows that the "
            f"model was not trained on has {longest}."
        )
    rows = join_segments(segments)
    key = np.isfinite(rows.measured).tobytes() + rows.segment.tobytes() + rows.time.tobytes()
    known = {} if known is None else known
    if key not in known:
        known[key] = baselines(segments, rows, rules.horizons)
    return Parts(segments, left_out, trained, rows, known[key])


def judge(model: Model, parts: Parts, rules: Rules, *, names: tuple[str, str]) -> Validation:
    """Return the validation of a model on its parts of a recording."""
    if rules.tolerance is not None:
        model = with_tolerance(model, rules.tolerance)
    rows, horizons = parts.rows, [str(h) for h in rules.horizons]
    axes = len(rows.names)
    outputs = _predictions(model, parts, rules)
    lost: list[float | None] = [None] * len(parts.segments)
    if INFINITE in outputs:
        lost = divergence(rows, outputs[INFINITE][:, :axes])
    first = min((t for t in lost if t is not None), default=None)
    measured = {h: rows.outputs_at(None if h == INFINITE else int(h)) for h in horizons}
    predicted = {h: outputs[h][:, :axes] for h in horizons}
    scores = score_tables(rows, rows.time, measured, predicted, lost=first is not None)
    tests = residual_tests(rows.measured - outputs["1"][:, :axes], rows.set_points, rows.segment)
    free = outputs.get(INFINITE, np.full((rows.time.size, axes), np.nan))
    lower, upper = free_run_bounds(model.kind, free, rows.robot)
    coverage, width = coverage_tables(rows, rows.measured, lower, upper)
    useful_width, said = judged_bounds(rows, coverage, width, promised=model.kind in _GUARANTEED_KINDS)
    if first is None and INFINITE in outputs:
        calibrated = calibrated_bounds(rows, rows.measured - free[:, :axes])
    else:
        calibrated = {"reason": "there is no simulation, or it diverged"}
    lower, upper = useful_parts(rows, lower, upper)
    per_run = run_tables(parts.segments, rows, measured, predicted, lost)
    return Validation(
        model=names[0],
        data=names[1],
        rows_scored=int(sum(segment.scored.sum() for segment in parts.segments)),
        rows_left_out=parts.left_out,
        rows_trained=parts.trained,
        rows_by_horizon={h: int(np.isfinite(y).any(axis=1).sum()) for h, y in measured.items()},
        persistence=parts.baselines.persistence,
        **scores,
        intervals=interval_tables(rows, measured, predicted, model.sample_time, lost=first is not None),
        best_linear=parts.baselines.best_linear,
        per_run=per_run,
        cold_fits=_cold_fits(model, parts, rules) if INFINITE in outputs else dict.fromkeys(rows.names),
        diverged=first,
        residual_tests=tests,
        coverage_pct=coverage,
        mean_width_deg=useful_width,
        bounds_remarks=tuple(said),
        calibrated_bounds=calibrated,
        outside_pct=outside_table(model, rows, free),
        validity=judged_validity(model, rows, free),
        time=rows.time,
        run=rows.segment,
        measured=rows.measured,
        free_run=free[:, :axes],
        one_step=outputs["1"][:, :axes],
        lower=lower,
        upper=upper,
        robot=rows.robot,
    )


def _cold_fits(model: Model, parts: Parts, rules: Rules) -> dict[str, float | None]:
    """Return the fit [%] of each output in simulation from the first row of each segment; None where it diverged."""
    rows = parts.rows
    free = np.concatenate([model.simulate(s.recording, motors=rules.motors, warm_up=0) for s in parts.segments])
    free = free[:, : len(rows.names)]
    lost = divergence(rows, free)
    measured = {INFINITE: rows.measured}
    gone = any(t is not None for t in lost)
    return score_tables(rows, rows.time, measured, {INFINITE: free}, lost=gone)["fits"][INFINITE]


def _predictions(model: Model, parts: Parts, rules: Rules) -> dict[str, Matrix]:
    """Return horizon -> outputs (time, n_out) of all segments; one step ahead always, for the residual tests."""
    runs = [segment.recording for segment in parts.segments]
    result: dict[str, Matrix] = {}
    for horizon in dict.fromkeys((1, *rules.horizons)):
        if horizon == INFINITE:
            free = [model.simulate(run, motors=rules.motors) for run in runs]
            result[INFINITE] = np.concatenate(free)
        else:
            k = int(horizon)
            result[str(k)] = predict(model, runs, k, motors=rules.motors, stride=parts.rows.stride(k))
    return result


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison(ReprMixin):
    """The scores of every model on every recording.

    Attributes:
        validations: model by model, each on all recordings.
    """

    validations: tuple[Validation, ...]

    def frame(self) -> pd.DataFrame:
        """Return one row for each model, data set, horizon and axis, ready to pivot.

        Columns: model, data, horizon, axis, fit, low, high (95 % interval), persistence, best_linear [%],
        rmse_deg, worst_deg, worst_time_s, r2, rows_scored, diverged_s; NaN where there is none.
        """
        import pandas as pd

        rows = [row for v in self.validations for row in _rows(v)]
        return pd.DataFrame(rows).astype(dict.fromkeys(_NUMERIC_COLUMNS, float))

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON of the public face."""
        return {"models": [validation.as_dict() for validation in self.validations]}


_NUMERIC_COLUMNS = (
    "fit", "low", "high", "persistence", "best_linear", "rmse_deg", "worst_deg", "worst_time_s", "r2",
    "diverged_s",
)  # fmt: skip


def compare(
    models: Model | Mapping[str, Model] | Sequence[Model],
    recordings: Recording | Mapping[str, Recording] | Sequence[Recording],
    *,
    rules: Rules | None = None,
    progress: Progress = silent,
) -> Comparison:
    """Judge every model on every recording, each on the rows it was not trained on.

    Args:
        models: by name; without names they are called by their kind.
        recordings: by name; without names "data 1", "data 2", ...
        rules: horizons, motors, include_training, tolerance (see `validate`).
        progress: called with the part done and a word on it.

    Raises:
        SettingsError: no model or no recording.
        DataError: as `validate`.
    """
    rules = Rules() if rules is None else rules
    models = [models] if isinstance(models, Model) else models
    recordings = [recordings] if isinstance(recordings, Recording) else recordings
    named_models = _name_all(models, [m.kind for m in models] if not isinstance(models, Mapping) else [])
    named_data = _name_all(recordings, [f"data {i + 1}" for i in range(len(recordings))])
    if not named_models or not named_data:
        raise SettingsError("`compare` needs at least one model and one recording.")
    known: dict[str, dict[bytes, Baselines]] = {name: {} for name, _ in named_data}
    results: list[Validation] = []
    for model_name, model in named_models:
        for data_name, recording in named_data:
            progress(len(results) / (len(named_models) * len(named_data)), f"{model_name} on {data_name}")
            try:
                parts = judged_parts(model, recording, rules, known[data_name])
                results.append(judge(model, parts, rules, names=(model_name, data_name)))
            except DataError as error:
                raise DataError(f"{model_name} on {data_name}: {error}") from error
    return Comparison(tuple(results))


def _name_all(things: Mapping[str, Any] | Sequence[Any], names: list[str]) -> list[tuple[str, Any]]:
    if isinstance(things, Mapping):
        return list(things.items())
    # Two of a kind are told apart by their number.
    return [
        (name if names.count(name) == 1 else f"{name} {names[: i + 1].count(name)}", thing)
        for i, (name, thing) in enumerate(zip(names, things, strict=True))
    ]


def _rows(v: Validation) -> list[dict[str, Any]]:
    rows = []
    for horizon, fits in v.fits.items():
        for axis, fit in fits.items():
            low, high = v.intervals[horizon][axis] or (None, None)
            rows.append(
                {
                    "model": v.model,
                    "data": v.data,
                    "horizon": horizon,
                    "axis": axis,
                    "fit": fit,
                    "low": low,
                    "high": high,
                    "persistence": v.persistence.get(horizon, {}).get(axis),
                    "best_linear": v.best_linear[horizon][axis],
                    "rmse_deg": v.rmse_deg[horizon][axis],
                    "worst_deg": v.worst_deg[horizon][axis],
                    "worst_time_s": v.worst_time[horizon][axis],
                    "r2": v.r2[horizon][axis],
                    "rows_scored": v.rows_scored,
                    "diverged_s": v.diverged if horizon == "inf" else None,
                }
            )
    return rows
