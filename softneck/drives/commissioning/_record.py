"""An identification experiment on the neck's own drives: a signal is played, ramped in and out, and logged.

It is a few numbers: the same numbers give the same set-points, here and at replay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import CheckFailedError, DataError, FileFormatError, SettingsError, Vector, require_finite
from softneck.robot import Robot
from softneck.signals import (
    NECK,
    Changes,
    Excitation,
    Recording,
    SetPointLimits,
    prepare,
    read_recording,
    require_same_robot,
    signal,
)

from ..bus._file import DrivesFile
from ..logs._rows import experiment_recording
from ..master import Frame, Master, Tilt
from ..running._bus_loop import RunEnd, Session, run_session
from ..running._pilot import SignalLog, SignalPilot

# Between two runs the motors stand at rest for this long [s]: 15 time constants of the neck.
_PAUSE_S = 3.0
_ROUNDING_RAD = 1e-9
# Signals let tendons out no further than this unless they are asked to: a file that allows hanging tendons more does so
# because they hang earlier, above rest [rad].
_SLACK_RAD = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentResult:
    """An experiment that is over.

    `recording`: what was logged, None if it ended before the second sample. `planned`: rows that were asked for.
    `ended`: how the run on the drives ended. `notes`: on a full disk.
    """

    recording: Recording | None
    planned: int
    ended: RunEnd
    notes: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """How many were logged."""
        return 0 if self.recording is None else len(self.recording)

    @property
    def completed(self) -> bool:
        """Whether all rows were recorded without a stop."""
        return self.rows == self.planned and self.ended.master.supervisor.fault is None

    def require(self) -> None:
        """Raise CheckFailedError if something ended the experiment early."""
        fault = self.ended.master.supervisor.fault
        if fault is not None and fault.name == "following":
            raise CheckFailedError(
                f"stopped at t = {fault.time:.3f} s: {fault}. The motors do not follow the signal within their "
                "current; the drives are off: lower speed_rad_s in [limits] of the drives file, or look whether a "
                "motor is blocked or a tendon caught (`softneck drives commission --only jog`)."
            )
        self.ended.require()

    def table(self) -> dict[str, Any]:
        """Return the JSON values."""
        return {"completed": self.completed, "rows": self.rows, "planned_rows": self.planned, **self.ended.table()}


def drive_limits(file: DrivesFile, *, position: float | None = None) -> SetPointLimits:
    """Return limits for a signal within those of the drives file; raise SettingsError for a position beyond it."""
    # One number for all motors here; what each of them may do beyond its own range is clipped by `Experiment`.
    farthest = max(max(-low, high) for low, high, _ in file.ranges)
    slowest = min(fastest for _, _, fastest in file.ranges)
    whose = "[limits] in the drives file" if file.robot is None else "[limits] in the drives file, or of the robot"
    if position is not None and position > farthest:
        raise SettingsError(f"--max-position {position:g} is beyond the {farthest:g} rad of {whose}.")
    return SetPointLimits(
        position=farthest if position is None else position,
        # A quarter of what the drives take: with their current limit the motors follow the quickest signals up to
        # there: Eq. 22 leaves the paper's motors 1.5 rad behind for 0.28 s at a third, for 0.04 s at a quarter.
        speed=slowest / 4.0,
        slack=min(file.limits.slack_unwind, farthest, _SLACK_RAD),
    )


def record_signal(
    excitations: Sequence[Excitation], session: Session, *, report: Callable[[float], None] | None = None
) -> ExperimentResult:
    """Play `excitations` one after the other, as runs 1, 2, ...; between them the motors rest for 3 s.

    The same pre-flight, supervisor, limits and watches as for a controller; a fault ends the experiment, and what was
    logged until then is returned.

    Args:
        excitations: at one sample time; each must begin and end near rest (`softneck.signals.prepare` with a ramp).
        session: on which drives.
        report: called now and then with the done fraction.

    Raises:
        SettingsError: set-points beyond the limits of the drives file, or far from rest at a border.
        CheckFailedError: the pre-flight failed; nothing moved.
    """
    if not excitations:
        raise SettingsError("there is no signal to record.")
    sample_time = excitations[0].sample_time
    for excitation in excitations:
        _require_playable(excitation, session.file, sample_time)
    set_points, run = join_runs(excitations, sample_time)
    log = SignalLog(len(run), run=run, session=session)

    def tell(_now: float, _in: Sequence[Frame], _out: Sequence[Frame], _tilt: Tilt | None, master: Master) -> None:
        if report is not None and master.ran and master.index % 50 == 0:
            report(master.index / len(run))

    session = replace(session, watches=(log, tell, *session.watches))
    ended = run_session(session, SignalPilot(set_points), sample_time=sample_time, most=len(run) * sample_time)
    columns, notes = log.finish()
    rows = len(columns[session.file.moves.set_points[0]])
    recording = experiment_recording(columns, run[:rows], sample_time, session.file.moves)
    return ExperimentResult(recording, int(np.count_nonzero(run)), ended, notes)


def join_runs(excitations: Sequence[Excitation], sample_time: float) -> tuple[np.ndarray, Vector]:
    """Return all set-points (rows, motors) with pauses at rest between, and the number of the run, 0 in pauses."""
    parts, runs = [], []
    motors = np.shape(excitations[0].set_points)[1]
    pause = round(_PAUSE_S / sample_time)
    for number, excitation in enumerate(excitations, start=1):
        if parts:
            parts.append(np.zeros((pause, motors)))
            runs.append(np.zeros(pause))
        parts.append(np.asarray(excitation.set_points, dtype=np.float64))
        runs.append(np.full(len(parts[-1]), float(number)))
    return np.concatenate(parts), np.concatenate(runs)


def _require_playable(excitation: Excitation, file: DrivesFile, sample_time: float) -> None:
    P = np.asarray(excitation.set_points, dtype=np.float64)
    motors = len(file.nodes)
    if P.ndim != 2 or P.shape[1] != motors or len(P) < 2:
        raise DataError(f"set-points must have shape (time, {motors}) with at least 2 rows; got {P.shape}.")
    if not math.isclose(excitation.sample_time, sample_time, rel_tol=1e-9):
        raise SettingsError("the signals of one experiment need one sample time.")
    if not np.isfinite(P).all():
        raise DataError(f"the set-points of {excitation.name} must be finite.")
    low, high, fastest = np.array(file.ranges).T
    whose = "drives file allows" if file.robot is None else "drives file or the robot allow"
    if (high + _ROUNDING_RAD < P).any() or (low - _ROUNDING_RAD > P).any():
        most = float(P.flat[np.argmax(np.maximum(P - high, low - P))])
        allowed = f"{high[0]:g} rad" if file.robot is None else "less"
        raise SettingsError(
            f"{excitation.name} asks for {abs(most) if file.robot is None else most:.3g} rad; the {whose} {allowed}. "
            "Lower --max-position."
        )
    # From rest to the first row and from the last one to rest within one sample.
    rest = np.zeros(motors)
    speeds = np.abs(np.diff(np.vstack([rest, P, rest]), axis=0)).max(axis=0) / sample_time
    if (speeds > fastest * (1.0 + _ROUNDING_RAD)).any():
        j = int(np.argmax(speeds / fastest))
        raise SettingsError(
            f"{excitation.name} asks for {speeds[j]:.3g} rad/s; the {whose} {fastest[j]:g} rad/s. "
            "Slow it down, and ramp it in and out."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """An experiment of `softneck drives record`.

    Attributes:
        signal: name of it, or a recording whose set-points are played, all of its runs.
        limits: of the set-points, see `drive_limits`.
        duration: [s]; None: the signal's own.
        seed: of the first run; it rises by one with each.
        runs: how often it is played.
        ramp: from rest and to it [s].
        cocontraction: common position of all motors, around which it is played [rad].
        robot: whose motors they are; None: a neck's, not spoken of.
        ranges: of each motor: lowest and highest set-point [rad], largest speed [rad/s]; () for none beside `limits`.
    """

    signal: str
    limits: SetPointLimits
    duration: float | None = None
    seed: int = 0
    runs: int = 1
    ramp: float = 2.0
    cocontraction: float = 0.0
    robot: Robot | None = None
    ranges: tuple[tuple[float, float, float], ...] = ()

    def prepare_runs(self) -> list[tuple[Excitation, Changes]]:
        """Return for each run the signal within its limits, and the changes.

        Raises:
            SettingsError: no such signal, or limits that it cannot keep.
            FileFormatError, DataError: no such recording, or one of another robot.
        """
        require_finite("cocontraction", self.cocontraction, "rad")
        signals = [
            replace(one, set_points=one.set_points + self.cocontraction)
            for number in range(self.runs)
            for one in self._signals(number)
        ]
        return [prepare(self._in_range(one), self.limits, ramp_s=self.ramp) for one in signals]

    def _signals(self, number: int) -> list[Excitation]:
        """Return the excitations of round `number`: a signal by name, or the runs of a recording."""
        if Path(self.signal).suffix.lower() not in (".csv", ".parquet"):
            return [signal(self.signal, duration=self.duration, seed=self.seed + number, robot=self.robot)]
        recording = read_recording(self.signal)
        require_same_robot(self.robot or NECK, recording.robot, f"{self.signal} and the drives: set-points")
        rows = None if self.duration is None else max(2, round(self.duration / recording.sample_time))
        return [
            Excitation(self.signal, part.time[:rows] - part.time[0], part.set_points[:rows], recording.sample_time)
            for part in recording.runs()
        ]

    def _in_range(self, excitation: Excitation) -> Excitation:
        """Return a signal within the range of each motor, which is the tighter one of robot and drives file."""
        if not self.ranges:
            return excitation
        low, high, _ = np.array(self.ranges).T
        return replace(excitation, set_points=np.clip(excitation.set_points, low, high))

    def pilot(self) -> SignalPilot:
        """Return the pilot that plays all runs with their pauses."""
        parts = [excitation for excitation, _ in self.prepare_runs()]
        return SignalPilot(join_runs(parts, parts[0].sample_time)[0])

    def facts(self) -> dict[str, Any]:
        """Return the values for a log, without the robot and its ranges."""
        return {key: value for key, value in asdict(self).items() if key not in ("robot", "ranges")}

    @classmethod
    def of(
        cls, facts: Mapping[str, Any], robot: Robot | None = None, ranges: tuple[tuple[float, float, float], ...] = ()
    ) -> Experiment:
        """Return the experiment that `facts` tells, of `robot` within `ranges`.

        Raises:
            FileFormatError: they are damaged, or of another version.
        """
        try:
            limits = SetPointLimits(**facts["limits"])
            return cls(**{**facts, "limits": limits, "robot": robot, "ranges": ranges})
        except (KeyError, TypeError, SettingsError) as error:
            raise FileFormatError(f"the log's experiment does not fit this softneck ({error}).") from error
