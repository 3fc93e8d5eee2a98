"""PI control: the largest integral action within bounds on Ms and phase margin, and the reference filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, require_one_of
from softneck.estimation import AxisPlant
from softneck.loop.default_limits import DESIGN_OVERSHOOT_PCT

from ..plants._uncertain import UncertainAxis, UncertainPlant
from ._axis_loop import LOWEST, axis_margins, bisect, coarse_frequencies, frequencies, unstable_samples
from ._controller import AxisController, ReferenceFilter, pi_axis
from ._settings import PLANT, AxisDesign, AxisSettings, margins_json

TUNINGS = ("nominal", "samples")


@dataclass(frozen=True, slots=True, kw_only=True)
class PiSettings(AxisSettings):
    """PI on the exact-delay discrete plant, `v = K (e + 1/Ti int e)`, tuned for robustness.

    Among all K, Ti whose loop keeps the sensitivity and the phase margin, that with the largest K/Ti is taken:
    it rejects loads best (Astrom and Hagglund 2006, Advanced PID Control, sec. 6.8). What overshoot that
    leaves, a reference filter takes away.

    Reference filter and order, with limits and loop, are those of `AxisSettings`; by default the filter is as slow as
    the plant's main pole.

    Attributes:
        tuning: "nominal": on the identified plant and on its faster form; "samples": on every sample of the plant as
            well. The loop is verified on every sample whatever is chosen.
        phase_margin: least phase margin [rad], where `max_sensitivity` is kept.
    """

    KIND: ClassVar[str] = "pi"
    OVERSHOOT_PCT: ClassVar[float] = DESIGN_OVERSHOOT_PCT

    tuning: str = "nominal"
    max_sensitivity: float = 1.5
    phase_margin: float = math.radians(60.0)
    # As slow as the robot: a faster filter only drives the motors into their limits.
    reference_time: float | Sequence[float] | str | None = PLANT

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        require_one_of("tuning", self.tuning, TUNINGS)
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        require_between("phase_margin", self.phase_margin, 0.1, 1.5, "rad")

    def _defaults(self, plant: UncertainPlant) -> dict[str, Any]:
        slowest = plant.robot.time_constant_s or max(axis.nominal.time_constant for axis in plant.axes.values())
        usual = {"reference_time": slowest} if self.reference_time == PLANT else {}
        return {**AxisSettings._defaults(self, plant), **usual}

    def _prepare_axis(self, axis: UncertainAxis) -> UncertainAxis:
        return axis.apply_assumptions()

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        gains = self._keep_exactly(
            axis, tune_pi(self._tuning_plants(axis), self.extra_delay, self.max_sensitivity, self.phase_margin)
        )
        controller = pi_axis(gains.gain, gains.integral_time, axis.sample_time)
        faster = axis_margins(controller, self._nominal_plants(axis)[-1:], self.extra_delay)
        notes = {"margins_small_moves": margins_json(faster.of(0))}
        return AxisDesign(controller, {"K": gains.gain, "Ti_s": gains.integral_time}, notes)

    def _keep_exactly(self, axis: UncertainAxis, gains: Gains) -> Gains:
        """Return the gains with K lowered until the exact margins keep both bounds, which a grid may have missed."""

        def keeps(part: float) -> bool:
            controller = pi_axis(part * gains.gain, gains.integral_time, axis.sample_time)
            found = axis_margins(controller, self._tuning_plants(axis), self.extra_delay).worst()
            return (
                found.sensitivity <= _GRID_TOLERANCE * self.max_sensitivity
                and found.phase * _GRID_TOLERANCE >= self.phase_margin
            )

        if keeps(1.0):
            return gains
        low, _ = bisect(keeps, 0.0, 1.0, _REFINEMENT_STEPS)
        if low == 0.0:
            raise SettingsError(
                f"no PI gains keep Ms <= {self.max_sensitivity:g} and the phase margin around so light a mode; "
                "ask for less."
            )
        return Gains(low * gains.gain, gains.integral_time)

    def _require_stable(self, controller: AxisController, axis: UncertainAxis) -> None:
        if self.tuning == "samples" and unstable_samples(controller, axis.samples, self.extra_delay):
            raise SettingsError("not every sample is stable; lower `max_sensitivity`.")

    def _least_filter_time(self, controller: AxisController, axis: UncertainAxis) -> float:
        gains, family = Gains(controller.Dr, axis.sample_time / float(controller.Br[0, 0])), self._tuning_plants(axis)
        # Samples say themselves how the gain spreads.
        spread = 0.0 if self.tuning == "samples" and len(family) > 2 else axis.uncertainty.gain_spread
        return reference_time(family, self.extra_delay, gains, gain_spread=spread, overshoot=self.OVERSHOOT_PCT / 100.0)

    def _choose_conditioning(
        self,
        controller: AxisController,
        led: ReferenceFilter,  # noqa: ARG002
        axis: UncertainAxis,  # noqa: ARG002
    ) -> AxisController:
        # Hanus' is right for one integral, and steps keep the filter of `reference_time`.
        return controller

    def _tuning_plants(self, plant: UncertainAxis) -> Plants:
        """Return the plants that must keep the bounds."""
        return plant.samples if self.tuning == "samples" else self._nominal_plants(plant)

    def _nominal_plants(self, plant: UncertainAxis) -> Plants:
        """Return the plant as identified, and faster where it is slow; the samples of its own come after those."""
        pole = plant.uncertainty.small_move_pole
        faster = plant.nominal.with_faster_pole(pole) if pole > 0.0 else plant.nominal
        return plant.samples[: 1 if faster is plant.nominal else 2]


# Loop gains that are allowed, in units of the plant's static gain.
_LEAST_SIZE, _LARGEST_SIZE = 1e-2, 1e2
# Halvings in `_keep_exactly`: to 0.1 %.
_REFINEMENT_STEPS = 10
# Between its frequencies the grid misses this much of a well-damped peak.
_GRID_TOLERANCE = 1.005
# Integral times that are tried, in units of the plant's lag and delay together.
_TIMES = np.geomspace(0.2, 3.0, 40)
# A step response is judged over this long [s]; slower than any neck settles.
_STEP_WINDOW_S = 4.0
# Up to so many plants are judged on the fine grid and all at once; more of them 4 % apart, the deciding ones alone.
_FINE_GRID_PLANTS = 3
# A reference filter slower than this [s] would be no answer to overshoot.
_SLOWEST_FILTER_S = 2.0

Plants = tuple[AxisPlant, ...]


@dataclass(frozen=True, slots=True)
class Gains:
    """PI gains of `v = K (e + 1/Ti int e)`.

    `gain`: K [rad/rad]. `integral_time`: Ti [s].
    """

    gain: float
    integral_time: float


def tune_pi(plants: Plants, extra_delay: int, max_sensitivity: float, phase_margin: float) -> Gains:
    """Return the gains with the largest K/Ti that keep Ms and the phase margin [rad] on all `plants`.

    The plants share sample time and the sign of their gain; times and gains are tried around the first. Of many
    plants, those that decide are found by adding the worst under the gains so far until none breaks a bound.
    Raises SettingsError: none do.
    """
    plant = plants[0]
    fine = len(plants) <= _FINE_GRID_PLANTS
    w = frequencies(plant.sample_time, lowest=LOWEST / plant.second) if fine else coarse_frequencies(plant)
    z = np.exp(1j * w * plant.sample_time)
    # (plants, frequencies)
    G = np.array([item.response(w, extra_delay=extra_delay) for item in plants]) / plant.static_gain
    if len(plants) <= _FINE_GRID_PLANTS:
        return _maximise_integral_gain(G, z, plant, extra_delay, (max_sensitivity, phase_margin))
    # A bound kept between frequencies too: the coarse grid misses 0.2 % of a peak.
    bounds = (max_sensitivity / 1.002, phase_margin)
    deciding = [0]
    while True:
        found = _maximise_integral_gain(G[deciding], z, plant, extra_delay, bounds)
        loops = found.gain * plant.static_gain * G * (1.0 + plant.sample_time / found.integral_time / (z - 1.0))
        broken = [
            i
            for i in range(len(plants))
            if i not in deciding and not _keeps(loops[i : i + 1], max_sensitivity, phase_margin)
        ]
        if not broken:
            return found
        deciding.append(min(broken, key=lambda i: float(np.min(np.abs(1.0 + loops[i])))))


def _maximise_integral_gain(
    G: np.ndarray, z: np.ndarray, plant: AxisPlant, extra_delay: int, bounds: tuple[float, float]
) -> Gains:
    """Return the best gains for the responses G (plants, frequencies) at z, in units of the plant's static gain."""
    max_sensitivity, phase_margin = bounds
    lag = plant.time_constant + (plant.delay + 1 + extra_delay) * plant.sample_time
    best, best_rate = Gains(0.0, lag), 0.0
    for integral_time in lag * _TIMES:
        shape = G * (1.0 + plant.sample_time / integral_time / (z - 1.0))
        size = _largest_size(shape, max_sensitivity, phase_margin)
        if size / integral_time > best_rate:
            best, best_rate = Gains(size / plant.static_gain, float(integral_time)), size / integral_time
    if best_rate == 0.0:
        raise SettingsError(
            f"no PI gains keep Ms <= {max_sensitivity:g} and a phase margin of {math.degrees(phase_margin):g} deg; "
            "ask for less."
        )
    return best


