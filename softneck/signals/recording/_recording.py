"""The recording: named channels over time, in SI, in one or more separate runs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, Matrix, ReprMixin, Vector, finite_matrix, require_between, resolve
from softneck.robot import Robot, Scaling, find_robot, round_scaled, scaled_robot

from ._channels import NECK, known_channels, may_miss

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

# Share of the sample time that a logger's jitter may reach; a discrete-time fit needs equidistant samples.
MAX_JITTER = 0.02
# [s] Rounding of printed times.
_TIME_ROUNDING_S = 1e-9


def uneven_steps(time: Vector, sample_time: float, run: np.ndarray) -> np.ndarray:
    """Return (time - 1,) the steps inside a run that differ from `sample_time` [s] by more than a logger's jitter."""
    off = np.abs(np.diff(time) - sample_time) > max(MAX_JITTER * sample_time, _TIME_ROUNDING_S)
    return off & (np.diff(run) == 0)


def check_times(time: Vector, sample_time: float, run: np.ndarray) -> None:
    """Raise DataError if `time` (time,) [s] falls or jumps inside a run."""
    check_rising(time, run)
    step = np.diff(time)
    jump = uneven_steps(time, sample_time, run)
    if jump.any():
        row = int(np.argmax(jump)) + 1
        raise DataError(
            f"`time` jumps by {step[row - 1]:.6g} s at row {row} (t = {time[row]:g} s) where the "
            f"sample time is {sample_time:.6g} s; fill the gap, split the record there by "
            "the `run` column, or let `softneck import --guess` do it (it evens jitter out too)."
        )


def check_rising(time: Vector, run: np.ndarray, *, may_stand: bool = False) -> None:
    """Raise DataError if `time` (time,) is not finite or does not rise inside a run (`may_stand`: falls)."""
    if not np.isfinite(time).all():
        raise DataError(f"`time` is not finite at row {int(np.argmax(~np.isfinite(time)))}.")
    step = np.diff(time)
    back = (np.diff(run) == 0) & ((step < 0) if may_stand else (step <= 0))
    if back.any():
        row = int(np.argmax(back)) + 1
        raise DataError(
            f"`time` runs backwards or stands still at row {row} ({time[row - 1]:g} to {time[row]:g} s); "
            "where a new experiment starts there, give it another number in the `run` column."
        )


def median_step(time: Vector, run: np.ndarray) -> float:
    """Return the sample time [s] of a time column: the mean of its regular steps."""
    if time.size < 2:
        raise DataError(f"a recording needs at least 2 rows; got {time.size}.")
    step = np.diff(time)
    inside = step[np.diff(run) == 0] if run.size else step
    positive = inside[inside > 0]
    if positive.size == 0:
        raise DataError("`time` never increases; it must rise by the sample time from row to row.")
    typical = float(np.median(positive))
    near = positive[np.abs(positive - typical) < 0.5 * typical]
    # The mean averages the rounding of printed times; no clock has more than ten digits.
    return float(f"{near.mean():.10g}")


