"""What the supervisor compares with: models and thresholds, all from undisturbed motion of the commissioning run."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

from softneck.core import FileFormatError, SettingsError, atomic_write
from softneck.core._budget import MOST_JSON, settings_text

_KIND, _VERSION = "softneck supervision", 3
_LATER = {"seconds", "tracking"}
Row = tuple[float, ...]
Rows = tuple[Row, ...]


class Tracking(NamedTuple):
    """What the tracking of a loop is compared with; all empty without one.

    Attributes:
        weights: c_i.
        whitening: of each output's residual; spread: variance of its innovation [rad^2], and what is added for each
            rad^2 between reference and model, and of change of the model over two samples.
        bias: largest mean over a second of each residual on runs that it was not fitted on [rad].
        thresholds: of the charts, an upper and a lower one for each output.
    """

    weights: Row = ()
    whitening: Rows = ()
    spread: Rows = ()
    bias: Row = ()
    thresholds: Row = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """Undisturbed motion in numbers; `calibrate` makes it.

    Attributes:
        cycle: of the bus [s]; sample_cycles: of these between two samples of the tilt.
        outputs: how many are measured.
        drive: of each motor, how its step follows from what was left to the set-points of the last cycles.
        drive_spread: of its residual, variance [rad^2] and what is added for each rad^2 of the step. It is not
            whitened: a motor that stands though asked shows in the mean, which whitening takes away.
        drive_fastest: largest step that a motor takes in a cycle, with a margin [rad].
        current: of each motor, change of its tension over three cycles from changes of positions, speed, acceleration.
        current_whitening, current_spread: of its residual [N].
        current_top: largest tension seen of each, where its current may be cut off [N].
        current_reach: how far each motor was behind its set-points in nearly all cycles [rad].
        load: of each motor, mean of the other tensions from the motors' positions and one [N]. What these are off by
            over some seconds is what a payload makes of them. load_low: least of it that is known ground [N].
        level: of each motor, its tension from the same features, that of the others by `load`, and one: a payload is in
            all of them. level_spread: variance of the residual [N^2].
        tilt: (outputs, lags x motors) tilt from the motors' positions so many samples ago.
        lags: these [samples].
        tilt_whitening: of each output's residual.
        tilt_spread: variance [rad^2], and what is added for each rad^2 of change over two samples, and of way.
        tilt_bias: how far slow errors of the model carry each output's residual without any fault [rad].
        gyro_whitening, gyro_spread: the same of angles against integrated rates; () without a gyro.
        gyro_wander: variance of what angles and gyro differ by [rad^2].
        noise: variance of second differences of each output beside the model [rad^2].
        missing: part of the samples that did not come; missing_threshold: of the chart that counts them.
        reach: of each motor, lowest and highest position seen [rad].
        slack: of each tendon: below this it may hang, and the tilt is not what the motors say [N].
        motor_thresholds, tilt_thresholds: of the charts, in the order of their names.
        tracking: of a loop, where the experiments had one.
        seconds: of motion that it was calibrated from.
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
        """How many there are."""
        return len(self.drive)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write it as JSON; an existing file is replaced only with `force`."""
        text = json.dumps({"kind": _KIND, "version": _VERSION, **asdict(self)}, indent=1)
        with atomic_write(path, force=force) as part:
            part.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Baseline:
        """Return what `asdict` made, lists for tuples too.

        Raises:
            SettingsError: keys that are missing or unknown.
        """
        known = {item.name for item in fields(cls)}
        # Files from before loops were compared with have no `tracking`.
        wrong = sorted((known - _LATER) ^ (set(table) - _LATER))
        if wrong:
            raise SettingsError(f"`{wrong[0]}` is missing or unknown in what the supervisor compares with.")
        rows = {name: _tuple(value) for name, value in table.items()}
        return cls(**{**rows, "tracking": Tracking(*rows.get("tracking", ()))})


def load_baseline(path: str | Path) -> Baseline:
    """Read what `Baseline.save` wrote.

    Raises:
        FileFormatError: no such file, or not one of these.
    """
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
