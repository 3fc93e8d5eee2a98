"""PID with two degrees of freedom: the gains that do best on the worst sample of the plant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from softneck.core import SettingsError, Vector, require_between
from softneck.estimation import AxisPlant

from ..plants._uncertain import UncertainAxis
from ._axis_loop import Sweep, coarse_frequencies, conditioning_gain, sensitivities
from ._controller import AxisController
from ._settings import AxisDesign, AxisSettings

# While gains are searched the reference is filtered this slowly [s]: only the load is judged.
_SEARCH_FILTER_S = 0.3
_SPEED_FACTORS = (1.0, 2.0)
# Nelder-Mead ends where neither the gains nor the load's rms move by more than 0.2 %.
_SEARCH_OPTIONS = {"xatol": 2e-3, "fatol": 1e-3, "maxfev": 220}
# How much a broken bound weighs against rms [deg]: every bound is met to 1 % and then kept by scaling back.
_BOUND_PENALTY = 10.0
_MAX_SCALING_STEPS = 60
# So many samples are simulated during the search; its end is judged on all.
_SEARCH_SAMPLES = 12


@dataclass(frozen=True, slots=True)
class PidGains:
    """`v = K (r - y + int(r - y)/Ti - Td s y/(1 + Tf s))`, integral and derivative by backward differences.

    `gain`: K [rad/rad]. `integral_time`: Ti [s]. `derivative_time`: Td [s]. `filter_time`: Tf [s].
    """

    gain: float
    integral_time: float
    derivative_time: float
    filter_time: float

    def axis(self, dt: float) -> AxisController:
        """Return it as the controller of an axis at sample time `dt` [s]."""
        K, a = self.gain, self.filter_time / (self.filter_time + dt)
        g, rate = K * self.derivative_time / (self.filter_time + dt), K * dt / self.integral_time
        A = np.diag([1.0, a])
        # The integral acts at once on r and y, so it is part of the direct gains.
        Br, By = np.array([[rate], [0.0]]), np.array([[-rate], [(1.0 - a) * g]])
        C, Dr = np.ones((1, 2)), K + rate
        return AxisController(A=A, Br=Br, By=By, C=C, Dr=Dr, Dy=-K - rate - g, L=conditioning_gain(A, Br, C, Dr))

    def response(self, z: np.ndarray, dt: float) -> np.ndarray:
        """Return the feedback's response K(z) (m,)."""
        back = 1.0 - 1.0 / z
        slope = back / (dt + self.filter_time * back)
        return self.gain * (1.0 + dt / self.integral_time / back + self.derivative_time * slope)


@dataclass(frozen=True, slots=True, kw_only=True)
class PidSettings(AxisSettings):
    """PID on the exact-delay plant: the gains that minimise the load error of the worst sample.

    They are taken among those whose loops all keep `max_sensitivity` and `noise_gain`.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        noise_gain: bound on the gain from the angle's noise to the input, in units of 1/static gain.
    """

    KIND: ClassVar[str] = "pid"

    noise_gain: float = 5.0

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        require_between("noise_gain", self.noise_gain, 0.1, 1e4)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        dt = axis.sample_time
        gains = self._search_gains(axis, dt)
        named = {
            "K": gains.gain, "Ti_s": gains.integral_time, "Td_s": gains.derivative_time, "Tf_s": gains.filter_time,
        }  # fmt: skip
        return AxisDesign(gains.axis(dt), named, {})

    def _search_gains(self, axis: UncertainAxis, dt: float) -> PidGains:
        """Return the gains that do best on the worst sample, by Nelder and Mead from gains that surely hold."""
        from scipy.optimize import minimize

        gain = axis.nominal.static_gain
        lag = axis.nominal.time_constant
        dead = (axis.nominal.delay + 1 + self.extra_delay) * dt
        judge = _WorstCase.of(self, axis)
        # The search sees scaled gains and seconds: its first simplex would differ by the units else.
        size = judge.sweep.test.gain_unit
        units = np.array([math.copysign(size, gain), *[axis.nominal.second] * 3])
        best: PidGains | None = None
        for slow in _SPEED_FACTORS:
            guess = np.array([lag / (2.0 * slow * dead) / abs(gain), lag + 0.5 * dead, 0.3 * dead, 0.3 * dt])
            start = np.log(guess / np.abs(units))
            few = judge.select_hardest(_gains(start, units))
            result = minimize(partial(_cost, few, units), start, method="Nelder-Mead", options=_SEARCH_OPTIONS)
            found = judge.scale_to_bounds(_gains(result.x, units))
            if found is not None and (best is None or judge.load(found) < judge.load(best)):
                best = found
        if best is None:
            raise SettingsError(
                f"no PID keeps Ms <= {self.max_sensitivity:g} and a noise gain of {self.noise_gain:g} on all "
                f"{len(axis.samples)} samples; raise one of them."
            )
        return best


