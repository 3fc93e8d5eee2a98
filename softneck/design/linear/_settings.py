"""Settings that all linear designs share, and the design of each axis: filter, conditioning, verification."""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from softneck.core import Matrix, SettingsError, require_between, require_finite, require_one_of, require_positive
from softneck.estimation import ORDERS, AxisPlant
from softneck.loop.default_limits import DESIGN_OVERSHOOT_IN_LIMITS_PCT
from softneck.robot import Robot, Scaling, find_robot

from ..plants._uncertain import (
    DEFAULT_SAMPLE_TIME_S,
    StepAndLoad,
    UncertainAxis,
    UncertainPlant,
    discretize_zoh,
    uncertain_plant,
)
from ._axis_loop import (
    Sweep,
    axis_margins,
    check_rise,
    closed_poles,
    conditioning_candidates,
    filter_for,
    leading_filter,
    make_sweep,
    sensitivities,
    unstable_samples,
)
from ._controller import AxisController, LinearController, ReferenceFilter, assemble
from ._feedforward import follow_large_moves, follow_model
from ._margins import Margins, require_stable
from ._ports import ControllerLimits, limits_of

#: Of `reference_time`: as slow as the plant's main pole.
PLANT = "plant"


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """Settings that all designs around a linear plant share; a kind adds its own and `design`.

    A kind calls `LoopSettings.__post_init__(self)` by name: with slots `super()` would look in the wrong class.

    How far and how fast motors go, and how often, is in the robot's file.

    Attributes:
        lead_limit: how far a set-point may be from its measured motor [SI]; keeps the integral
            from winding up while a drive at its current limit falls behind. None: of the neck 0.4 rad, without a
            nominal set-point no limit.
        least_cocontraction: the co-contraction reference is at least this [SI]; keeps tendons
            taut under a payload. None for no such rule.
        order: of the loop; "jacobi" adds one sample for the controller and one for the observer.
        rise_s: time [s] in which a step on the nominal plant rises from 10 to 90 %, no limit acting; the reference
            filter is made for it in the place of `reference_time`. None: by that.
    """

    #: How far a set-point may be from its motor, scaled.
    LEAD: ClassVar[float] = 0.4

    lead_limit: float | None = None
    least_cocontraction: float | None = None
    order: str = "sequential"
    rise_s: float | None = None

    def __post_init__(self) -> None:
        require_one_of("order", self.order, ORDERS)
        if self.lead_limit is not None:
            require_positive("lead_limit", self.lead_limit)
        if self.least_cocontraction is not None:
            require_finite("least_cocontraction", self.least_cocontraction)
        if self.rise_s is not None:
            require_between("rise_s", self.rise_s, 0.001, 1e6, "s")
            given = getattr(self, "reference_time", None)
            if given is not None and given != PLANT:
                raise SettingsError("`rise_s` sets the reference filter; give it or `reference_time`, not both.")

    def of_robot(self, plant: UncertainPlant) -> Self:
        """Return the settings with the defaults that depend on the plant."""
        usual = {k: v for k, v in self._defaults(plant).items() if getattr(self, k) in (None, PLANT)}
        if self.rise_s is not None:
            usual.pop("reference_time", None)
        return replace(self, **usual)

    def _defaults(self, plant: UncertainPlant) -> dict[str, Any]:
        """Return settings that depend on the plant, where they are not given."""
        if plant.robot.motors.nominal is None:
            return {}
        return {"lead_limit": self.LEAD * Scaling.of(plant.robot).motor_unit}

    def limits(self, robot: Robot) -> ControllerLimits:
        """Return the limits of the set-points. Raises SettingsError: a robot's limit that its file does not say."""
        return limits_of(robot, lead_limit=self.lead_limit, least_cocontraction=self.least_cocontraction)

    @property
    def extra_delay(self) -> int:
        """Samples that the loop's order adds to the plant's delay: of the controller and of the observer."""
        return 0 if self.order == "sequential" else 2


