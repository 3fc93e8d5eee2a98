"""An identification experiment on the neck's own drives: a signal is played, ramped in and out, and logged."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import CheckFailedError, DataError, SettingsError, Vector
from softneck.signals import SET_POINTS, Excitation, Recording, SetPointLimits

from ..bus._file import DrivesFile
from ..logs._rows import experiment_recording
from ..master import Frame, Master, Tilt
from ..running._bus_loop import RunEnd, Session, run_session
from ..running._signal import SignalLog, SignalPilot

# Between two runs the motors stand at rest for this long [s]: 15 time constants of the neck.
_PAUSE = 3.0
_ROUNDING = 1e-9
# Signals let tendons out no further than this unless they are asked to: a file that allows hanging tendons more does so
# because they hang earlier, above rest [rad].
_SLACK = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentResult:
    """An experiment that is over.

    Attributes:
        recording: what was logged, None if it ended before the second sample.
        planned: rows that were asked for.
        ended: how the run on the drives ended.
    """

    recording: Recording | None
    planned: int
    ended: RunEnd

    @property
    def rows(self) -> int:
        """How many were logged."""
        return 0 if self.recording is None else len(self.recording)

    @property
    def completed(self) -> bool:
        """Whether all rows are there and nothing stopped the drives."""
        return self.rows == self.planned and self.ended.master.supervisor.fault is None

    def require(self) -> None:
        """Raise CheckFailedError if something ended the experiment early."""
        fault = self.ended.master.supervisor.fault
        if fault is not None and fault.name == "following":
            raise CheckFailedError(
                f"stopped at t = {fault.time:.3f} s: {fault}. The motors do not follow the signal within their "
                "current; the drives are off: lower --max-speed, or look whether a motor is blocked or a tendon caught "
                "(`softneck drives jog`)."
            )
        self.ended.require()

    def table(self) -> dict[str, Any]:
        """Return what JSON holds of it."""
        return {"completed": self.completed, "rows": self.rows, "planned_rows": self.planned, **self.ended.table()}


def drive_limits(
    file: DrivesFile, *, position: float | None = None, speed: float | None = None, slack: float | None = None
) -> SetPointLimits:
    """Return limits for a signal within those of the drives file; those of the file where none are given.

    Raises:
        SettingsError: beyond the drives file.
    """
    own = file.limits
    for name, value, most, unit in (
        ("--max-position", position, own.position, "rad"),
        ("--max-speed", speed, own.speed, "rad/s"),
        ("--max-slack", slack, own.position, "rad"),
    ):
        if value is not None and value > most:
            raise SettingsError(f"{name} {value:g} is beyond the {most:g} {unit} of [limits] in the drives file.")
    return SetPointLimits(
        position=own.position if position is None else position,
        # A quarter of what the drives take: with their current limit the motors follow the quickest signals up to
        # there: Eq. 22 leaves the paper's motors 1.5 rad behind for 0.28 s at a third, for 0.04 s at a quarter.
        speed=own.speed / 4.0 if speed is None else speed,
        slack=min(own.slack_unwind, own.position, _SLACK) if slack is None else slack,
    )


def record_signal(
    excitations: Sequence[Excitation],
    session: Session,
    *,
    report: Callable[[float], None] | None = None,
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
    set_points, run = joined(excitations, sample_time)
    log = SignalLog(len(run), run=run, session=session)

    def tell(_now: float, _in: Sequence[Frame], _out: Sequence[Frame], _tilt: Tilt | None, master: Master) -> None:
        if report is not None and master.ran and master.index % 50 == 0:
            report(master.index / len(run))

    session = replace(session, watches=(log, tell, *session.watches))
    ended = run_session(session, SignalPilot(set_points), sample_time=sample_time, most=len(run) * sample_time)
    recording = experiment_recording(log.columns(), run[: log.rows], sample_time)
    return ExperimentResult(recording, int(np.count_nonzero(run)), ended)


def joined(excitations: Sequence[Excitation], sample_time: float) -> tuple[np.ndarray, Vector]:
    """Return all set-points (rows, 3) with pauses at rest between, and the number of the run, 0 in pauses."""
    parts, runs = [], []
    pause = round(_PAUSE / sample_time)
    for number, excitation in enumerate(excitations, start=1):
        if parts:
            parts.append(np.zeros((pause, 3)))
            runs.append(np.zeros(pause))
        parts.append(np.asarray(excitation.set_points, dtype=np.float64))
        runs.append(np.full(len(parts[-1]), float(number)))
    return np.concatenate(parts), np.concatenate(runs)


def _require_playable(excitation: Excitation, file: DrivesFile, sample_time: float) -> None:
    P = np.asarray(excitation.set_points, dtype=np.float64)
    if P.ndim != 2 or P.shape[1] != len(SET_POINTS) or len(P) < 2:
        raise DataError(f"set-points must have shape (time, 3) with at least 2 rows; got {P.shape}.")
    if not math.isclose(excitation.sample_time, sample_time, rel_tol=1e-9):
        raise SettingsError("the signals of one experiment need one sample time.")
    if not np.isfinite(P).all():
        raise DataError(f"the set-points of {excitation.name} must be finite.")
    most = float(np.abs(P).max())
    if most > file.limits.position + _ROUNDING:
        raise SettingsError(
            f"{excitation.name} asks for {most:.3g} rad; the drives file allows {file.limits.position:g} rad. "
            "Lower --max-position."
        )
    # From rest to the first row and from the last one to rest within one sample.
    speed = float(np.abs(np.diff(np.vstack([np.zeros(3), P, np.zeros(3)]), axis=0)).max()) / sample_time
    if speed > file.limits.speed * (1.0 + _ROUNDING):
        raise SettingsError(
            f"{excitation.name} asks for {speed:.3g} rad/s; the drives file allows {file.limits.speed:g} rad/s. "
            "Lower --max-speed, and ramp it in and out (--ramp)."
        )