def reference_time(plants: Plants, extra_delay: int, gains: Gains, *, gain_spread: float, overshoot: float) -> float:
    """Return the smallest time constant [s] of a reference filter that keeps the overshoot of all plants.

    `plants`: what the axis may be. `extra_delay`: samples added to their delay. `gains`: of the PI. `gain_spread`:
    relative; the gain of each plant is taken at both ends and in the middle. `overshoot`: part of the step. Raises
    SettingsError: none does that is fast enough.
    """
    from scipy.signal import lfilter

    sample_time, second = plants[0].sample_time, plants[0].second
    rows = math.ceil(_STEP_WINDOW_S * second / sample_time)
    scales = (1.0 - gain_spread, 1.0, 1.0 + gain_spread) if gain_spread > 0.0 else (1.0,)
    steps = [_step_response(plant, extra_delay, gains, rows, scale) for plant in plants for scale in scales]
    for samples in range(1 + math.ceil(_SLOWEST_FILTER_S * second / sample_time)):
        a = math.exp(-1.0 / samples) if samples else 0.0
        peak = max(float(np.max(lfilter([1.0 - a], [1.0, -a], step))) for step in steps)
        if peak <= 1.0 + overshoot:
            return samples * sample_time
    raise SettingsError("no reference filter keeps the overshoot; lower `max_sensitivity` or `gain_spread`.")


