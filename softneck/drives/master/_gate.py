"""What of the inclinometer's samples may be believed: those of a robot's outputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from ._events import Event

# Without a valid sample for this long the sensor counts as lost [s]: the fault table allows 100 ms. So many identical
# raw samples in a row are of a frozen one, and so many in a row that are no angles stop.
DROPOUT, FROZEN, BAD = 0.08, 20, 3
# No neck turns faster than this [rad/s], beside what noise may add [rad].
_RATE, _MARGIN = 8.0, math.radians(3.0)


class Reading(NamedTuple):
    """One sample of what measures a robot's outputs, as it came.

    Attributes:
        values: of the outputs [rad].
        rates: [rad/s]; NaN without a gyro.
        valid: False while the sensor itself says that it has nothing.
    """

    values: tuple[float, ...]
    rates: tuple[float, ...]
    valid: bool = True


class Tilt(Reading):
    """One sample of an inclinometer: pitch, roll [rad] and their rates [rad/s], NaN without a gyro."""

    __slots__ = ()

    def __new__(
        cls, pitch: float, roll: float, pitch_rate: float = math.nan, roll_rate: float = math.nan, valid: bool = True
    ) -> Tilt:
        """Take both angles."""
        return super().__new__(cls, (pitch, roll), (pitch_rate, roll_rate), valid)


def sample_of(values: Sequence[float], rates: Sequence[float] = (), *, valid: bool = True) -> Reading:
    """Return the sample of so many outputs; `rates` are NaN where none are given."""
    return Reading(tuple(values), tuple(rates) or (math.nan,) * len(values), valid)


class Gate:
    """Passes samples on, counts what is wrong with them, and says when the sensor is lost.

    Attributes:
        last: last believed sample.
    """

    def __init__(self, angle: float) -> None:
        """Believe nothing yet, and never what is beyond `angle` [rad]."""
        self._angle = angle
        self.last: Reading | None = None
        self._raw: tuple[float, ...] | None = None
        self._same = self._bad = 0
        self._good_at: float | None = None
        self._first: float | None = None

    def step(self, now: float, sample: Reading | None, events: list[Event]) -> bool:
        """Take the sample that is due, None if none came; return whether it is believed."""
        if self._first is None:
            self._first = now
        good = sample is not None and sample.valid
        if sample is not None and sample.valid:
            reason = self._reason(now, sample)
            values = sample.values
            self._same = self._same + 1 if values == self._raw else 1
            self._raw = values
            if reason:
                good = False
                self._bad += 1
                events.append(Event(now, "sample_discarded", 0, reason))
                if self._bad >= BAD:
                    events.append(Event(now, "sensor_bad", 0, reason))
            else:
                self._bad = 0
                self.last, self._good_at = sample, now
            if self._same >= FROZEN:
                events.append(Event(now, "sensor_frozen", 0, f"{self._same} identical samples"))
                good = False
        since = now - (self._first if self._good_at is None else self._good_at)
        if not good and since >= DROPOUT - 1e-9:
            events.append(Event(now, "sensor_lost", 0, f"no valid sample for {since * 1e3:.0f} ms"))
        return good

    def _reason(self, now: float, sample: Reading) -> str:
        """Return why `sample` is not valid, "" if it may be."""
        values = sample.values
        if not all(map(math.isfinite, values)):
            return "not finite"
        if max(map(abs, values)) > self._angle:
            return "beyond what the neck can bend"
        if self.last is not None and self._good_at is not None:
            most = _RATE * (now - self._good_at) + _MARGIN
            if any(abs(new - old) > most for new, old in zip(values, self.last.values, strict=True)):
                return "an outlier"
        return ""