def _gains(x: Vector, units: Vector) -> PidGains:
    """Return the gains of logarithms `x` (4,) in `units` (4,), of which the first has the sign of K."""
    return PidGains(*(float(value) for value in units * np.exp(np.clip(x, -20.0, 20.0))))


@dataclass(frozen=True, slots=True, eq=False)
class _WorstCase:
    """Cost and bounds of gains on the worst sample."""

    settings: PidSettings
    samples: Sequence[AxisPlant]
    sweep: Sweep
    z: np.ndarray
    loops: np.ndarray
    sample_time: float
    static_gain: float
    second: float

    @classmethod
    def of(cls, settings: PidSettings, axis: UncertainAxis) -> _WorstCase:
        dt = axis.sample_time
        w = coarse_frequencies(axis.nominal)
        loops = np.array([plant.response(w, extra_delay=settings.extra_delay) for plant in axis.samples])
        return cls(settings, axis.samples, settings._sweep(axis), np.exp(1j * w * dt), loops, dt,
                   axis.nominal.static_gain, axis.nominal.second)  # fmt: skip

    def select_hardest(self, gains: PidGains) -> _WorstCase:
        """Return the judge of the samples on which a load is worst under `gains`: the others do not decide."""
        loads = np.nan_to_num(self._loads(gains), nan=np.inf)
        chosen = np.argsort(loads)[::-1][:_SEARCH_SAMPLES]
        few = replace(self.sweep, plants=self.sweep.plants[chosen].copy(), delays=self.sweep.delays[chosen])
        return replace(self, sweep=few)

    def load(self, gains: PidGains) -> float:
        """Return the worst rms from the load on [deg]."""
        worst = float(self._loads(gains).max()) * self.sweep.test.size
        return worst if math.isfinite(worst) else 1e6

    def _loads(self, gains: PidGains) -> Vector:
        axis = gains.axis(self.sample_time)
        with np.errstate(over="ignore", invalid="ignore"):
            return self.sweep.run(axis, _SEARCH_FILTER_S * self.second, axis.conditioning()).load_rms

    def excess(self, gains: PidGains) -> float:
        """Return how far the bounds are broken, 0 if they hold."""
        K = gains.response(self.z, self.sample_time)
        sensitivity = float(1.0 / np.abs(1.0 + K * self.loops).min())
        noise = abs(float(np.real(gains.response(np.array([-1.0 + 0.0j]), self.sample_time)[0])) * self.static_gain)
        bounds = self.settings
        return max(sensitivity / bounds.max_sensitivity - 1.0, 0.0) + max(noise / bounds.noise_gain - 1.0, 0.0)

    def _peak(self, gains: PidGains) -> float:
        """Return the largest sensitivity over the samples, between the frequencies of the search too."""
        return float(sensitivities(gains.axis(self.sample_time), self.samples, self.settings.extra_delay).max())

    def scale_to_bounds(self, gains: PidGains) -> PidGains | None:
        """Return the gains, scaled back until all bounds hold and all samples are stable; None if none are."""
        most = self.settings.max_sensitivity
        for _ in range(_MAX_SCALING_STEPS):
            if self.excess(gains) == 0.0 and self.load(gains) < 1e3 and self._peak(gains) <= most:
                return gains
            gains = replace(gains, gain=0.995 * gains.gain)
        return None


def _cost(judge: _WorstCase, units: Vector, x: Vector) -> float:
    """Return the cost that the search minimises."""
    gains = _gains(x, units)
    try:
        return judge.load(gains) + _BOUND_PENALTY * judge.excess(gains)
    except SettingsError:
        return 1e6