def reference_numbers(given: Any) -> tuple[float | None, float, float]:
    """Return T2 [s], lead and feedforward of a `reference_time`, which gives all, the first two or T2 alone.

    Raises SettingsError: no such filter.
    """
    numbers = list(given) if isinstance(given, list | tuple) else [None if given == PLANT else given, 0.0]
    if len(numbers) not in (2, 3):
        raise SettingsError(f"`reference_time` is T2 [s], [T2, lead] or [T2, lead, feedforward]; got {given!r}.")
    time, lead, feedforward = numbers if len(numbers) == 3 else [*numbers, 0.0]
    if time is not None:
        require_between("reference_time", time, 0.0, 1e6, "s")
    require_between("lead of reference_time", lead, 0.0, 10.0)
    require_between("feedforward of reference_time", feedforward, 0.0, 10.0)
    if lead + feedforward > 0.0 and not time:
        raise SettingsError("a `reference_time` of [T2, lead] needs a T2 above 0.")
    return time, lead, feedforward


# A reference filter slower than this [samples] would be no answer to overshoot.
_MAX_FILTER_SAMPLES = 100
# Another conditioning than Hanus' must overshoot less by this [%].
_MIN_IMPROVEMENT_PCT = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class AxisDesign:
    """The result of a synthesis for one axis.

    `controller`: of the axis. `gains`: its numbers by name, for people. `notes`: more numbers, such as gamma.
    """

    controller: AxisController
    gains: dict[str, float]
    notes: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisSettings(LoopSettings, ABC):
    """Settings that all kinds of linear controller share; a kind adds its own and one synthesis.

    Limits and the order of the loop are those of `LoopSettings`.

    Attributes:
        max_sensitivity: bound on Ms around every sample of the plant; what a kind chooses itself keeps it.
        reference_time: T2 of the reference filter (1 + T1 s)/(1 + T2 s) [s]; None for the least with which no sample
            overshoots a step of 10 deg by more than 4 %, from half the plant's lag on. Or T2 and lead, [0.2, 0.5]: T1
            is that part of the loop's own lag (its rise over ln 9); what moves is followed the closer, and a step
            overshoots rather. Or T2, lead and feedforward, [0.1, 0.9, 1]: the filtered reference goes to the motors at
            once, times the third over the plant's static gain, and the feedback compares the output with the plant's
            response (model following). The plant is the nominal one, or of a family with draws the one of large steps.
    """

    KIND: ClassVar[str]
    OVERSHOOT_PCT: ClassVar[float] = DESIGN_OVERSHOOT_IN_LIMITS_PCT

    max_sensitivity: float = 2.0
    reference_time: float | Sequence[float] | str | None = None

    def __post_init__(self) -> None:
        LoopSettings.__post_init__(self)
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 10.0)
        reference_numbers(self.reference_time)

    def design(self, plant: Any, *, robot: Robot | str | Path | None = None) -> LinearController:
        """Return the controller for `plant`, verified on every sample.

        `plant`: whatever `uncertain_plant` takes, continuous `control` systems as well; `lqg` and `custom` take systems
        of any size. `robot`: whose limits count, itself, a preset or a file; None: those that the plant says. Raises
        SettingsError: a plant that does not fit, no solution, or a loop that does not hold on every sample.
        """
        whose = None if robot is None else find_robot(robot)
        period, taken = discretize_zoh(plant, self._period(whose))
        made = self._design_plant(taken, whose)
        return made if period is None else replace(made, design={**made.design, "held_s": period})

    def _period(self, robot: Robot | None) -> float:
        """Sample time [s] at which a continuous plant is held."""
        return (robot and robot.sample_time_s) or DEFAULT_SAMPLE_TIME_S

    def _design_plant(self, plant: Any, robot: Robot | None) -> LinearController:
        """Return the controller for any source of `uncertain_plant`; `lqg` and `custom` also take coupled plants."""
        uncertain = uncertain_plant(plant, robot)
        return self.of_robot(uncertain)._design_axes(uncertain)

    def _design_axes(self, uncertain: UncertainPlant) -> LinearController:
        limits, redefinition = self.limits(uncertain.robot), uncertain.redefinition
        if reference_numbers(self.reference_time)[2] > 0.0:
            uncertain = follow_large_moves(uncertain, limits)
        axes = {name: self._prepare_axis(uncertain.axis(name)) for name in uncertain.names}
        axes = {
            name: replace(axis, test=axis_test(axis.nominal, limits, redefinition[1])) for name, axis in axes.items()
        }
        made: dict[str, tuple[AxisController, ReferenceFilter, dict[str, Any]]] = {}
        for name, axis in axes.items():
            same = next((other for other in made if self._is_shared() and axis.same_as(axes[other])), None)
            if same is not None:
                made[name] = made[same]
                continue
            try:
                made[name] = self._design_axis(axis, name)
            except SettingsError as error:
                raise SettingsError(f"{name}: {error}") from error
        filters = [made[name][1] for name in axes]
        return LinearController(
            kind=self.KIND,
            sample_time=uncertain.sample_time,
            arrays=assemble(
                [made[name][0] for name in axes],
                # Of co-contraction the slowest, without lead.
                filters=(*filters, ReferenceFilter(max(item.time for item in filters))),
                redefinition=redefinition,
                constants=limits.constants(uncertain.sample_time),
            ),
            limits=limits,
            order=self.order,
            design={
                "settings": self._settings_json(),
                "extra_delay": self.extra_delay,
                "assumed": uncertain.assumptions(),
                **{name: item[2] for name, item in made.items()},
            },
        )

    @abstractmethod
    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:
        """Return the controller of one axis, named by its output."""

    def _is_shared(self) -> bool:
        """Return whether equal axes get the same controller."""
        return True

    def _settings_json(self) -> dict[str, Any]:
        return asdict(self)

    def _prepare_axis(self, axis: UncertainAxis) -> UncertainAxis:
        """Return the axis as it is designed for."""
        return axis.spread_gain()

    def _design_axis(self, axis: UncertainAxis, name: str) -> tuple[AxisController, ReferenceFilter, dict[str, Any]]:
        found = self._synthesise(axis, name)
        controller = found.controller
        plants = (axis.nominal, *axis.samples)
        require_stable(closed_poles(controller, plants[:1], self.extra_delay))
        self._require_stable(controller, axis)
        feedforward = reference_numbers(self.reference_time)[2]
        if feedforward > 0.0:
            controller = follow_model(controller, axis.followed or axis.nominal, self.extra_delay, feedforward)
        led = self._choose_filter(controller, axis)
        controller = self._choose_conditioning(controller, led, axis)
        margins = axis_margins(controller, plants, self.extra_delay)
        worst = margins.worst()
        more = {"reference_lead_s": led.lead} if led.lead else {}
        more |= {"feedforward": feedforward} if feedforward else {}
        findings = {
            "gains": {**found.gains, "reference_time_s": led.time, **more},
            "dead_time_s": (axis.nominal.delay + self.extra_delay) * axis.sample_time,
            "margins": margins_json(margins.of(0)),
            "states": int(controller.A.shape[0]),
            "samples": len(axis.samples),
            "samples_unstable": int(np.isinf(margins.sensitivity[1:]).sum()),
            "worst_sensitivity": worst.sensitivity if math.isfinite(worst.sensitivity) else None,
            **found.notes,
        }
        if axis.family > 1:
            findings |= {"family": axis.family, "margins_family": margins_json(worst)}
        if axis.band is not None:
            findings["band_rad_s"] = list(axis.band)
        return controller, led, findings

    def _require_stable(self, controller: AxisController, axis: UncertainAxis) -> None:
        """Raise unless the loop is stable around every sample, its delay exact."""
        lost = unstable_samples(controller, axis.samples, self.extra_delay)
        if lost:
            raise SettingsError(
                f"the loop is not stable around {len(lost)} of {len(axis.samples)} samples (the first is sample "
                f"{lost[0]}); ask for less speed, or lower `max_sensitivity`."
            )

    def _choose_filter(self, controller: AxisController, axis: UncertainAxis) -> ReferenceFilter:
        """Return the reference filter: for `rise_s`, of `reference_time`, or the fastest that keeps the overshoot."""
        if self.rise_s is not None:
            if axis.test is not None:
                check_rise(self.rise_s, axis.nominal, axis.test)
            return filter_for(self.rise_s, controller, axis.nominal, self.extra_delay)
        time, lead, _ = reference_numbers(self.reference_time)
        if time is not None:
            return leading_filter(time, lead, controller, axis.nominal, self.extra_delay)
        return ReferenceFilter(self._least_filter_time(controller, axis))

    def _least_filter_time(self, controller: AxisController, axis: UncertainAxis) -> float:
        """Bisect the smallest filter time [s], in whole samples, that keeps the overshoot of all plants."""
        sweep, L = self._sweep(axis), controller.conditioning()

        def keeps(samples: int) -> bool:
            return bool(sweep.run(controller, samples * axis.sample_time, L).overshoot.max() <= self.OVERSHOOT_PCT)

        low, high = _fastest_filter(axis.nominal), _slowest_filter(axis.nominal)
        return least_filter(keeps, low, high, axis.sample_time, self.OVERSHOOT_PCT)

    def _choose_conditioning(
        self, controller: AxisController, led: ReferenceFilter, axis: UncertainAxis
    ) -> AxisController:
        """Return the controller with the conditioning of the smallest overshoot under limits.

        Of Hanus' (what a limit took away is taken from the reference) and of predictors that follow the limited output
        faster, on the worst sample in a step of 20 deg and in one with half the slew.
        """
        usual = self._sweep(axis)
        large = replace(usual, test=replace(usual.test, reference=2.0 * usual.test.reference))
        slow = replace(usual, test=replace(usual.test, slew_limit=0.5 * usual.test.slew_limit))

        def worst(L: Matrix) -> float:
            with np.errstate(over="ignore", invalid="ignore"):
                peaks = [float(sweep.run(controller, led, L).overshoot.max()) for sweep in (large, slow)]
            return max(peaks) if np.isfinite(peaks).all() else math.inf

        best, least = controller.conditioning(), worst(controller.conditioning()) - _MIN_IMPROVEMENT_PCT
        for L in conditioning_candidates(controller):
            found = worst(L)
            # What is asked for within the limits must not suffer.
            if found < least and usual.run(controller, led, L).overshoot.max() <= self.OVERSHOOT_PCT:
                best, least = L, found
        return replace(controller, L=best)

    def _sweep(self, axis: UncertainAxis) -> Sweep:
        """Return the samples ready for steps within the limits of the motors."""
        return make_sweep(axis.samples, extra_delay=self.extra_delay, test=axis.test)

    def _sensitivity(self, controller: AxisController, axis: UncertainAxis) -> float:
        """Return the largest Ms of the samples; inf where one is not stable."""
        return float(sensitivities(controller, axis.samples, self.extra_delay).max())

    def _fastest(
        self, build: Callable[[float], AxisDesign], axis: UncertainAxis, *, low: float, high: float, what: str
    ) -> AxisDesign:
        """Return the result of `build(speed)` for the largest speed [rad/s] at which all loops keep `max_sensitivity`.

        Raises SettingsError: not even the lowest does.
        """
        best: AxisDesign | None = None

        def excess(speed: float) -> float:
            """Return how far the distance to -1 is below the one required; at most 0 where it is kept."""
            nonlocal best
            found, peak = None, math.inf
            with contextlib.suppress(SettingsError):  # the synthesis has no solution
                found = build(speed)
                peak = self._sensitivity(found.controller, axis)
            if peak <= self.max_sensitivity:
                best = found
            elif speed == low:
                raise SettingsError(
                    f"not even a {what} of {low:.3g} rad/s keeps Ms <= {self.max_sensitivity:g} on all "
                    f"{len(axis.samples)} samples; raise `max_sensitivity`, or give `{what}` and see what is lost."
                )
            return 1.0 / self.max_sensitivity - (1.0 / peak if peak > 0.0 else 0.0)

        # Two decades to 3 %.
        last_kept(excess, low, high, halvings=math.ceil(math.log2(math.log(high / low) / 0.03)))
        return best  # pyright: ignore[reportReturnType] - where nothing else is kept, `low` was tried