# [s] Used if neither the caller nor the robot gives one.
_DEFAULT_SAMPLE_TIME_S = 0.02
# No robot is recorded faster than at 1 GHz, or once in 30 years [s].
_SAMPLE_TIMES = 1e-9, 1e9
_FILES_MODULE = "softneck.signals.recording._files"  # resolved by name: `_files` imports this module


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Recording(ReprMixin):
    """Samples of one or more experiments at one sample time.

    Attributes:
        time: (time,) [s], equidistant within each run; may restart with a new run.
        sample_time: [s].
        channels: name -> (time,) in SI; set-points and outputs are required. NaN is a missed sample.
        run: (time,) integers, constant over each experiment; 0 everywhere if not given.
        robot: the paper's neck if not given.

    Example:
        >>> import numpy as np
        >>> import softneck
        >>> P = np.sin(np.arange(500) * 0.02)[:, None] * [1.0, -0.5, -0.5]
        >>> recording = softneck.Recording.from_arrays(P, 0.08 * P[:, :2])
        >>> len(recording), recording.sample_time
        (500, 0.02)
        >>> float(recording.outputs.max().round(3))
        0.08
    """

    time: Vector
    sample_time: float
    channels: Mapping[str, Vector]
    run: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    robot: Robot = NECK

    def __post_init__(self) -> None:
        require_between("sample_time", self.sample_time, *_SAMPLE_TIMES, "s")
        time = np.ascontiguousarray(self.time, dtype=np.float64)
        run = np.zeros(time.size, dtype=np.int64) if self.run.size == 0 else self.run.astype(np.int64)
        channels = {
            self.robot.own(name): np.ascontiguousarray(c, dtype=np.float64) for name, c in self.channels.items()
        }
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "run", run)
        object.__setattr__(self, "channels", channels)
        self._check_channels()
        check_times(time, self.sample_time, run)

    @classmethod
    def from_arrays(
        cls,
        set_points: ArrayLike,
        outputs: ArrayLike | None = None,
        *,
        motor_positions: ArrayLike | None = None,
        sample_time: float | None = None,
        run: ArrayLike | None = None,
        robot: Robot | str | Path | None = None,
    ) -> Recording:
        """Return the recording of arrays in SI, whose rows are equidistant; each run begins at 0 s.

        Args:
            set_points: (time, motors).
            outputs: (time, outputs), NaN for missed samples; None: not measured.
            motor_positions: (time, motors), if logged.
            sample_time: [s]; the robot's, or 0.02, if not given.
            run: (time,) numbers of the runs; one run if not given.
            robot: a robot, its file or a preset; the paper's neck if not given.

        Raises:
            DataError: shapes do not fit each other or the robot.
        """
        whose = find_robot(robot)
        names = (whose.set_points, whose.outputs.names, whose.motor_positions)
        U = finite_matrix("set_points", set_points, len(names[0]))
        given = (U, np.full((len(U), len(names[1])), np.nan) if outputs is None else outputs, motor_positions)
        channels = {
            name: column
            for what, known, values in zip(("set_points", "outputs", "motor_positions"), names, given, strict=True)
            if values is not None
            for name, column in zip(known, finite_matrix(what, values, len(known), missing=True).T, strict=True)
        }
        numbers = np.zeros(len(U), dtype=np.int64) if run is None else np.asarray(run)
        if numbers.shape != (len(U),) or numbers.dtype.kind not in "iu":
            raise DataError(f"`run` must be integers of shape {(len(U),)}; got {numbers.dtype} {numbers.shape}.")
        step = (whose.sample_time_s or _DEFAULT_SAMPLE_TIME_S) if sample_time is None else sample_time
        begins = np.maximum.accumulate(np.where(np.append(True, np.diff(numbers) != 0), np.arange(len(U)), 0))
        return cls((np.arange(len(U)) - begins) * step, step, channels, numbers, whose)

    @classmethod
    def from_pandas(cls, frame: pd.DataFrame, *, robot: Robot | str | Path | None = None) -> Recording:
        """Return the recording of a table in the format of a file: `time [s]`, `pitch [deg]`, ...

        Raises:
            DataError: columns, units, numbers or times do not fit the robot.
        """
        return resolve(f"{_FILES_MODULE}:from_frame")(frame, robot)

    def to_pandas(self) -> pd.DataFrame:
        """Return a table in the format of a file; `from_pandas` reads it."""
        return resolve(f"{_FILES_MODULE}:recording_frame")(self)

    def plot(self, title: str = "") -> Figure:
        """Return a matplotlib figure of set-points and outputs in display units."""
        chart, figure = (
            resolve(f"softneck.plots.{name}") for name in ("_charts:recording_chart", "_chart:chart_figure")
        )
        return figure(chart(self, title))

    def __len__(self) -> int:
        return self.time.size

    def summary(self) -> str:
        """Return two lines that summarise the recording."""
        runs = np.count_nonzero(np.diff(self.run)) + (len(self) > 0)
        names = [name for name in self.channels if name not in self.robot.set_points]
        return (
            f"{len(self)} rows of {1e3 * self.sample_time:g} ms in {runs} run(s), robot {self.robot.name}\n"
            f"set-points of {len(self.robot.set_points)} motors, {', '.join(names)}"
        )

    @property
    def set_points(self) -> Matrix:
        """(time, motors) set-points in SI; of the neck (time, 3) [rad]."""
        return np.column_stack([self.channels[name] for name in self.robot.set_points])

    @property
    def outputs(self) -> Matrix:
        """(time, outputs) in SI: of the neck (time, 2), pitch and roll [rad]; NaN where a sample was missed."""
        return np.column_stack([self.channels[name] for name in self.robot.outputs.names])

    @property
    def has_motor_positions(self) -> bool:
        """Whether motor positions were logged."""
        return all(name in self.channels for name in self.robot.motor_positions)

    @property
    def motor_positions(self) -> Matrix:
        """(time, motors) measured motor positions in SI; the set-points if none were logged."""
        if not self.has_motor_positions:
            return self.set_points
        return np.column_stack([self.channels[name] for name in self.robot.motor_positions])

    def runs(self) -> tuple[Recording, ...]:
        """Return each run as a recording of its own."""
        borders = np.flatnonzero(np.diff(self.run)) + 1
        edges = [0, *borders.tolist(), len(self)]
        return tuple(self.rows(start, stop) for start, stop in itertools.pairwise(edges))

    def rows(self, start: int, stop: int) -> Recording:
        """Return rows start to stop (not included)."""
        part = slice(start, stop)
        channels = {name: values[part] for name, values in self.channels.items()}
        return Recording(self.time[part], self.sample_time, channels, self.run[part], self.robot)

    def split(self, fraction: float) -> tuple[Recording, Recording]:
        """Return the first `fraction` of each run's rows and the rest.

        Raises:
            DataError: `fraction` is not in (0, 1), or one of the parts is empty.
        """
        if not 0.0 < fraction < 1.0:
            raise DataError(f"the part to split off must be between 0 and 1, without both; got {fraction:g}.")
        heads: list[Recording] = []
        tails: list[Recording] = []
        for run in self.runs():
            border = round(fraction * len(run))
            if border > 0:
                heads.append(run.rows(0, border))
            if border < len(run):
                tails.append(run.rows(border, len(run)))
        if not heads or not tails:
            raise DataError(f"{len(self)} rows cannot be split at {fraction:g}: one part would be empty.")
        return concatenate(heads), concatenate(tails)

    def with_channels(self, **channels: Vector) -> Recording:
        """Return the same recording with channels added or replaced."""
        return replace(self, channels={**self.channels, **{self.robot.own(name): c for name, c in channels.items()}})

    def _check_channels(self) -> None:
        required, known = (*self.robot.set_points, *self.robot.outputs.names), known_channels(self.robot)
        missing = [name for name in required if name not in self.channels]
        if missing:
            raise DataError(
                f"a recording of robot {self.robot.label()} needs the channels {', '.join(required)}; "
                f"missing: {', '.join(missing)}."
            )
        if len(self) == 0:
            raise DataError("the recording has no rows.")
        for name, values in self.channels.items():
            if name not in known or name == "time":
                raise DataError(f"`{name}` is not a channel of a recording; known: {', '.join(known)}.")
            if values.shape != (len(self),):
                raise DataError(f"channel `{name}` has shape {values.shape}; time has {(len(self),)}.")
            bad = np.isinf(values) if may_miss(name, self.robot) else ~np.isfinite(values)
            if bad.any():
                row = int(np.argmax(bad))
                raise DataError(
                    f"channel `{name}` is {values[row]} at row {row} (t = {self.time[row]:g} s); "
                    "it must be finite. Fix the log or cut it before that row."
                )
        for name in self.robot.outputs.names:
            far = np.abs(self.channels[name]) > self.robot.angle_limit
            if far.any():
                row = int(np.argmax(far))
                raise DataError(
                    f"channel `{name}` is {self.channels[name][row]:g} rad at row {row}, more than half a turn; "
                    "is it in degrees? Say so in its unit."
                )
        if self.run.shape != (len(self),):
            raise DataError(f"`run` has shape {self.run.shape}; time has {(len(self),)}.")


