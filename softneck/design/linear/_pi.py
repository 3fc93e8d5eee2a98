"""PI control of both axes: as much integral action as the asked robustness allows."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from softneck.core import Matrix, SettingsError, require_between, require_one_of, require_positive
from softneck.estimation._axis import HasTransferFunctions
from softneck.loop.default_limits import DESIGN_OVERSHOOT_PCT
from softneck.robot._neck_default import NeckDefault

from ..plants._held import held
from ..plants._uncertain import UncertainAxis, UncertainPlant, uncertain_plant
from ._assembly import ReferenceFilter, assemble, pi_axis
from ._axis_loop import sensitivities, unstable_samples
from ._axis_settings import axis_test, filter_numbers, margins_json, slowest
from ._controller import LinearController
from ._loop_settings import LoopSettings, check_reference
from ._margins import LOWEST, loop_margins
from ._pid import place_pid
from ._ports import ControllerLimits
from ._rise import check_rise, filter_for, leading_filter
from ._tuning import Gains, Plants, open_loop, reference_time, tune_pi

TUNINGS = ("nominal", "samples", "placement")


@dataclass(frozen=True, slots=True, kw_only=True)
class PiSettings(LoopSettings):
    """PI on the exact-delay discrete plant, `v = K (e + 1/Ti int e)`, tuned for robustness.

    Among all K, Ti whose loop keeps the sensitivity and the phase margin, that with the largest K/Ti is taken:
    it rejects loads best (Astrom and Hagglund 2006, Advanced PID Control, sec. 6.8). What overshoot that
    leaves, a reference filter takes away.

    Limits, the order of the loop and what is doubted of the plant are those of `LoopSettings`.

    Attributes:
        tuning: "nominal": on the identified plant and on its faster form; "samples": on every sample of the plant as
            well; "placement": the gains that put two poles of the nominal loop where they are wanted, exact for the
            delay. The loop is verified on every sample whatever is chosen.
        frequency: of the placed poles [rad/s].
        damping: of the placed poles.
        max_sensitivity: bound on Ms, on the identified plant and on its faster form.
        phase_margin: least phase margin [rad], on both.
        reference_time: time constant of the reference filter [s]; None for the least with which no plant within
            `gain_spread` overshoots by more than `overshoot_pct`. Of another robot the main pole's, if not given.
        reference_lead: T1 of that filter, (1 + T1 s)/(1 + T2 s), where `reference_time` is given, as a part of the
            loop's own lag (its rise over ln 9): what moves is followed the closer, and a step overshoots rather.
        overshoot_pct: of a step, without limits.
        gain_spread: relative spread of the plant's gain that the filter allows for.
        sample_time: [s] at which a continuous `control` system is held (exact); None for 20 ms. Other plants have their
            own.
    """

    tuning: str = "nominal"
    frequency: float = 5.0
    damping: float = 0.9
    max_sensitivity: float = 1.5
    phase_margin: float = math.radians(60.0)
    # About the time constant of the paper's neck, 1/5.293 s: what is asked faster only runs into limits.
    reference_time: float | None = NeckDefault(0.2)
    reference_lead: float = 0.0
    overshoot_pct: float = DESIGN_OVERSHOOT_PCT
    gain_spread: float = 0.2
    sample_time: float | None = None

    def __post_init__(self) -> None:
        LoopSettings.__post_init__(self)
        require_one_of("tuning", self.tuning, TUNINGS)
        require_positive("frequency", self.frequency, "rad/s")
        require_between("damping", self.damping, 0.1, 1.0)
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        require_between("phase_margin", self.phase_margin, 0.1, 1.5, "rad")
        check_reference(self.reference_time, self.reference_lead)
        require_between("overshoot_pct", self.overshoot_pct, 0.1, 100.0, "%")
        require_between("gain_spread", self.gain_spread, 0.0, 0.9)
        if self.sample_time is not None:
            require_positive("sample_time", self.sample_time, "s")

    def design(self, model: HasTransferFunctions) -> LinearController:
        """Return the controller for `model`, anything with `tf("pitch")` and `tf("roll")`, or of another robot.

        Raises:
            SettingsError: a model that is not linear, discrete and stable, or no gains that keep the robustness.
        """
        settings, plant = held(self, model)
        uncertain = uncertain_plant(plant)
        return settings.of_robot(uncertain)._designed(uncertain)

    def _others(self, plant: UncertainPlant) -> dict[str, Any]:
        slowest = max(axis.nominal.time_constant for axis in plant.axes.values())
        return {**LoopSettings._others(self, plant), "reference_time": slowest}

    def _designed(self, uncertain: UncertainPlant) -> LinearController:
        sample_time, names, limits = uncertain.sample_time, uncertain.names, self.limits(uncertain.robot)
        redefinition = self.redefinition(uncertain)
        plants = [uncertain.axis(axis).prepared(self.least_delay, self.small_move_pole) for axis in names]
        families = [self._family(plant) for plant in plants]
        tuned: list[Gains] = []
        filters: list[ReferenceFilter] = []
        for i, plant in enumerate(plants):
            # Axes that are the same plants are tuned once.
            same = next((j for j in range(i) if plants[j].same_as(plant)), None)
            tuned.append(self._tuned(families[i]) if same is None else tuned[same])
            filters.append(
                self._filter(families[i], tuned[i], limits, redefinition[1]) if same is None else filters[same]
            )
        found = {
            axis: _findings(plant, len(self._small(plant)), self.extra_delay, gains, time)
            for axis, plant, gains, time in zip(names, plants, tuned, filters, strict=True)
        }
        for axis in names if self.tuning == "samples" else ():
            if found[axis]["samples_unstable"]:
                raise SettingsError(f"{axis}: not every sample is stable; lower `max_sensitivity`.")
        return LinearController(
            kind="pi",
            sample_time=sample_time,
            arrays=assemble(
                [pi_axis(gains.gain, gains.integral_time, sample_time) for gains in tuned],
                filters=(*filters, slowest(filters)),
                redefinition=redefinition,
                constants=limits.constants(sample_time),
            ),
            limits=limits,
            order=self.order,
            design={
                "settings": asdict(self),
                "extra_delay": self.extra_delay,
                "assumed": self.assumed(uncertain),
                **found,
            },
        )

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

    def _filter(self, family: Plants, gains: Gains, limits: ControllerLimits, inverse: Matrix) -> ReferenceFilter:
        plant = family[0]
        axis = pi_axis(gains.gain, gains.integral_time, plant.sample_time)
        if self.rise_s is not None:
            check_rise(self.rise_s, plant, axis_test(plant, limits, inverse))
            return filter_for(self.rise_s, axis, plant, self.extra_delay)
        if self.reference_time is not None:
            return leading_filter(self.reference_time, self.reference_lead, axis, plant, self.extra_delay)
        # Samples say themselves how the gain spreads.
        spread = 0.0 if self.tuning == "samples" and len(family) > 2 else self.gain_spread
        return ReferenceFilter(
            reference_time(family, self.extra_delay, gains, gain_spread=spread, overshoot=self.overshoot_pct / 100.0)
        )


def _findings(plant: UncertainAxis, small: int, extra_delay: int, gains: Gains, led: ReferenceFilter) -> dict[str, Any]:
    """Return gains and margins of one axis as JSON values; None stands for infinity."""
    family = plant.samples[:small]
    lowest = LOWEST / plant.nominal.stretch
    margins = [margins_json(loop_margins(open_loop(item, extra_delay, gains), lowest=lowest)) for item in family]
    axis = pi_axis(gains.gain, gains.integral_time, plant.sample_time)
    lost = unstable_samples(axis, plant.samples, extra_delay)
    named = {"K": gains.gain, "Ti_s": gains.integral_time, **filter_numbers(led)}
    dead_time = (family[0].delay + extra_delay) * family[0].sample_time
    return {
        "gains": named,
        "dead_time_s": dead_time,
        "margins": margins[0],
        "margins_small_moves": margins[-1],
        "samples": len(plant.samples),
        "samples_unstable": len(lost),
        "worst_sensitivity": None if lost else float(sensitivities(axis, plant.samples, extra_delay).max()),
    }