def last_kept(excess: Callable[[float], float], low: float, high: float, *, halvings: int) -> float:
    """Return the end at which the excess is at most 0 after halvings of log(low) to log(high), by fewer tries.

    The excess is at most 0 at `low`, which is tried where the first halving is not kept, and changes its sign once; at
    `high`, which is not tried, it counts as positive. Tried are the ends of the last interval where a parabola through
    three tries crosses 0, in the end halvings.
    """
    kept, lost, before, tries = (low, math.nan), (high, math.inf), (high, math.inf), 0
    while True:
        if kept[0] == low and lost[0] < high and math.isnan(kept[1]):
            kept = (low, excess(low))
        # A function that five tries did not follow is halved.
        halved = math.isinf(lost[1]) or tries > 4
        crossing = math.nan if halved else _crossing(kept, lost, before)
        a, b = low, high
        for _ in range(halvings):
            middle = math.sqrt(a * b)
            inside = kept[0] < middle < lost[0]
            if inside and halved:
                a = middle
                break
            a, b = (middle, b) if middle <= kept[0] or (inside and middle <= crossing) else (a, middle)
        if (a, b) == (kept[0], lost[0]):
            return a
        tried = a if a > kept[0] else b
        found = (tried, excess(tried))
        kept, lost, before = (found, lost, kept) if found[1] <= 0.0 else (kept, found, lost)
        tries += 1


