"""Linear model predictive control: settings and design of the controller."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from softneck.core import Matrix, ReprMixin, SettingsError, Vector, require_between, require_finite, require_one_of
from softneck.estimation import ORDERS
from softneck.robot import Robot, find_robot

from ..linear._axis_loop import bisect
from ..linear._ports import LIMITS, ControllerLimits
from ..plants._coupled import AnyAxes, coupled_plant, radius, sensitivity
from ..plants._uncertain import DEFAULT_SAMPLE_TIME_S, discretize_zoh, uncertain_plant
from ._arrays import Tuning, assemble, observer_bandwidth, system, with_filter, with_gains, with_sample_time
from ._controller import MpcController
from ._mpc_state_runtime import MpcArrays
from ._plant import (
    HIDDEN_DELAY_FACTOR,
    TAUTNESS_LEVER,
    ScaledPlant,
    families,
    list_assumptions,
    over,
    predicted_plants,
    predictive_limits,
    sample_pairs,
    scale_numbers,
    scaled_plant,
)
from ._prediction import Problem, matrices
from ._tuning import (
    FULL_TRUST,
    filter_for_rise,
    guard_samples,
    judged_frequencies,
    keeps_bounds,
    move_weight,
    observer_trust,
    require_positive_settings,
    require_solvable,
    rise,
    spaced_starts,
)  # fmt: skip

# All in scaled seconds. Bandwidths that are tried, to 2 %.
_BANDWIDTH_RANGE, _BANDWIDTH_BISECTIONS = (1.0, 40.0), 7
# Behind the dead time, in samples at most so many; moves in it.
_HORIZON_S, _MAX_HORIZON, _MOVE_COUNT = 0.6, 200, 10
_MAX_PREVIEW_S = 4.0
# Time constant of the reference filter: of what recordings told, and of a plant of one's own.
_REFERENCE_TIMES_S = 0.05, 0.2
# Of a robot with uncertainty on its small moves: its slowest pole where tendons are taut.
_TAUT_POLE = 9.0
# Bound on Ms on every sample of a family, where that on the nominal plant is not larger: samples are what a payload or
# an inclination makes of it now and then.
_WORST_SENSITIVITY = 2.5
# On the error of co-contraction against that of the tilt's inputs, squared. Light: where tendons must be taut,
# co-contraction gives way; at 1 the angles gave way by a quarter of a degree.
_COCONTRACTION_WEIGHT = 0.05
# On violations of soft limits against errors of the angles, squared.
_SLACK_WEIGHT = 1e3
# On a lack of tautness where it is a wish: a limit turns the noise of the angles into pulls of one sign, and tilts the
# neck by 0.2 deg (`benchmarks/leave_one_neck_out.py mpc.tautness_weight`).
_WISH_WEIGHT = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MpcSettings(ReprMixin):
    """Model predictive control of all axes over an identified linear model, moves of the motors as unknowns.

    Weights follow from `bandwidth`, the observer from `max_sensitivity`, the reference filter from `rise_s`. Limits of
    the motors are those of the robot's file. Defaults are in ranges and time constants of the robot; what is given is
    in the unit of its motors. A `control` system is predicted with all that each motor does to each output.

    Attributes:
        bandwidth: of the slowest pole of the loop without dead time [rad/s]; None for the fastest that keeps the
            robustness while the observer believes all that is measured.
        max_sensitivity: bound on Ms, on the identified plant and on its faster form; on samples of a family 2.5.
        rise_s: time [s] in which a step rises from 10 to 90 % on the predicted plant, no limit acting: a faster loop is
            filtered, a slower one gets more bandwidth, its observer less trust. None: a filter of a quarter of the
            robot's time constant, 0.05 s of the neck.
        preview: how far ahead the reference is known [s]; the controller then has the inputs
            `pitch_reference_ahead` and `roll_reference_ahead`.
        lead_limit: how far a set-point may be from its motor [rad]; None: a twelfth of the range (1 rad of the neck),
            and no less than what drives that are late by 0.4 time constants fall behind.
        angle_limit: soft limit of outputs that are angles [rad]; None for none.
        minimum_tautness: least motor position beyond that at which a tendon follows the outputs [rad], soft; None for
            no limit. With pretension it is negative: rest counts as 0. "wish": 0.5 rad of a neck, a wish of light
            weight, where tendons stand at known angles and recordings told the plant.
        order: of the loop; "jacobi" adds one sample for the controller and one for the observer.
    """

    bandwidth: float | None = None
    max_sensitivity: float = 1.5
    rise_s: float | None = None
    preview: float = 0.0
    lead_limit: float | None = None
    angle_limit: float | None = None
    minimum_tautness: float | str | None = "wish"
    order: str = "sequential"

    def __post_init__(self) -> None:
        require_positive_settings(self, {"bandwidth": "rad/s", "lead_limit": "", "angle_limit": "rad"})
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        if self.rise_s is not None:
            require_between("rise_s", self.rise_s, 0.001, 1e6, "s")
        if isinstance(self.minimum_tautness, str):
            require_one_of("minimum_tautness", self.minimum_tautness, ("wish",))
        elif self.minimum_tautness is not None:
            require_finite("minimum_tautness", self.minimum_tautness)
        require_one_of("order", self.order, ORDERS)

    @property
    def extra_delay(self) -> int:
        """Samples that the loop's order adds to the plant's delay: of the controller and of the observer."""
        return 0 if self.order == "sequential" else 2

    def over(self, observer: Any) -> MpcNumbers:
        """Return the settings for a loop with this observer: its look-ahead, and tautness for its payload."""
        return over(MpcNumbers.of(self), observer)

    def design(self, model: Any, *, robot: Robot | str | Path | None = None) -> MpcController:
        """Return the controller for `model`, a linear model of any robot with its `tf`, or for a `Family`.

        Args:
            model: what is predicted; a continuous `control` system is held at the robot's sample time, else 20 ms.
            robot: whose limits count, itself, a preset or a file; None: those that the model says.

        Raises:
            SettingsError: a model that is not linear and stable, limits that contradict each other, or a
                robustness that nothing keeps.
        """
        given = None if robot is None else find_robot(robot)
        period, model = discretize_zoh(model, (given and given.sample_time_s) or DEFAULT_SAMPLE_TIME_S)
        whole = coupled_plant(model, robot=given) or uncertain_plant(model, given)
        plant = scaled_plant(whole, identified=hasattr(model, "findings"))
        made = MpcNumbers.of(self).design_candidate(plant, predictive_limits(self, plant))
        return made if period is None else replace(made, design={**made.design, "held_s": period})


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MpcNumbers(MpcSettings):
    """Settings with the numbers that follow from plant and observer; None for defaults.

    Attributes:
        reference_time: time constant of the reference filter [s].
        horizon: N, samples predicted behind the dead time.
        moves: times at which the motors move within the horizon; in between they are held.
        least_delay: the dead time is taken as at least this [s]; a fit of simulations hides it in the pole.
        small_move_pole: the design must hold as well where the main pole is as fast as this [1/s]; 0 for the
            identified plant alone.
        taut_pole: an identified neck is predicted as it moves while its tendons are taut: its slowest pole at least as
            fast as this [1/s], its static gain the largest of its family. 0 for as identified. Slack tendons make fits
            slow and low. A `LinearNeck` of one's own is taken as it is.
        look_ahead: by how much the observer of the loop runs ahead of its sensor [s]: so much dead time is behind it.
        payload_tautness: what a kilogram that the observer tells adds to `minimum_tautness` [rad/kg]; beyond 0 the
            controller has an input `payload` [kg]. A payload slackens tendons.
        wish: the tautness that is wished for, of scaled motors.
    """

    reference_time: float | None = None
    horizon: int | None = None
    moves: int | None = None
    least_delay: float | None = None
    small_move_pole: float | None = None
    taut_pole: float | None = None
    look_ahead: float | None = None
    payload_tautness: float | None = None
    wish: float = 0.5

    @classmethod
    def of(cls, settings: MpcSettings) -> Self:
        """Return the settings with these numbers."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(settings)})

    @property
    def starts(self) -> tuple[int, ...]:
        """Samples of the horizon at which the motors move."""
        return spaced_starts(self.horizon or 1, self.moves or 1)

    def fill_defaults(self, plant: ScaledPlant) -> Self:
        """Return the settings with the numbers that are usual for a plant."""
        second, uncertainty, told = plant.scaling.second, plant.uncertainty, plant.identified
        taut = self.minimum_tautness
        require_between("preview", self.preview, 0.0, _MAX_PREVIEW_S * second, "s")
        if taut == "wish" and not (told and plant.has_tendons):
            taut = None
        horizon = self.horizon or min(max(3, round(_HORIZON_S / plant.axes[0].sample_time)), _MAX_HORIZON)
        usual = {
            "horizon": horizon, "moves": min(_MOVE_COUNT, horizon), "look_ahead": 0.0, "payload_tautness": 0.0,
            "reference_time": second * _REFERENCE_TIMES_S[0 if told else 1],
            "least_delay": (HIDDEN_DELAY_FACTOR if told else 1.0) * uncertainty.least_delay,
            "small_move_pole": uncertainty.small_move_pole,
            "taut_pole": _TAUT_POLE / second if told and uncertainty.small_move_pole > 0.0 else 0.0,
        }  # fmt: skip
        found = {name: value for name, value in usual.items() if getattr(self, name) is None}
        # What a payload wants adds to a tautness that is wished for.
        found |= {"payload_tautness": 0.0} if taut is None else {}
        return replace(self, **found, minimum_tautness=taut)

    def _to_scaled_time(self, second: float) -> Self:
        """Return resolved settings in scaled seconds."""
        times = {"rise_s", "preview", "reference_time", "least_delay", "look_ahead"}
        rates = {"bandwidth", "small_move_pole", "taut_pole"}
        given = {name: getattr(self, name) for name in (*times, *rates) if getattr(self, name) is not None}
        return replace(self, **{name: v / second if name in times else v * second for name, v in given.items()})

    def design_candidate(self, plant: ScaledPlant, limits: ControllerLimits) -> MpcController:
        """Return the controller of a scaled plant."""
        asked, second = self.fill_defaults(plant), plant.scaling.second
        work = asked._to_scaled_time(second)
        nominal, samples = predicted_plants(work, plant), sample_pairs(plant, work)
        bandwidth = work._fastest(plant, limits, nominal, samples) if work.bandwidth is None else work.bandwidth
        if work.rise_s is not None and work.bandwidth is None:
            bandwidth = work._raise_bandwidth(plant, limits, nominal, bandwidth)
        arrays, found = work._tune_observer(work._arrays(plant, limits, bandwidth), nominal, samples)
        found["bandwidth_rad_s"] = bandwidth
        for name, value in found.items():
            if name.endswith(("_rad_s", "_s")):
                found[name] = value / second if name.endswith("_rad_s") else value * second
        taut = asked.minimum_tautness
        if taut is not None:
            unit = plant.scaling.motor_unit
            taut = self.wish * unit if isinstance(taut, str) else taut
        found["dead_time_s"] = [(item.delay + self.extra_delay) * plant.sample_time for item in nominal]
        return MpcController(
            sample_time=plant.sample_time,
            arrays=with_sample_time(arrays, plant.sample_time),
            **{name: getattr(limits, name) for name in LIMITS[:4]},
            robot=limits.robot,
            angle_limit=self.angle_limit,
            minimum_tautness=taut,
            order=self.order,
            design={"settings": asdict(asked), "extra_delay": self.extra_delay, **found,
                    "assumed": list_assumptions(asked, self, plant)},
        )  # fmt: skip

    def _fastest(self, plant: ScaledPlant, limits: ControllerLimits, nominal: AnyAxes, samples: list[AnyAxes]) -> float:
        bounds, w = self._bounds(nominal, samples), judged_frequencies(nominal)

        def keeps(bandwidth: float) -> bool:
            return keeps_bounds(self._arrays(plant, limits, bandwidth), bounds, self.extra_delay, w)

        low, high = _BANDWIDTH_RANGE
        if not keeps(low):
            raise SettingsError(
                f"not even a bandwidth of {low / plant.scaling.second:g} rad/s keeps Ms <= {self.max_sensitivity:g} "
                f"({max(_WORST_SENSITIVITY, self.max_sensitivity):g} on the samples of a family); raise "
                "`max_sensitivity`, or give `bandwidth`, with which less of what is measured is believed."
            )
        return bisect(keeps, low, high, _BANDWIDTH_BISECTIONS, ratio=True)[0]

    def _raise_bandwidth(self, plant: ScaledPlant, limits: ControllerLimits, nominal: AnyAxes, least: float) -> float:
        """Return the smallest bandwidth with which a step reaches the required rise time without a filter.

        Beyond `least` the observer believes less of what is measured, so that the loop stays as robust.
        """

        def rises(bandwidth: float) -> bool:
            unfiltered = with_filter(self._arrays(plant, limits, bandwidth), 0.0)
            return rise(unfiltered, nominal, self.extra_delay) <= self.rise_s  # type: ignore[operator]

        low, high = least, _BANDWIDTH_RANGE[1]
        if rises(low):
            return low
        if not rises(high):
            asked = (self.rise_s or 0.0) * plant.scaling.second
            raise SettingsError(f"`rise_s` {asked:g} is faster than any plan of this plant rises; ask for more.")
        return bisect(lambda bandwidth: not rises(bandwidth), low, high, _BANDWIDTH_BISECTIONS, ratio=True)[1]

    def _arrays(self, plant: ScaledPlant, limits: ControllerLimits, bandwidth: float) -> tuple[Any, ...]:
        problem = self.problem(plant, bandwidth)
        tuning = Tuning(
            trust=FULL_TRUST, reference_time=self.reference_time or 0.0,
            preview=round(self.preview / problem.axes[0].sample_time),
            payload_tautness=(self.payload_tautness or 0.0) / plant.scaling.motor_unit,
            scale=scale_numbers(plant, limits),
        )  # fmt: skip
        return assemble(problem, matrices(problem), tuning)

    def problem(self, plant: ScaledPlant, bandwidth: float) -> Problem:
        """Return the problem for a scaled bandwidth, before observer and filter are tuned.

        Of resolved settings in scaled seconds.
        """
        nominal, (T, inverse), m = predicted_plants(self, plant), plant.redefinition, len(plant.axes)
        require_solvable(len(self.starts), T.shape[1])
        weights: Vector = np.array([1.0 / plant.static_gain**2 for plant in nominal])
        # For symmetric tendons |P|^2 = 2/3 (theta^2 + phi^2) + 3 delta^2: the weight on an input becomes one on motors.
        on_input = max(move_weight(plant, bandwidth) for plant in nominal)
        wish = _WISH_WEIGHT if isinstance(self.minimum_tautness, str) else _SLACK_WEIGHT
        return Problem(
            axes=tuple(replace(plant, delay=plant.delay + self.extra_delay) for plant in nominal),
            horizon=self.horizon or 1,
            starts=self.starts,
            T=T,
            T_inverse=inverse,
            output_weight=weights,
            move_weight=1.5 * on_input,
            cocontraction_weight=_COCONTRACTION_WEIGHT,
            slack_weight=_SLACK_WEIGHT * float(weights.max()),
            tautness_weight=wish * float(weights.max()),
            angles=self.angle_limit is not None,
            tautness=None if self.minimum_tautness is None else TAUTNESS_LEVER * T[:m].T,
            guard=guard_samples(bandwidth, nominal[0].sample_time),
        )

    def _bounds(self, nominal: AnyAxes, samples: list[AnyAxes]) -> list[tuple[AnyAxes, float]]:
        worst = max(_WORST_SENSITIVITY, self.max_sensitivity)
        bounds = [(pair, self.max_sensitivity) for pair in families(nominal, self.small_move_pole or 0.0)]
        return bounds + [(pair, worst) for pair in samples]

    def _tune_observer(
        self, arrays: tuple[Matrix, ...], nominal: AnyAxes, samples: list[AnyAxes]
    ) -> tuple[tuple[Matrix, ...], dict[str, Any]]:
        """Return the arrays with observer and filter, and the findings."""
        moved, w = families(nominal, self.small_move_pole or 0.0), judged_frequencies(nominal)
        arrays = with_gains(arrays, observer_trust(arrays, self._bounds(nominal, samples), self.extra_delay, w))
        time = self.reference_time or 0.0
        if self.rise_s is not None:
            time = filter_for_rise(arrays, nominal, self.extra_delay, self.rise_s)
        arrays = with_filter(arrays, time)
        parts = system(arrays)
        found = {
            "observer_bandwidth_rad_s": observer_bandwidth(MpcArrays(arrays).observer[0], nominal[0].sample_time),
            "reference_time_s": time,
            "sensitivity": [sensitivity(parts, pair, self.extra_delay, w) for pair in moved],
            "worst_sensitivity": max(
                (sensitivity(parts, pair, self.extra_delay, w) for pair in samples), default=None
            ),
            "spectral_radius": max(radius(parts, pair, self.extra_delay) for pair in moved),
            "starts": list(self.starts),
        }  # fmt: skip
        return arrays, found
