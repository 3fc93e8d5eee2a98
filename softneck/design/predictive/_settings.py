"""Linear model predictive control: what is asked, and the controller that does it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, require_finite, require_one_of, to_si
from softneck.core._shown import Shown
from softneck.estimation._axis import HasTransferFunctions, robot_of
from softneck.estimation._settings import ORDERS
from softneck.robot import Robot
from softneck.robot._neck_default import NeckCount, NeckDefault
from softneck.robot._search import find_robot
from softneck.signals import redefinition_matrix

from ..linear._ports import LIMITS, ControllerLimits
from ..plants._coupled import CoupledPlant
from ..plants._coupled_axis import radius, sensitivity
from ..plants._uncertain import USUAL_PERIOD, discrete, uncertain_plant
from ._arrays import Tuning, assemble, observer_bandwidth, with_filter, with_gains
from ._controller import MpcController
from ._lti import system
from ._mpc_state_runtime import MpcArrays
from ._predicted import (
    families,
    over,
    plant_of,
    predicted_plants,
    sample_pairs,
    settings_for,
    settings_of_robot,
    weighed,
    with_taken,
)  # fmt: skip
from ._prediction import Problem, matrices
from ._scale import TAUTNESS_LEVER, SizedPlant, predictive_limits, sized_plant
from ._tuning import (
    FULL_TRUST,
    Pair,
    filter_for_rise,
    guard_samples,
    halved,
    judged_frequencies,
    keeps_bounds,
    move_weight,
    observer_trust,
    require_given,
    require_solvable,
    rise,
    slowness,
    spaced_starts,
)  # fmt: skip

# Bandwidths that are tried [rad/s].
_BANDWIDTHS = (1.0, 40.0)
# Of another robot, stretched by its slowest pole: without a measurement the motors hold then [s].
_COAST = 0.5
# Bound on Ms on every sample of a family, where that on the nominal plant is not larger: samples are what a payload or
# an inclination makes of it now and then.
_WORST_SENSITIVITY = 2.5
# On the error of co-contraction against that of the tilt's inputs, squared. Light: where tendons must be taut,
# co-contraction gives way; at 1 the angles gave way by a quarter of a degree.
_COCONTRACTION = 0.05
# On violations of soft limits against errors of the angles, squared.
_SLACK = 1e3
# On a lack of tautness where it is a wish: a limit turns the noise of the angles into pulls of one sign, and tilts the
# neck by 0.2 deg (`benchmarks/leave_one_neck_out.py mpc.tautness_weight`).
_WISH = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MpcSettings(Shown):
    """Model predictive control of all axes over an identified linear model, moves of the motors as unknowns.

    Weights follow from `bandwidth`, the observer from `max_sensitivity`, the reference filter from `rise_s`. Limits of
    the motors are those of the robot's file. The defaults are the neck's; what is given is in the unit of the robot's
    motors. A `control` system is predicted with all that each motor does to each output.

    Attributes:
        bandwidth: of the slowest pole of the loop without dead time [rad/s]; None for the fastest that keeps the
            robustness while the observer believes all that is measured.
        max_sensitivity: bound on Ms, on the identified plant and on its faster form; on samples of a family 2.5.
        rise_s: time [s] in which a step rises from 10 to 90 % on the predicted plant, no limit acting: a faster loop is
            filtered, a slower one gets more bandwidth, its observer less trust. None: a filter of 0.05 s.
        preview: how far ahead the reference is known [s]; the controller then has the inputs
            `pitch_reference_ahead` and `roll_reference_ahead`.
        lead_limit: how far a set-point may be from its motor [rad].
        angle_limit: soft limit of pitch and roll, or of another robot's angles [rad]; None for none.
        minimum_tautness: least motor position beyond that at which a tendon follows the neck [rad], soft; None for no
            limit. With pretension it is negative: rest counts as 0. The default is a wish of light weight.
        order: of the loop; "jacobi" adds one sample for the controller and one for the observer.
    """

    bandwidth: float | None = None
    max_sensitivity: float = 1.5
    rise_s: float | None = None
    preview: float = 0.0
    # More than the drives of the neck fall behind at the paper's fastest signals, 0.4 rad.
    lead_limit: float = NeckDefault(1.0)
    angle_limit: float | None = None
    minimum_tautness: float | None = NeckDefault(0.5)
    order: str = "sequential"

    def __post_init__(self) -> None:
        require_given(self, {"bandwidth": "rad/s", "lead_limit": "", "angle_limit": "rad"})
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        if self.rise_s is not None:
            require_between("rise_s", self.rise_s, 0.001, 1e6, "s")
        require_between("preview", self.preview, 0.0, 4.0, "s")
        if self.minimum_tautness is not None:
            require_finite("minimum_tautness", self.minimum_tautness)
        require_one_of("order", self.order, ORDERS)

    @property
    def extra_delay(self) -> int:
        """Samples that the loop's order adds to the plant's delay: of the controller and of the observer."""
        return 0 if self.order == "sequential" else 2

    def over(self, observer: Any) -> MpcNumbers:
        """Return the settings for a loop with this observer: its look-ahead, what tautness its payload wants."""
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
        period, model = discrete(model, (given and given.sample_time_s) or USUAL_PERIOD)
        plant = plant_of(model, given)
        whose, settings = given or robot_of(plant), settings_for(MpcNumbers.of(self), plant)
        limits = predictive_limits(settings, whose)
        if whose.is_neck and not isinstance(plant, CoupledPlant):
            made = with_taken(settings.designed(plant, limits), settings, plant)
        else:
            whole = plant if isinstance(plant, CoupledPlant) else uncertain_plant(plant, given)
            settings = settings if whose.is_neck else settings_of_robot(settings, whole)
            made = settings.designed(sized_plant(whole, limits, weighed(whole)), limits)
        return made if period is None else replace(made, design={**made.design, "held_s": period})


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MpcNumbers(MpcSettings):
    """Settings, and the numbers that follow from plant and observer.

    Attributes:
        reference_time: time constant of the reference filter [s].
        horizon: N, samples predicted behind the dead time.
        moves: times at which the motors move within the horizon; in between they are held.
        least_delay: the dead time is taken as at least this [s]; a fit of free runs hides it in the pole.
        small_move_pole: the design must hold as well where the main pole is as fast as this [1/s]; 0 for the
            identified plant alone.
        taut_pole: an identified neck is predicted as it moves while its tendons are taut: its slowest pole at least as
            fast as this [1/s], its static gain the largest of its family. 0 for as identified. Slack tendons make fits
            slow and low. A `LinearNeck` of one's own is taken as it is.
        look_ahead: by how much the observer of the loop runs ahead of its sensor [s]: so much dead time is behind it.
        payload_tautness: what a kilogram that the observer tells adds to `minimum_tautness` [rad/kg]; beyond 0 the
            controller has an input `payload` [kg]. A payload slackens tendons.
    """

    reference_time: float = NeckDefault(0.05)
    horizon: int = NeckCount(30)
    moves: int = NeckCount(10)
    # The paper's own dead time and pole (Eq. 31: 0.08 s, 5.293 1/s).
    least_delay: float = NeckDefault(0.1)
    small_move_pole: float = NeckDefault(5.293)
    taut_pole: float = NeckDefault(9.0)
    look_ahead: float = NeckDefault(0.0)
    payload_tautness: float = NeckDefault(0.0)

    @classmethod
    def of(cls, settings: MpcSettings) -> Self:
        """Return the settings with these numbers."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(settings)})

    @property
    def starts(self) -> tuple[int, ...]:
        """Samples of the horizon at which the motors move."""
        return spaced_starts(self.horizon, self.moves)

    def designed(self, model: HasTransferFunctions, limits: ControllerLimits) -> MpcController:
        """Return the controller for what is predicted."""
        nominal = predicted_plants(self, model)
        samples = sample_pairs(model, self)
        bandwidth = self._fastest(model, nominal, samples) if self.bandwidth is None else self.bandwidth
        if self.rise_s is not None and self.bandwidth is None:
            bandwidth = self._risen(model, nominal, bandwidth)
        arrays, found = self._tuned(self._arrays(model, bandwidth), nominal, samples)
        found["bandwidth_rad_s"] = bandwidth
        unit, taut = to_si(limits.robot.motors.unit)[0], self.minimum_tautness
        return MpcController(
            sample_time=nominal[0].sample_time,
            arrays=arrays,
            **{name: getattr(limits, name) for name in LIMITS[:4]},
            robot=limits.robot,
            angle_limit=self.angle_limit,
            minimum_tautness=None if taut is None else unit * taut,
            order=self.order,
            design={"settings": asdict(self), "extra_delay": self.extra_delay, **found},
        )

    def _fastest(self, model: HasTransferFunctions, nominal: Pair, samples: list[Pair]) -> float:
        bounds, w = self._bounds(nominal, samples), judged_frequencies(nominal)

        def keeps(bandwidth: float) -> bool:
            return keeps_bounds(self._arrays(model, bandwidth), bounds, self.extra_delay, w)

        low, high = (speed / slowness(nominal) for speed in _BANDWIDTHS)
        if not keeps(low):
            raise SettingsError(
                f"not even a bandwidth of {low:g} rad/s keeps Ms <= {self.max_sensitivity:g} "
                f"({max(_WORST_SENSITIVITY, self.max_sensitivity):g} on the samples of a family); raise "
                "`max_sensitivity`, or give `bandwidth`, with which less of what is measured is believed."
            )
        return halved(keeps, low, high)[0]

    def _risen(self, model: HasTransferFunctions, nominal: Pair, least: float) -> float:
        """Return the least bandwidth from `least` on with which a step rises as fast as asked without a filter.

        Beyond `least` the observer believes less of what is measured, so that the loop stays as robust.
        """

        def rises(bandwidth: float) -> bool:
            unfiltered = with_filter(self._arrays(model, bandwidth), 0.0)
            return rise(unfiltered, nominal, self.extra_delay) <= self.rise_s  # type: ignore[operator]

        low, high = least, _BANDWIDTHS[1] / slowness(nominal)
        if rises(low):
            return low
        if not rises(high):
            raise SettingsError(f"`rise_s` {self.rise_s:g} is faster than any plan of this plant rises; ask for more.")
        return halved(lambda bandwidth: not rises(bandwidth), low, high)[1]

    def _arrays(self, model: HasTransferFunctions, bandwidth: float) -> tuple[Any, ...]:
        problem = self.problem(model, bandwidth)
        Ts = problem.axes[0].sample_time
        tuning = Tuning(
            trust=FULL_TRUST, reference_time=self.reference_time, preview=round(self.preview / Ts),
            payload_tautness=self.payload_tautness,
        )  # fmt: skip
        if isinstance(model, SizedPlant) and model.scale is not None:
            tuning = replace(tuning, scale=model.scale, coast=max(1, round(_COAST * slowness(problem.axes) / Ts)))
        return assemble(problem, matrices(problem), tuning)

    def problem(self, model: HasTransferFunctions, bandwidth: float) -> Problem:
        """Return what is asked with that bandwidth [rad/s], in numbers, before observer and filter are tuned."""
        nominal = predicted_plants(self, model)
        lever = redefinition_matrix()
        T, inverse = model.redefinition if isinstance(model, SizedPlant) else (lever, np.linalg.inv(lever))
        require_solvable(self.moves, T.shape[1])
        weights: Vector = np.array([1.0 / plant.static_gain**2 for plant in nominal])
        # For symmetric tendons |P|^2 = 2/3 (theta^2 + phi^2) + 3 delta^2: the weight on an input becomes one on motors.
        on_input = max(move_weight(plant, bandwidth) for plant in nominal)
        wish = _WISH if isinstance(self.minimum_tautness, NeckDefault) else _SLACK
        return Problem(
            axes=tuple(replace(plant, delay=plant.delay + self.extra_delay) for plant in nominal),
            horizon=self.horizon,
            starts=self.starts,
            T=T,
            T_inverse=inverse,
            output_weight=weights,
            move_weight=1.5 * on_input,
            cocontraction_weight=_COCONTRACTION,
            slack_weight=_SLACK * float(weights.max()),
            tautness_weight=wish * float(weights.max()),
            angles=self.angle_limit is not None,
            tautness=None if self.minimum_tautness is None else TAUTNESS_LEVER * lever[:2].T,
            guard=guard_samples(bandwidth, nominal[0].sample_time),
        )

    def _bounds(self, nominal: Pair, samples: list[Pair]) -> list[tuple[Pair, float]]:
        worst = max(_WORST_SENSITIVITY, self.max_sensitivity)
        bounds = [(pair, self.max_sensitivity) for pair in families(nominal, self.small_move_pole)]
        return bounds + [(pair, worst) for pair in samples]

    def _tuned(
        self, arrays: tuple[Matrix, ...], nominal: Pair, samples: list[Pair]
    ) -> tuple[tuple[Matrix, ...], dict[str, Any]]:
        """Return the arrays with observer and filter, and what was found."""
        moved, w = families(nominal, self.small_move_pole), judged_frequencies(nominal)
        arrays = with_gains(arrays, observer_trust(arrays, self._bounds(nominal, samples), self.extra_delay, w))
        time = self.reference_time
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
            "dead_time_s": [(plant.delay + self.extra_delay) * plant.sample_time for plant in nominal],
            "starts": list(self.starts),
        }  # fmt: skip
        return arrays, found