def _largest_size(shape: Matrix, max_sensitivity: float, phase_margin: float) -> float:
    """Return the largest size up to which all loops size * shape (plants, frequencies) keep both bounds, or 0.

    A small loop around a stable plant is stable, and one that keeps Ms all the way up has never crossed -1. The bound
    on Ms, |1 + size L|^2 = 1/Ms^2, is a quadratic in the size; the phase margin breaks where |size L| falls through 1
    within it.
    """
    real, squared, rest = shape.real, shape.real**2 + shape.imag**2, 1.0 - max_sensitivity**-2
    inside = real**2 - rest * squared
    touch = (real < 0.0) & (inside >= 0.0)
    sizes = rest / (np.sqrt(inside[touch]) - real[touch])
    close = -real[:, 1:] > math.cos(phase_margin) * np.sqrt(squared[:, 1:])
    fall = squared[:, :-1][close & (squared[:, :-1] > squared[:, 1:])]
    size = min(sizes.min(initial=_LARGEST_SIZE), 1.0 / math.sqrt(fall.max(initial=_LARGEST_SIZE**-2)))
    return (1.0 - 1e-9) * float(size) if size >= _LEAST_SIZE else 0.0  # rounding must not end beyond a bound


def _keeps(loops: Matrix, max_sensitivity: float, phase_margin: float) -> bool:
    """Return whether the responses of all loops keep both bounds."""
    if np.min(np.abs(1.0 + loops)) * max_sensitivity < 1.0:
        return False
    below = np.abs(loops) < 1.0
    crossing = loops[:, 1:][~below[:, :-1] & below[:, 1:]]
    return bool(np.all(np.abs(np.angle(-crossing)) >= phase_margin))


def _step_response(plant: AxisPlant, extra_delay: int, gains: Gains, rows: int, scale: float) -> Vector:
    """Return the closed loop's step response (rows,), the plant's gain scaled, without limits."""
    import control
    from scipy.signal import lfilter

    rate = plant.sample_time / gains.integral_time
    pi = control.TransferFunction([gains.gain, gains.gain * (rate - 1.0)], [1.0, -1.0], plant.sample_time)
    loop = pi * plant.tf(extra_delay=extra_delay)
    numerator, denominator = scale * np.asarray(loop.num[0][0]), np.asarray(loop.den[0][0])
    padded = np.concatenate([np.zeros(denominator.size - numerator.size), numerator])
    return np.asarray(lfilter(padded, denominator + padded, np.ones(rows)))
