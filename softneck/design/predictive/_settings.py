"""Linear model predictive control: what is asked, and the controller that does it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from softneck.core import (
    Matrix,
    SettingsError,
    Vector,
    require_between,
    require_finite,
    require_one_of,
    require_whole,
    to_si,
)
from softneck.core._shown import Shown
from softneck.estimation._axis import HasTransferFunctions, robot_of
from softneck.estimation._settings import ORDERS
from softneck.loop.default_limits import DESIGN_OVERSHOOT_PCT
from softneck.robot._neck_default import NeckCount, NeckDefault
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ..linear._ports import LIMITS, ControllerLimits, require_limits
from ..plants._coupled import CoupledPlant
from ..plants._coupled_axis import radius, sensitivity, times
from ..plants._held import held
from ..plants._uncertain import uncertain_plant
from ._arrays import Tuning, assemble, observer_bandwidth, with_filter, with_gains
from ._controller import MpcController
from ._disturbance import MeasuredDisturbance, effects
from ._lti import system
from ._mpc_state_runtime import MpcArrays
from ._observed import over
from ._predicted import (
    families,
    plant_of,
    predicted_plants,
    sample_pairs,
    settings_for,
    settings_of_robot,
    weighed,
    with_taken,
)  # fmt: skip
from ._prediction import Problem, Scenario, matrices
from ._scale import SizedPlant, limits_of, sized_plant
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
    reference_time,
    require_given,
    require_rise,
    require_solvable,
    rise,
    slowness,
    spaced_starts,
)  # fmt: skip

# Bandwidths that are tried [rad/s].
_BANDWIDTHS = (1.0, 40.0)
# Of another robot, stretched by its slowest pole: without a measurement the motors hold then [s].
_COAST = 0.5
# Weight of the default tautness (`benchmarks/leave_one_neck_out.py mpc.tautness_weight`).
_WISH = 0.3
# Settings that are positive where they are given, and their units.
_POSITIVE = {"bandwidth": "rad/s", "angle_limit": "rad", "disturbance_time": "s", "sample_time": "s",
             "cocontraction_weight": "", "slack_weight": "", "tautness_weight": ""}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class MpcSettings(Shown):
    """Model predictive control of all axes over an identified linear model, moves of the motors as unknowns.

    The defaults are the neck's. Of another robot the horizon and the reference filter are stretched by its slowest
    pole, no dead time and no faster pole is taken for granted, limits are those of its file, and those given are in the
    unit of its motors. Weights count as for a plant of the neck's size.

    Weights follow from `bandwidth`, the observer from `max_sensitivity`, the reference filter from `overshoot_pct`.

    Attributes:
        bandwidth: of the slowest pole of the loop without dead time [rad/s]; None for the fastest that keeps the
            robustness while the observer believes all that is measured.
        max_sensitivity: bound on Ms, on the identified plant and on its faster form.
        worst_sensitivity: bound on Ms on every sample of a family.
        reference_time: time constant of the reference filter [s]; None for the least with which no plant overshoots by
            more than `overshoot_pct`.
        rise_s: time [s] in which a step rises from 10 to 90 % on the predicted plant, no limit acting, in the place of
            `reference_time`: a faster loop is filtered, a slower one gets more bandwidth, its observer less trust.
        overshoot_pct: of a step, without limits, on all plants and gains within `gain_spread`.
        gain_spread: relative spread of the plant's gain that the filter allows for.
        horizon: N, samples predicted behind the dead time.
        moves: times at which the motors move within the horizon; in between they are held.
        preview: how far ahead the reference is known [s]; the controller then has the inputs
            `pitch_reference_ahead` and `roll_reference_ahead`.
        disturbances: measured ones, each an input more.
        position_limit: of each motor [rad].
        slew_limit: of each motor [rad/s].
        lead_limit: how far a set-point may be from its motor [rad].
        least_position: no motor below this [rad]: with a little more than rest no tendon is let loose.
        angle_limit: soft limit of pitch and roll, or of another robot's angles [rad]; None for none.
        minimum_tautness: least motor position beyond that at which a tendon follows the neck [rad], soft; None for no
            limit. With pretension it is negative: rest counts as 0.
        payload_tautness: what a kilogram adds to `minimum_tautness` [rad/kg]; beyond 0 the controller has an input
            `payload` [kg], which an observer over a model of several payloads tells. A payload slackens tendons.
        tautness_lever: motor angle that one radian of neck takes up [rad/rad].
        cocontraction_weight: on the error of co-contraction, against that of the tilt's inputs, squared.
        slack_weight: on violations of soft limits, against errors of the angles, squared.
        tautness_weight: on a lack of tautness [rad of motor], against errors of the angles, squared; None for
            `slack_weight` where `minimum_tautness` is given, a limit, and 0.3 where it is the default, a wish: a limit
            turns the noise of the angles into pulls of one sign, and tilts the neck by 0.2 deg.
        disturbance_time: time constant of the output disturbance's rate [s]; None for the plant's own, as a load at its
            input makes it. A longer one follows what keeps changing, such as a payload carried round, less robustly.
        budget: iterations of the solver for each sample; beyond them the previous plan goes on.
        least_delay: the dead time is taken as at least this [s]; a fit of free runs hides it in the pole.
        small_move_pole: the design must hold as well where the main pole is as fast as this [1/s]; 0 for the
            identified plant alone.
        taut_pole: an identified neck is predicted as it moves while its tendons are taut: its slowest pole at least as
            fast as this [1/s], its static gain the largest of its family. 0 for as identified. Slack tendons make fits
            slow and low. A `LinearNeck` of one's own is taken as it is.
        look_ahead: by how much the observer of the loop runs ahead of its sensor [s]: so much dead time is behind it.
        coupled: whether an identified model (`rls` with structure "mimo") is predicted with all that each motor does
            to each output.
        order: of the loop; "jacobi" adds one sample for the controller and one for the observer.
        observer: whether the loop will have an observer.
        tendon_angles: gamma_1..3 of Eq. 5 and 7 [rad].
        sample_time: [s] at which a continuous `control` system is held (exact); None for 20 ms.
    """

    bandwidth: float | None = None
    max_sensitivity: float = 1.5
    worst_sensitivity: float = 2.5
    reference_time: float | None = NeckDefault(0.05)
    rise_s: float | None = None
    overshoot_pct: float = DESIGN_OVERSHOOT_PCT
    gain_spread: float = 0.2
    horizon: int = NeckCount(30)
    moves: int = NeckCount(10)
    preview: float = 0.0
    disturbances: tuple[MeasuredDisturbance, ...] = ()
    position_limit: float = NeckDefault(6.0)
    slew_limit: float = NeckDefault(12.5)
    # More than the drives of the neck fall behind at the paper's fastest signals, 0.4 rad.
    lead_limit: float = NeckDefault(1.0)
    least_position: float = NeckDefault(-6.0)
    angle_limit: float | None = None
    minimum_tautness: float | None = NeckDefault(0.5)
    payload_tautness: float = NeckDefault(0.0)
    # Radius of the tendons' attachment over that of the winch: 52 mm / 7.5 mm (lab code; paper, section 3.1).
    tautness_lever: float = NeckDefault(6.93)
    # Light: where tendons must be taut, co-contraction gives way; at 1 the angles gave way by a quarter of a degree.
    cocontraction_weight: float = 0.05
    slack_weight: float = 1e3
    tautness_weight: float | None = None
    disturbance_time: float | None = None
    budget: int = 100
    # The paper's own dead time and pole (Eq. 31: 0.08 s, 5.293 1/s).
    least_delay: float = NeckDefault(0.1)
    small_move_pole: float = NeckDefault(5.293)
    taut_pole: float = NeckDefault(9.0)
    look_ahead: float = NeckDefault(0.0)
    coupled: bool = False
    order: str = "sequential"
    observer: bool = True
    tendon_angles: tuple[float, float, float] = tuple(TENDON_ANGLES.tolist())
    sample_time: float | None = None

    def __post_init__(self) -> None:
        require_given(self, _POSITIVE)
        require_between("max_sensitivity", self.max_sensitivity, 1.05, 4.0)
        require_between("worst_sensitivity", self.worst_sensitivity, self.max_sensitivity, 10.0)
        if self.reference_time is not None:
            require_between("reference_time", self.reference_time, 0.0, 1e6, "s")
        require_rise(self.rise_s, self.reference_time)
        require_between("overshoot_pct", self.overshoot_pct, 0.1, 100.0, "%")
        require_between("gain_spread", self.gain_spread, 0.0, 0.9)
        require_whole("horizon", self.horizon, 1, 200)
        require_whole("moves", self.moves, 1, self.horizon)
        require_between("preview", self.preview, 0.0, 4.0, "s")
        require_limits({name: getattr(self, name) for name in LIMITS[:4]})
        require_between("tautness_lever", self.tautness_lever, 0.0, 100.0, "rad/rad")
        require_between("payload_tautness", self.payload_tautness, 0.0, 12.0, "rad/kg")
        if self.minimum_tautness is not None:
            require_finite("minimum_tautness", self.minimum_tautness)
        require_whole("budget", self.budget, 1, 10_000)
        require_between("least_delay", self.least_delay, 0.0, 1.0, "s")
        require_between("look_ahead", self.look_ahead, 0.0, 1.0, "s")
        for name in ("small_move_pole", "taut_pole"):
            require_between(name, getattr(self, name), 0.0, 1000.0, "1/s")
        require_one_of("order", self.order, ORDERS)

    @property
    def extra_delay(self) -> int:
        """Samples that the loop's order adds to the plant's delay."""
        return 0 if self.order == "sequential" else 1 + int(self.observer)

    @property
    def starts(self) -> tuple[int, ...]:
        """Samples of the horizon at which the motors move."""
        return spaced_starts(self.horizon, self.moves)

    def over(self, observer: Any) -> MpcSettings:
        """Return the settings for a loop with this observer, which says `look_ahead` and `payload_tautness`."""
        return over(self, observer)

    def design(self, model: Any) -> MpcController:
        """Return the controller for `model`, a linear model of any robot with its `tf`, or for a `Family`.
        A `control` system is taken as well, with all that each of its inputs does to each of its outputs.

        Raises:
            SettingsError: a model that is not linear and stable, limits that contradict each other, or a
                robustness that nothing keeps.
        """
        settings, model = held(self, model)
        plant = plant_of(model, coupled=self.coupled)
        robot, settings = robot_of(plant), settings_for(settings, plant)
        limits = limits_of(settings, robot)
        if robot.is_neck and not isinstance(plant, CoupledPlant):
            return with_taken(settings._designed(plant, limits), settings, plant)
        whole = plant if isinstance(plant, CoupledPlant) else uncertain_plant(plant)
        settings = settings if robot.is_neck else settings_of_robot(settings, whole)
        return settings._designed(sized_plant(whole, limits, weighed(whole)), limits)

    def _designed(self, model: HasTransferFunctions, limits: ControllerLimits) -> MpcController:
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
            disturbances=self.disturbances,
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
                f"({self.worst_sensitivity:g} on the samples of a family); raise them, or give "
                "`bandwidth`, with which less of what is measured is believed."
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
        problem = self._problem(model, bandwidth)
        Ts = problem.scenarios[0].axes[0].sample_time
        tuning = Tuning(
            trust=FULL_TRUST, reference_time=self.reference_time or 0.0, preview=round(self.preview / Ts),
            budget=self.budget, disturbances=effects(self.disturbances, robot_of(model)),
        )  # fmt: skip
        if isinstance(model, SizedPlant) and model.scale is not None:
            coast = max(1, round(_COAST * slowness(problem.scenarios[0].axes) / Ts))
            measured = tuning.disturbances / np.append(model.scale.outputs, [1.0, 1.0])
            tuning = replace(tuning, scale=model.scale, coast=coast, disturbances=measured)
        return assemble(problem, matrices(problem), tuning)

    def problem(self, model: HasTransferFunctions, bandwidth: float) -> Problem:
        """Return what is asked with that bandwidth [rad/s], in numbers, before observer and filter are tuned."""
        return settings_for(self, model)._problem(model, bandwidth)

    def _problem(self, model: HasTransferFunctions, bandwidth: float) -> Problem:
        nominal = predicted_plants(self, model)
        if isinstance(model, SizedPlant):
            T, inverse = model.redefinition
        else:
            T = redefinition_matrix(np.array(self.tendon_angles))
            inverse = np.linalg.inv(T)
        require_solvable(self.moves, T.shape[1])
        weights: Vector = np.array([1.0 / plant.static_gain**2 for plant in nominal])
        # For symmetric tendons |P|^2 = 2/3 (theta^2 + phi^2) + 3 delta^2: the weight on an input becomes one on motors.
        on_input = max(move_weight(plant, bandwidth) for plant in nominal)
        return Problem(
            scenarios=(Scenario(self._delayed(nominal), 1.0),),
            horizon=self.horizon,
            starts=self.starts,
            T=T,
            T_inverse=inverse,
            output_weight=weights,
            move_weight=1.5 * on_input,
            cocontraction_weight=self.cocontraction_weight,
            slack_weight=self.slack_weight * float(weights.max()),
            tautness_weight=self._tautness_weight * float(weights.max()),
            angles=self.angle_limit is not None,
            tautness=None if self.minimum_tautness is None else self._lever(model),
            disturbance_time=self.disturbance_time,
            guard=guard_samples(bandwidth, nominal[0].sample_time),
        )

    @property
    def _tautness_weight(self) -> float:
        if self.tautness_weight is not None:
            return self.tautness_weight
        return _WISH if isinstance(self.minimum_tautness, NeckDefault) else self.slack_weight

    def _lever(self, model: HasTransferFunctions) -> Matrix:
        """Return (motors, outputs) how much an angle loosens each tendon."""
        if isinstance(model, SizedPlant):
            return model.lever(self.tautness_lever)
        return self.tautness_lever * redefinition_matrix(np.array(self.tendon_angles))[:2].T

    def _bounds(self, nominal: Pair, samples: list[Pair]) -> list[tuple[Pair, float]]:
        bounds = [(pair, self.max_sensitivity) for pair in families(nominal, self.small_move_pole)]
        return bounds + [(pair, self.worst_sensitivity) for pair in samples]

    def _delayed(self, pair: Pair, late: int = 0) -> Pair:
        return tuple(replace(plant, delay=plant.delay + self.extra_delay + late) for plant in pair)

    def _tuned(
        self, arrays: tuple[Any, ...], nominal: Pair, samples: list[Pair]
    ) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """Return the arrays with observer and filter, and what was found."""
        moved, w = families(nominal, self.small_move_pole), judged_frequencies(nominal)
        bounds = self._bounds(nominal, samples)
        arrays = with_gains(arrays, observer_trust(arrays, bounds, self.extra_delay, w))
        time = self.reference_time
        if self.rise_s is not None:
            time = filter_for_rise(arrays, nominal, self.extra_delay, self.rise_s)
        elif time is None:
            spread = [times(pair, 1.0 + s) for pair in moved for s in (-self.gain_spread, 0.0, self.gain_spread)]
            time = reference_time(
                arrays, [*spread, *samples], self.extra_delay, overshoot=self.overshoot_pct / 100.0
            )  # fmt: skip
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
