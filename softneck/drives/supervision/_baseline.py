"""Baseline of the fault detection: models and thresholds from undisturbed motion of the commissioning run."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

from softneck.core import MOST_JSON, FileFormatError, SettingsError, settings_text, write_text

_KIND, _VERSION = "softneck supervision", 3
_LATER = {"seconds", "tracking"}
Row = tuple[float, ...]
Rows = tuple[Row, ...]


class Tracking(NamedTuple):
    """Reference model of the tracking of a loop; all fields are empty without a loop.

    `weights`: c_i. `whitening`: filter of each output's residual; spread: variance of its innovation [rad^2], and its
    increase for each rad^2 between reference and model, and for each rad^2 of change of the model over two samples.
    `bias`: largest mean over a second of each residual on runs outside the fit [rad]. `thresholds`: of the charts, an
    upper and a lower one for each output.
    """

    weights: Row = ()
    whitening: Rows = ()
    spread: Rows = ()
    bias: Row = ()
    thresholds: Row = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """Models and thresholds of undisturbed motion, made by `calibrate`.

    Attributes:
        cycle: of the bus [s]; sample_cycles: bus cycles between two samples of the tilt.
        outputs: number of measured outputs.
        drive: for each motor, coefficients of its step from the distances to the set-points of the last cycles.
        drive_spread: variance of its residual [rad^2], and its increase for each rad^2 of the step. It is not whitened:
            a motor that does not move shows in the mean, which whitening would remove.
        drive_fastest: largest step of each motor in a cycle, with a margin [rad].
        current: for each motor, coefficients of the change of its tension over three cycles from changes of positions,
            speed and acceleration.
        current_whitening, current_spread: of its residual [N].
        current_top: largest measured tension of each motor, where its current may be saturated [N].
        current_reach: distance of each motor from its set-points in nearly all cycles [rad].
        load: for each motor, coefficients of the mean of the other tensions from the motors' positions and a constant
            [N]. Its residual over some seconds is caused by a payload. load_low: smallest calibrated residual [N].
        level: for each motor, coefficients of its tension from the same features, the residual of the others by
            `load` (a payload changes all tensions), and a constant. level_spread: variance of the residual [N^2].
        tilt: (outputs, lags x motors) coefficients of the tilt from past positions of the motors.
        lags: of these positions [samples].
        tilt_whitening: filter of each output's residual.
        tilt_spread: variance [rad^2], and its increase for each rad^2 of change over two samples, and of distance.
        tilt_bias: slow model error of each output without any fault [rad].
        gyro_whitening, gyro_spread: the same for angles against integrated rates; () without a gyro.
        gyro_wander: variance of the difference between angles and gyro [rad^2].
        noise: variance of second differences of each output's residual [rad^2].
        missing: share of missing samples; missing_threshold: of their chart.
        reach: lowest and highest position of each motor [rad].
        slack: for each tendon, tension below which it may be slack and the tilt does not follow the motors [N].
        motor_thresholds, tilt_thresholds: of the charts, in the order of their names.
        tracking: of a loop, if the experiments had one.
        seconds: of motion used for the calibration.
    """

    cycle: float
    sample_cycles: int
    outputs: int
    drive: Rows
    drive_spread: Rows
    drive_fastest: Row
    current: Rows
    current_whitening: Rows
    current_spread: Rows
    current_top: Row
    current_reach: Row
    load: Rows
    load_low: float
    level: Rows
    level_spread: Row
    tilt: Rows
    lags: tuple[int, ...]
    tilt_whitening: Rows
    tilt_spread: Rows
    tilt_bias: Row
    gyro_whitening: Rows
    gyro_spread: Row
    gyro_wander: Row
    noise: Row
    missing: float
    missing_threshold: float = math.inf
    reach: Rows
    slack: Row
    motor_thresholds: Row = ()
    tilt_thresholds: Row = ()
    tracking: Tracking = field(default_factory=Tracking)
    seconds: float = 0.0

    @property
    def motors(self) -> int:
        """Number of motors."""
        return len(self.drive)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the baseline as JSON; an existing file is replaced only with `force`."""
        text = json.dumps({"kind": _KIND, "version": _VERSION, **asdict(self)}, indent=1)
        write_text(path, text + "\n", force=force)

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Baseline:
        """Return the baseline for a table of `asdict`, also with lists in place of tuples.

        Raises SettingsError: missing or unknown keys.
        """
        known = {item.name for item in fields(cls)}
        # Files from before the comparison of loops have no `tracking`.
        wrong = sorted((known - _LATER) ^ (set(table) - _LATER))
        if wrong:
            raise SettingsError(f"`{wrong[0]}` is missing or unknown in what the supervisor compares with.")
        rows = {name: _tuple(value) for name, value in table.items()}
        return cls(**{**rows, "tracking": Tracking(*rows.get("tracking", ()))})


def load_baseline(path: str | Path) -> Baseline:
    """Read a baseline from a file of `Baseline.save`. Raises FileFormatError: no such file, or another kind of file."""
    source = Path(path)
    try:
        table = json.loads(settings_text(source, MOST_JSON))
        if not isinstance(table, dict) or table.pop("kind", "") != _KIND:
            raise FileFormatError(f"{source}: is not what `softneck.drives.baseline(...).save` writes.")
        if table.pop("version", 0) != _VERSION:
            raise FileFormatError(f"{source}: is of another version of softneck; record it anew.")
        return Baseline.from_dict(table)
    except OSError as error:
        raise FileFormatError(f"{source}: cannot be read ({error.strerror}).") from error
    except (ValueError, RecursionError, TypeError, SettingsError) as error:
        raise FileFormatError(f"{source}: is damaged ({error}).") from error


def _tuple(value: Any) -> Any:
    if isinstance(value, float) and math.isnan(value):
        raise SettingsError("a number in it is NaN, and no chart would ever speak")
    return tuple(_tuple(item) for item in value) if isinstance(value, list | tuple) else value
