"""Plausibility checks beside the master: all charts, evaluated with the data of each cycle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ._baseline import Baseline
from ._motor_charts import MotorCharts
from ._tilt_charts import TiltCharts
from ._tracking import TrackingCharts

# Rate of missing samples that is a fault: at least this, and three times the calibrated rate.
_RATE_LEAST = 0.2
# Time from the first chart beyond its threshold until the fault is named [s]: the right chart may take longer.
_NAMING_DELAY_S = 0.1
# The same for a chart of a current, which other faults may raise first [s].
_RIPE_CURRENT = 0.3
# Time without a valid tilt model until it is reported, and with one until the report may be repeated [s].
_REPORT_INTERVAL_S = 5.0
# Lead in log likelihood over the next fault at which it is named at once.
_LEAD_LOG_LIKELIHOOD = 20.0


class Finding(NamedTuple):
    """A detected fault.

    `name`: of the event. `motor`: from 0; -1 for none. `detail`: further text.
    """

    name: str
    motor: int
    detail: str


class Plausibility:
    """All charts over one run.

    Attributes:
        motors, tilt, tracking: the charts; the last only with a tracking model.
        rests: reason why the tilt is not compared, in the sample in which it must be reported; else "".
    """

    def __init__(self, baseline: Baseline) -> None:
        """Start with empty charts."""
        self._b = baseline
        self._gains = np.array(baseline.current)
        self.motors = MotorCharts(baseline)
        self.tilt = TiltCharts(baseline)
        step, known = baseline.cycle * baseline.sample_cycles, baseline.tracking
        self.tracking = TrackingCharts(known, baseline.outputs, step) if known.weights else None
        self._missing = 0.0
        self.rests, self._why, self._rested, self._said_so = "", "", 0, False
        self._now = 0
        self._since: int | None = None
        self._current: Finding | None = None

    def begin(self) -> None:
        """Take the present tilt and motor positions, at rest, as the start."""
        self.tilt.begin()
        self._missing = 0.0

    def cycle(
        self, setpoints: Sequence[float], positions: Sequence[float], tensions: Sequence[float]
    ) -> Finding | None:
        """Process one bus cycle: set-points sent before it [rad], positions [rad] and tensions [N] of all motors."""
        self._now += 1
        found = self.motors.step(np.array(setpoints), np.array(positions), np.array(tensions))
        if found is not None and found[0] != "current_scale":
            return Finding(*found)
        if found is not None:
            # Every fault changes the current: its scale is wrong only if no other chart reacts.
            self._current = Finding(*found)
            self._since = self._now if self._since is None else self._since
        return self._ripe()

    def sample(
        self,
        positions: Sequence[float],
        values: Sequence[float] | None,
        rates: Sequence[float],
        reference: Sequence[float] = (),
    ) -> Finding | None:
        """Process a sample, after `cycle`.

        `positions`: of the motors [rad]. `values`: of the tilt [rad], None if missing; rates: of its gyro [rad/s] or
        NaN. `reference`: of the loop at the time of the measurement [rad], () without one.
        """
        if self._rate(values is None):
            return Finding("sensor_rate", -1, "samples are missing more often than in the commissioning run")
        if self.motors.judging:
            return None
        taut = self.motors.features.taut(self._gains)
        tilt = None if values is None else np.array(values)
        beyond = self.tilt.step(np.array(positions), taut, tilt, np.array(rates), known_load=self.motors.known_load)
        self._count_rest()
        if beyond >= 0 and self._since is None:
            self._since = self._now
        if self.tracking is not None and self.tracking.step(reference, values, valid=self.tilt.valid) >= 0:
            off = ", ".join(f"{value:.1f}" for value in np.degrees(self.tracking.residual))
            # Every fault disturbs the tracking: the loop is wrong only if no other chart reacts.
            self._current = self._current or Finding("astray", -1, f"tilt less what the loop made of it {off} deg")
            self._since = self._now if self._since is None else self._since
        return None

    def _count_rest(self) -> None:
        """Report once if the tilt model was invalid for long, and again only after it was valid for as long."""
        self.rests, self._why = "", self.tilt.off or self._why
        most = round(_REPORT_INTERVAL_S / (self._b.cycle * self._b.sample_cycles))
        self._rested = max(0, self._rested - 1) if self.tilt.valid else min(most, self._rested + 1)
        if self._rested == most and not self._said_so:
            self.rests, self._said_so = self._why, True
        elif not self._rested:
            self._said_so = False

    def _ripe(self) -> Finding | None:
        """Return the most likely fault once the first chart has been beyond its threshold for long enough."""
        if self._since is None:
            return None
        found, lead = self.tilt.likeliest()
        waited = (self._now - self._since) * self._b.cycle + 1e-9
        current = self._current
        alone = found < 0 and current is not None and current.name == "current_scale"
        if lead < _LEAD_LOG_LIKELIHOOD and waited < (_RIPE_CURRENT if alone else _NAMING_DELAY_S):
            return None
        self._since = self._current = None
        if found < 0:
            return current
        name, number, size = self.tilt.names[found]
        return Finding(name, number if name == "gear_wrong" else -1, self._describe(name, number, size))

    def _rate(self, missing: bool) -> bool:
        """Update the CUSUM for a rate of missing samples of three times the calibrated one, or a fifth."""
        usual = max(self._b.missing, 1e-3)
        other = min(0.9, max(_RATE_LEAST, 3.0 * usual))
        score = math.log(other / usual) if missing else math.log((1.0 - other) / (1.0 - usual))
        self._missing = max(0.0, self._missing + score)
        return self._missing > self._b.missing_threshold

    def _describe(self, name: str, number: int, size: float) -> str:
        off = np.degrees(self.tilt.residual)
        gap = ", ".join(f"{value:.1f}" for value in off)
        if name == "gear_wrong":
            whose = "all motors" if number < 0 else f"motor {number + 1}"
            return f"{whose}: the tilt moves as if the winch turned {size:g} times as far"
        if name == "sensor_late":
            return f"the tilt follows about {size:g} s later than it did"
        if name == "sensor_noise":
            times = "a fifth of" if size < 1.0 else "five times"
            return f"output {number + 1}: its noise is {times} what it was, or beyond"
        return f"output {number + 1}: tilt less model {gap} deg"