def _crossing(*points: tuple[float, float]) -> float:
    """Return where a function of log(x) is 0, by the values at `points`: below, above, and one more.

    By inverse quadratic interpolation (Brent 1973, Algorithms for Minimization Without Derivatives, sec. 4.2), and by
    the chord of the first two where that is not between them.
    """
    (low, below), (high, above), _ = points
    values = [value for _, value in points]
    if len(set(values)) == 3 and math.isfinite(sum(values)):
        weights = [math.prod(other / (other - value) for other in values if other != value) for value in values]
        found = sum(w * math.log(x) for w, (x, _) in zip(weights, points, strict=True))
        if math.log(low) < found < math.log(high):
            return math.exp(found)
    return low * (high / low) ** (below / (below - above))


def axis_test(plant: AxisPlant, limits: ControllerLimits, inverse: Matrix) -> StepAndLoad:
    """Return the step and the load that a controller of this axis is judged by."""
    # The motor that moves most has 2/3 of theta_i (Eq. 9), 0.577 of phi_i: the tighter one is taken.
    share = float(np.abs(inverse[:, :-1]).max())
    test = StepAndLoad(
        sample_time=plant.sample_time,
        position_limit=limits.position_limit / share,
        slew_limit=limits.slew_limit * plant.sample_time / share,
    )
    test = replace(test, load_at=plant.second * test.load_at, duration=plant.second * test.duration)
    if limits.robot.motors.nominal is not None:
        scaling = Scaling.of(limits.robot)
        reference = float(scaling.output_unit.max()) * test.reference
        return replace(test, reference=reference, load=scaling.motor_unit * test.load, size=test.reference / reference)
    # As large for this robot as 10 deg and -0.5 rad are for a neck, which they take 2 of 9 rad.
    asked = 2.0 / 9.0 * test.position_limit * abs(plant.static_gain)
    return replace(test, reference=asked, load=-0.5 / 9.0 * test.position_limit, size=test.reference / asked)


