"""PI control of both axes: as much integral action as the asked robustness allows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from softneck.core import SettingsError, require_between, require_one_of
from softneck.loop.default_limits import DESIGN_OVERSHOOT_PCT

from ..plants._uncertain import UncertainAxis, UncertainPlant
from ._assembly import AxisController, ReferenceFilter, pi_axis
from ._axis_loop import LOWEST, loop_margins, sensitivities, unstable_samples
from ._axis_settings import AxisDesign, AxisSettings, margins_json
from ._loop_settings import PLANT
from ._tuning import Gains, Plants, open_loop, reference_time, tune_pi

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

    def _prepared(self, axis: UncertainAxis) -> UncertainAxis:
        return axis.prepared()

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        small, extra = self._small(axis), self.extra_delay
        gains = tune_pi(self._family(axis), extra, self.max_sensitivity, self.phase_margin)
        controller, lowest = pi_axis(gains.gain, gains.integral_time, axis.sample_time), LOWEST / axis.nominal.second
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
        spread = 0.0 if self.tuning == "samples" and len(family) > 2 else axis.doubts.gain_spread
        return reference_time(family, self.extra_delay, gains, gain_spread=spread, overshoot=self.OVERSHOOT_PCT / 100.0)

    def _conditioned(self, controller: AxisController, led: ReferenceFilter, axis: UncertainAxis) -> AxisController:  # noqa: ARG002
        # Hanus' is right for one integral, and what a step is asked for stays what `reference_time` makes of it.
        return controller

    def _family(self, plant: UncertainAxis) -> Plants:
        """Return what the gains must hold on."""
        return plant.samples if self.tuning == "samples" else self._small(plant)

    def _small(self, plant: UncertainAxis) -> Plants:
        """Return the plant as identified, and faster where it is slow; the samples of its own come after those."""
        pole = plant.doubts.small_move_pole
        faster = plant.nominal.faster(pole) if pole > 0.0 else plant.nominal
        return plant.samples[: 1 if faster is plant.nominal else 2]
