"""PID with two degrees of freedom: placed poles, or gains that do best on every sample of the plant."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from softneck.core import SettingsError, Vector, require_between, require_one_of, require_positive
from softneck.estimation import AxisPlant

from ..plants._uncertain import UncertainAxis
from ._assembly import AxisController
from ._axis_loop import closed_radius, coarse, conditioning_gain
from ._axis_settings import AxisDesign, AxisSettings
from ._sweep import Sweep

TUNINGS = ("samples", "placement")
# While gains are searched the reference is filtered this slowly [s]: only the load is judged.
_WHILE_SEARCHING = 0.3
_STARTS = (1.0, 2.0)
# Nelder-Mead ends where neither the gains nor the load's rms move by more than 0.2 %.
_OPTIONS = {"xatol": 2e-3, "fatol": 1e-3, "maxfev": 220}
# How much a broken bound weighs against rms [deg]: every bound is met to 1 % and then kept by scaling back.
_PENALTY = 10.0
_SCALINGS = 60
# So many samples are simulated during the search; its end is judged on all.
_HARDEST = 12
# A placed loop whose slowest pole lies beyond this is not what was placed.
_DOMINANT = 1.02


@dataclass(frozen=True, slots=True)
class PidGains:
    """`v = K (b r - y + int(r - y)/Ti - Td s y/(1 + Tf s))`, integral and derivative by backward differences.

    Attributes:
        gain: K [rad/rad].
        integral_time: Ti [s].
        derivative_time: Td [s].
        filter_time: Tf [s].
        reference_weight: b.
    """

    gain: float
    integral_time: float
    derivative_time: float
    filter_time: float
    reference_weight: float = 1.0

    def axis(self, dt: float) -> AxisController:
        """Return it as the controller of an axis at sample time `dt` [s]."""
        K, a = self.gain, self.filter_time / (self.filter_time + dt)
        g, rate = K * self.derivative_time / (self.filter_time + dt), K * dt / self.integral_time
        A = np.diag([1.0, a])
        # The integral acts at once on r and y, so it is part of the direct gains.
        Br, By = np.array([[rate], [0.0]]), np.array([[-rate], [(1.0 - a) * g]])
        C, Dr = np.ones((1, 2)), K * self.reference_weight + rate
        return AxisController(A=A, Br=Br, By=By, C=C, Dr=Dr, Dy=-K - rate - g, L=conditioning_gain(A, Br, C, Dr))

    def response(self, z: np.ndarray, dt: float) -> np.ndarray:
        """Return the feedback's response K(z) (m,)."""
        back = 1.0 - 1.0 / z
        slope = back / (dt + self.filter_time * back)
        return self.gain * (1.0 + dt / self.integral_time / back + self.derivative_time * slope)


