"""Validation of the samples of a robot's outputs, such as those of an inclinometer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from ._events import Event

# Time without a valid sample after which the sensor counts as lost [s] (the fault table allows 100 ms); number of equal
# raw samples in a row after which it counts as frozen; number of invalid samples in a row that stop the run.
DROPOUT, FROZEN, BAD = 0.08, 20, 3
# Largest speed of a neck [rad/s], and margin for noise [rad].
_RATE, _MARGIN = 8.0, math.radians(3.0)


class Reading(NamedTuple):
    """One raw sample of a robot's outputs.

    `values`: of the outputs [rad]. `rates`: [rad/s]; NaN without a gyro. `valid`: False while the sensor itself reports
    no measurement.
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
        """Make a sample of two angles."""
        return super().__new__(cls, (pitch, roll), (pitch_rate, roll_rate), valid)


def sample_of(values: Sequence[float], rates: Sequence[float] = (), *, valid: bool = True) -> Reading:
    """Return a sample; `rates` are NaN if not given."""
    return Reading(tuple(values), tuple(rates) or (math.nan,) * len(values), valid)


class Gate:
    """Validator of samples: discards invalid ones, and reports a lost or frozen sensor.

    Attributes:
        last: last accepted sample.
    """

    def __init__(self, angle: float) -> None:
        """Start without a sample; values beyond `angle` [rad] are always discarded."""
        self._angle = angle
        self.last: Reading | None = None
        self._raw: tuple[float, ...] | None = None
        self._same = self._bad = 0
        self._good_at: float | None = None
        self._first: float | None = None

    def step(self, now: float, sample: Reading | None, events: list[Event]) -> bool:
        """Check the sample that is due (None if it is missing); return whether it is accepted."""
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
        """Return the reason why `sample` is invalid; "" if it is valid."""
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