def concatenate(recordings: Sequence[Recording], *, names: Sequence[str] = ()) -> Recording:
    """Return recordings of one sample time as separate runs of one; only channels of all are kept.

    If some have the channel `payload`, the payload of the others is 0. Messages use `names`.

    Raises:
        DataError: none given, or sample times or robots differ.
    """
    if not recordings:
        raise DataError("there is no recording to work on; the part to train on is empty.")
    first = recordings[0]
    parts: list[Recording] = []
    called = names or [f"recording {number}" for number in range(1, len(recordings) + 1)]
    for name, recording in zip(called, recordings, strict=True):
        if not math.isclose(recording.sample_time, first.sample_time, rel_tol=1e-6):
            raise DataError(
                f"recordings of different sample times cannot be used together: {first.sample_time:g} s and "
                f"{recording.sample_time:g} s ({called[0]} and {name}). Work on each by itself, or bring one to the "
                "other's (`softneck import REC --resample S`, `softneck.signals.resampled`)."
            )
        require_same_robot(recording.robot, first.robot, f"{called[0]} and {name}: recordings")
        parts.extend(recording.runs())
    if any("payload" in part.channels for part in parts):
        parts = [
            part if "payload" in part.channels else part.with_channels(payload=np.zeros(len(part))) for part in parts
        ]
    names = [name for name in parts[0].channels if all(name in part.channels for part in parts)]
    return Recording(
        np.concatenate([part.time for part in parts]),
        first.sample_time,
        {name: np.concatenate([part.channels[name] for part in parts]) for name in names},
        np.concatenate([np.full(len(part), number, dtype=np.int64) for number, part in enumerate(parts)]),
        first.robot,
    )