@dataclass(frozen=True, slots=True, kw_only=True)
class PidSettings(AxisSettings):
    """PID on the exact-delay plant.

    `tuning` "samples" takes the gains with the least load error on the worst sample among those whose loops all keep
    `max_sensitivity` and `noise_gain`; "placement" puts three poles of the nominal loop where they are wanted
    (dominant pole placement, exact for the delay: Astrom and Hagglund 2006, Advanced PID Control, sec. 6.4).

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        tuning: "samples" or "placement".
        noise_gain: bound on the gain from the angle's noise to the input, in units of 1/static gain.
        reference_weight: b, the reference's share in the proportional part.
        filter_time: Tf [s] of the derivative; None to tune it ("samples") or for half a sample ("placement").
        frequency: of the placed pair [rad/s].
        damping: of the placed pair.
        third_pole: placed on the real axis, as a multiple of `frequency`; 0 for a PI.
    """

    KIND: ClassVar[str] = "pid"

    tuning: str = "samples"
    noise_gain: float = 5.0
    reference_weight: float = 1.0
    filter_time: float | None = None
    frequency: float = 12.0
    damping: float = 0.8
    third_pole: float = 1.0

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        require_one_of("tuning", self.tuning, TUNINGS)
        require_between("noise_gain", self.noise_gain, 0.1, 1e4)
        require_between("reference_weight", self.reference_weight, 0.0, 2.0)
        if self.filter_time is not None:
            require_between("filter_time", self.filter_time, 0.0, 10.0, "s")
        require_positive("frequency", self.frequency, "rad/s")
        require_between("damping", self.damping, 0.1, 1.0)
        require_between("third_pole", self.third_pole, 0.0, 20.0)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        dt = axis.sample_time
        gains = self._placed(axis.nominal, dt) if self.tuning == "placement" else self._tuned(axis, dt)
        named = {
            "K": gains.gain, "Ti_s": gains.integral_time, "Td_s": gains.derivative_time, "Tf_s": gains.filter_time,
        }  # fmt: skip
        return AxisDesign(gains.axis(dt), named, {"tuning": self.tuning})

    def _placed(self, plant: AxisPlant, dt: float) -> PidGains:
        """Return the gains with which 1 + K G is zero at the wanted poles; linear in K, K/Ti, K Td."""
        w, f = self.frequency, 0.5 * dt if self.filter_time is None else self.filter_time
        pair = w * complex(-self.damping, math.sqrt(1.0 - min(self.damping, 1.0 - 1e-9) ** 2))
        K, Ki, Kd = place_pid(plant, self.extra_delay, pair, self.third_pole * w, f)
        if K * plant.static_gain <= 0.0 or Ki / K <= 0.0 or Kd / K < 0.0:
            raise SettingsError(
                f"poles at {w:.3g} rad/s with damping {self.damping:.2g} need gains of both signs "
                f"(K {K:.3g}, K/Ti {Ki:.3g}, K Td {Kd:.3g}); take another `frequency`, or "
                "`third_pole` 0 for a PI."
            )
        gains = PidGains(K, K / Ki, Kd / K, f, self.reference_weight)
        radius = closed_radius(gains.axis(dt), plant, self.extra_delay)
        slowest = math.exp(-min(self.damping, self.third_pole or math.inf) * w * dt)
        if radius > min(_DOMINANT * slowest, 1.0):
            raise SettingsError(
                f"poles can be placed at {w:.3g} rad/s, but a slower or unstable one remains (spectral radius "
                f"{radius:.4f}): the dead time allows no such speed. Lower `frequency`."
            )
        return gains

    def _tuned(self, axis: UncertainAxis, dt: float) -> PidGains:
        """Return the gains that do best on the worst sample, by Nelder and Mead from gains that surely hold."""
        from scipy.optimize import minimize

        gain = axis.nominal.static_gain
        lag = axis.nominal.time_constant
        dead = (axis.nominal.delay + 1 + self.extra_delay) * dt
        judge = _Judge.of(self, axis)
        best: PidGains | None = None
        for slow in _STARTS:
            start = np.log([lag / (2.0 * slow * dead) / abs(gain), lag + 0.5 * dead, 0.3 * dead, 0.3 * dt])
            if self.filter_time is not None:
                start = start[:3]
            few = judge.hardest(self._gains(start, gain))
            cost = partial(_cost, few, self, gain)
            result = minimize(cost, start, method="Nelder-Mead", options=_OPTIONS)
            found = judge.kept(self._gains(result.x, gain))
            if found is not None and (best is None or judge.load(found) < judge.load(best)):
                best = found
        if best is None:
            raise SettingsError(
                f"no PID keeps Ms <= {self.max_sensitivity:g} and a noise gain of {self.noise_gain:g} on all "
                f"{len(axis.samples)} samples; raise one of them."
            )
        return best

    def _gains(self, x: Vector, sign: float) -> PidGains:
        K, Ti, Td, *rest = (float(value) for value in np.exp(np.clip(x, -20.0, 20.0)))
        return PidGains(
            math.copysign(K, sign), Ti, Td, rest[0] if rest else float(self.filter_time or 0.0), self.reference_weight
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Judge:
    """The worst of all samples under gains: what the search minimises, and its bounds."""

    settings: PidSettings
    sweep: Sweep
    z: np.ndarray
    loops: np.ndarray
    sample_time: float
    static_gain: float
    stretch: float

    @classmethod
    def of(cls, settings: PidSettings, axis: UncertainAxis) -> _Judge:
        dt = axis.sample_time
        w = coarse(axis.nominal)
        loops = np.array([plant.response(w, extra_delay=settings.extra_delay) for plant in axis.samples])
        return cls(settings, settings._sweep(axis), np.exp(1j * w * dt), loops, dt, axis.nominal.static_gain,
                   axis.nominal.stretch)  # fmt: skip

    def hardest(self, gains: PidGains) -> _Judge:
        """Return the judge of the samples on which a load is worst under `gains`: the others do not decide."""
        axis = gains.axis(self.sample_time)
        with np.errstate(over="ignore", invalid="ignore"):
            run = self.sweep.run(axis, _WHILE_SEARCHING * self.stretch, axis.conditioning())
        loads = np.nan_to_num(run.load_rms, nan=np.inf)
        chosen = np.argsort(loads)[::-1][:_HARDEST]
        few = replace(self.sweep, plants=self.sweep.plants[chosen].copy(), delays=self.sweep.delays[chosen])
        return replace(self, sweep=few)

    def load(self, gains: PidGains) -> float:
        """Return the worst rms from the load on [deg]."""
        axis = gains.axis(self.sample_time)
        with np.errstate(over="ignore", invalid="ignore"):
            run = self.sweep.run(axis, _WHILE_SEARCHING * self.stretch, axis.conditioning())
        worst = float(run.load_rms.max()) * self.sweep.test.size
        return worst if math.isfinite(worst) else 1e6

    def excess(self, gains: PidGains) -> float:
        """Return how far the bounds are broken, 0 if they are kept."""
        K = gains.response(self.z, self.sample_time)
        sensitivity = float(1.0 / np.abs(1.0 + K * self.loops).min())
        noise = abs(float(np.real(gains.response(np.array([-1.0 + 0.0j]), self.sample_time)[0])) * self.static_gain)
        bounds = self.settings
        return max(sensitivity / bounds.max_sensitivity - 1.0, 0.0) + max(noise / bounds.noise_gain - 1.0, 0.0)

    def kept(self, gains: PidGains) -> PidGains | None:
        """Return the gains, scaled back until every bound is kept and every sample is stable; None if none are."""
        for _ in range(_SCALINGS):
            if self.excess(gains) == 0.0 and self.load(gains) < 1e3:
                return gains
            gains = PidGains(
                0.995 * gains.gain,
                gains.integral_time,
                gains.derivative_time,
                gains.filter_time,
                gains.reference_weight,
            )
        return None


def _cost(judge: _Judge, settings: PidSettings, sign: float, x: Vector) -> float:
    """Return what the search minimises."""
    gains = settings._gains(x, sign)
    try:
        return judge.load(gains) + _PENALTY * judge.excess(gains)
    except SettingsError:
        return 1e6


def place_pid(
    plant: AxisPlant, extra_delay: int, pair: complex, third: float, filter_time: float
) -> tuple[float, float, float]:
    """Return K, K/Ti, K Td that put loop poles at `pair`, its conjugate and `-third` [rad/s]; a PI if third is 0."""
    dt = plant.sample_time
    points = [pair] if third == 0.0 else [pair, complex(-third, 0.0)]
    rows, right = [], []
    for s in points:
        z = np.exp(s * dt)
        back = 1.0 - 1.0 / z
        terms = [1.0 + 0j, dt / back, back / (dt + filter_time * back)][: 2 if third == 0.0 else 3]
        G = np.polyval(plant.numerator, z) / np.polyval(plant.denominator, z) * z ** (-(plant.delay + extra_delay))
        for part in (np.real, np.imag) if s.imag else (np.real,):
            rows.append([float(part(term)) for term in terms])
            right.append(float(part(-1.0 / G)))
    found = np.linalg.solve(np.array(rows), np.array(right))
    return float(found[0]), float(found[1]), float(found[2]) if found.size > 2 else 0.0
