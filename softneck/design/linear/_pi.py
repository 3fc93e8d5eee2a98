"""PI control of both axes: as much integral action as the asked robustness allows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from softneck.core import SettingsError, require_between, require_one_of, require_positive
from softneck.loop.default_limits import DESIGN_OVERSHOOT_PCT
from softneck.robot._neck_default import NeckDefault

from ..plants._uncertain import UncertainAxis, UncertainPlant
from ._assembly import AxisController, ReferenceFilter, pi_axis
from ._axis_loop import sensitivities, unstable_samples
from ._axis_settings import AxisDesign, AxisSettings, margins_json
from ._loop_settings import LoopSettings
from ._margins import LOWEST, loop_margins
from ._pid import place_pid
from ._tuning import Gains, Plants, open_loop, reference_time, tune_pi

TUNINGS = ("nominal", "samples", "placement")


@dataclass(frozen=True, slots=True, kw_only=True)
class PiSettings(AxisSettings):
    """PI on the exact-delay discrete plant, `v = K (e + 1/Ti int e)`, tuned for robustness.

    Among all K, Ti whose loop keeps the sensitivity and the phase margin, that with the largest K/Ti is taken:
    it rejects loads best (Astrom and Hagglund 2006, Advanced PID Control, sec. 6.8). What overshoot that
    leaves, a reference filter takes away: without limits, no plant within `gain_spread` overshoots by more than
    `overshoot_pct`.

    Reference filter and order, with limits and loop, are those of `AxisSettings`; by default the filter is as slow as
    the plant's main pole.

    Attributes:
        tuning: "nominal": on the identified plant and on its faster form; "samples": on every sample of the plant as
            well; "placement": the gains that put two poles of the nominal loop where they are wanted, exact for the
            delay. The loop is verified on every sample whatever is chosen.
        frequency: of the placed poles [rad/s].
        damping: of the placed poles.
        phase_margin: least phase margin [rad], where `max_sensitivity` is kept.
    """

    KIND: ClassVar[str] = "pi"

    tuning: str = "nominal"
    frequency: float = 5.0
    damping: float = 0.9
    max_sensitivity: float = 1.5
    phase_margin: float = math.radians(60.0)
    # About the time constant of the paper's neck, 1/5.293 s: what is asked faster only runs into limits.
    reference_time: float | None = NeckDefault(0.2)
    overshoot_pct: float = DESIGN_OVERSHOOT_PCT

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        require_one_of("tuning", self.tuning, TUNINGS)
        require_positive("frequency", self.frequency, "rad/s")
        require_between("damping", self.damping, 0.1, 1.0)
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        require_between("phase_margin", self.phase_margin, 0.1, 1.5, "rad")

    def _others(self, plant: UncertainPlant) -> dict[str, Any]:
        slowest = max(axis.nominal.time_constant for axis in plant.axes.values())
        return {**LoopSettings._others(self, plant), "reference_time": slowest}

    def _prepared(self, axis: UncertainAxis) -> UncertainAxis:
        return axis.prepared(self.least_delay, self.small_move_pole)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        gains, small, extra = self._tuned(self._family(axis)), self._small(axis), self.extra_delay
        controller, lowest = pi_axis(gains.gain, gains.integral_time, axis.sample_time), LOWEST / axis.nominal.stretch
        margins = [margins_json(loop_margins(open_loop(plant, extra, gains), lowest=lowest)) for plant in small]
        lost = unstable_samples(controller, axis.samples, extra)
        notes = {
            "margins": margins[0],
            "margins_small_moves": margins[-1],
            "samples_unstable": len(lost),
            "worst_sensitivity": None if lost else float(sensitivities(controller, axis.samples, extra).max()),
        }
        return AxisDesign(controller, {"K": gains.gain, "Ti_s": gains.integral_time}, notes)

    def _hold(self, controller: AxisController, axis: UncertainAxis) -> None:
        if self.tuning == "samples" and unstable_samples(controller, axis.samples, self.extra_delay):
            raise SettingsError("not every sample is stable; lower `max_sensitivity`.")

    def _reference_time(self, controller: AxisController, axis: UncertainAxis) -> float:
        gains, family = Gains(controller.Dr, axis.sample_time / float(controller.Br[0, 0])), self._family(axis)
        # Samples say themselves how the gain spreads.
        spread = 0.0 if self.tuning == "samples" and len(family) > 2 else self.gain_spread
        return reference_time(family, self.extra_delay, gains, gain_spread=spread, overshoot=self.overshoot_pct / 100.0)

    def _conditioned(self, controller: AxisController, led: ReferenceFilter, axis: UncertainAxis) -> AxisController:  # noqa: ARG002
        # Hanus' is right for one integral, and what a step is asked for stays what `reference_time` makes of it.
        return controller

    def _family(self, plant: UncertainAxis) -> Plants:
        """Return what the gains must hold on."""
        return plant.samples if self.tuning == "samples" else self._small(plant)

    def _small(self, plant: UncertainAxis) -> Plants:
        """Return the plant as identified, and faster where it is slow; the samples of its own come after those."""
        faster = plant.nominal.faster(self.small_move_pole) if self.small_move_pole > 0.0 else plant.nominal
        return plant.samples[: 1 if faster is plant.nominal else 2]

    def _tuned(self, family: Plants) -> Gains:
        if self.tuning != "placement":
            return tune_pi(family, self.extra_delay, self.max_sensitivity, self.phase_margin)
        pair = self.frequency * complex(-self.damping, math.sqrt(1.0 - min(self.damping, 1.0 - 1e-9) ** 2))
        K, Ki, _ = place_pid(family[0], self.extra_delay, pair, 0.0, 0.0)
        if K * family[0].static_gain <= 0.0 or Ki / K <= 0.0:
            raise SettingsError(
                f"poles at {self.frequency:.3g} rad/s with damping {self.damping:.2g} need gains of both signs "
                f"(K {K:.3g}, K/Ti {Ki:.3g}); choose another `frequency` or `damping`."
            )
        return Gains(K, K / Ki)