def require_same_robot(one: Robot, other: Robot, what: str) -> None:
    """Raise DataError if two robots differ in anything that changes the meaning of their numbers."""
    if one.hash != other.hash:
        raise DataError(f"{what} of two robots cannot be used together: {other.label()} and {one.label()}.")


Conditions = dict[str, list[float]]


def conditions(recording: Recording) -> Conditions:
    """Return the range of payload [kg], 0 if not recorded, and of co-contraction, the mean of the set-points [SI]."""
    payload = recording.channels.get("payload", np.zeros(1))
    mean = recording.set_points.mean(axis=1)
    return {"payload_kg": _min_max(payload), "cocontraction": _min_max(mean)}


def merge_conditions(parts: Sequence[Conditions]) -> Conditions:
    """Return the range over all parts of each condition."""
    return {name: _min_max(np.concatenate([part[name] for part in parts])) for name in parts[0]} if parts else {}


def _min_max(values: np.ndarray) -> list[float]:
    return [float(np.nanmin(values)), float(np.nanmax(values))]


# Dimensionless channels and loads: scaling leaves them as they are.
_UNSCALED_CHANNELS = ("payload", "compression", "healthy", "enabled", "measurement_valid")


def scale_recording(recording: Recording, scaling: Scaling) -> Recording:
    """Return the recording in scaled quantities, of a robot without units; identity scaling returns it unchanged."""
    if scaling.is_identity:
        return recording
    robot = recording.robot
    channels = {name: values for name, values in recording.channels.items() if name in _UNSCALED_CHANNELS}
    for names, scale in (
        (robot.set_points, scaling.scale_motors),
        (robot.motor_positions, scaling.scale_motors),
        (robot.outputs.names, scaling.scale_outputs),
    ):
        if all(name in recording.channels for name in names):
            values = round_scaled(scale(np.column_stack([recording.channels[name] for name in names])))
            channels |= dict(zip(names, values.T, strict=True))
    return replace(
        recording,
        time=recording.time / scaling.second,
        sample_time=recording.sample_time / scaling.second,
        channels=channels,
        robot=scaled_robot(robot, scaling),
    )