def least_filter(keeps: Callable[[int], bool], low: int, high: int, sample_time: float, overshoot_pct: float) -> float:
    """Return the smallest filter time [s] of `low` to `high` samples that keeps the overshoot.

    Raises SettingsError: not even `high` does.
    """
    if keeps(low):
        return low * sample_time
    if not keeps(high):
        raise SettingsError(
            f"no reference filter up to {high * sample_time:g} s keeps the overshoot below {overshoot_pct:g} % on "
            "every sample; lower `max_sensitivity`, or give `reference_time`."
        )
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if keeps(middle) else (middle, high)
    return high * sample_time


def _fastest_filter(plant: AxisPlant) -> int:
    """Return half the plant's lag [samples]: a reference that is faster only runs into the motors' limits."""
    return min(round(0.5 * plant.time_constant / plant.sample_time), _slowest_filter(plant) // 2)


def _slowest_filter(plant: AxisPlant) -> int:
    """Return the slowest reference filter that is tried [samples]: 2 s of a neck at 20 ms."""
    return max(_MAX_FILTER_SAMPLES, math.ceil(2.0 * plant.second / plant.sample_time))


def margins_json(margins: Margins) -> dict[str, float | None]:
    """Return margins as JSON values; None means infinity."""
    return {name: value if math.isfinite(value) else None for name, value in asdict(margins).items()}
