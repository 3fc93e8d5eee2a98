"""Nonlinear set membership identification (section 3): the data set is the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import (
    KINDS,
    DataError,
    Matrix,
    Progress,
    SettingsError,
    Vector,
    find_kind,
    require_one_of,
    require_positive,
    resolve,
    silent,
)
from softneck.core._blas_threads import one_blas_thread
from softneck.robot import Robot
from softneck.signals import Recording

from ..models._directions import directions_of, regressor_units
from ..models._drive import DriveModel, fit_drive
from ..models._fitting import fitted_model, in_display_unit, training_recording
from ..models._model import WARM_UP, Model
from ..models._regressors import lag_table
from ._cones import usual_width
from ._forest import all_cores, plant
from ._gamma import require_feasible
from ._regressor import Ground, gammas, residual_lags, scaled, widened, widening
from ._scaling import RULES, HoldOut, ScaleTrial, grouped_scale, ruled_scale

_FINDING = "usual_half_width"
# As `Cones.usual`.
_QUANTILE = 0.99


def usual_widths(data: Sequence[tuple[Matrix, Vector]], gamma: Vector, epsilon: Vector) -> Vector:
    """Return each axis' half-width [rad] that 99 % of the training rows stay below, see `Cones.usual`.

    Args:
        data: scaled regressors (n, N) and targets (N,) of each axis, in order of time.
        gamma: (outputs,).
        epsilon: (outputs,) [rad].
    """
    widths = []
    for axis, (points, values) in enumerate(data):
        tree = plant(np.array(points, order="C"), values[None].copy(), np.arange(values.size, dtype=np.float64))
        # Half a second on either side is the same motion; less where there is hardly more than that.
        usual = (min(WARM_UP, values.size // 8), _QUANTILE)
        widths.append(epsilon[axis] + usual_width(tree, 0, gamma[axis : axis + 1], usual, all_cores()))
    return np.array(widths)


def knows_what_it_saw(model: Model) -> bool:
    """Return whether `outside_seen` can judge by this model."""
    return usual_finding(model.robot) in model.findings


def usual_finding(robot: Robot) -> str:
    """Return the name of the finding that holds `usual_widths`, with its unit."""
    return f"{_FINDING}_{robot.outputs.display_unit}"


def outside_seen(model: Model, outputs: Matrix) -> np.ndarray:
    """Return (rows, outputs) whether the bounds of each output are wider than the training data's usually are.

    Args:
        model: of kind `nlsm`.
        outputs: (rows, 10 of a neck) what `model.simulate` or `model.predict` returned.

    Raises:
        SettingsError: a model without bounds, or one identified before this was learned.
    """
    if not knows_what_it_saw(model):
        raise SettingsError("only a model of kind nlsm knows what it has seen; identify one (again).")
    first, axes = len(model.robot.outputs.names) + len(model.robot.motors.names), len(model.robot.outputs.names)
    columns = first + 2 * axes + 1  # `validity` is the last
    if outputs.ndim != 2 or outputs.shape[1] != columns:
        raise DataError(f"`outputs` must be (rows, {columns}), as a model of kind nlsm returns; got {outputs.shape}.")
    half = 0.5 * (outputs[:, first + 1 : columns : 2] - outputs[:, first : columns - 1 : 2])
    return in_display_unit(model.robot, half) > np.array(model.findings[usual_finding(model.robot)])


FORMS = ("paper_eq21", "lags", "residual")
# Kinds whose arrays hold `a`, `b`, `delay` over the redefined set-points, as the runtime runs them.
_BASES = tuple(name for name in ("rls", "oe") if name in KINDS)
# Eq. 21: y(k-1); u_i(k-2), u_i(k-3); M_i(k-3) at the neck's 20 ms; of another robot u and M so far apart by its time.
_EQ21_APART = 0.02
# A lag is a sample; a minute at 1 ms is the longest history a file may hold.
_LONGEST_LAG = 60_000
# Free run of form `residual` hardly depends on it, the width of its bounds does: below what the base and the last
# 0.8 s leave unexplained, gamma and the width grow a hundredfold.
_RESIDUAL_SIGMAS = (4.0, 8.0, 16.0, 32.0)
# The knee of gamma*(epsilon) lies at 3 to 5 sigma of the noise; in free run more is better, as the model's own
# errors stand in the regressor too. The hold-out decides.
_EPSILON_SIGMAS = (3.0, 5.0, 8.0, 12.0)
# Weight of the output in the regressor, set-points having 1: half a decade apart up to the paper's own, 57.3, which
# logs angles in degrees beside motors in radians. A high weight trusts the fed-back output and drifts in free run.
_OUTPUT_WEIGHTS = (3.0, 10.0, 30.0, 57.29577951308232)
# Weights of measured motors beside set-points, tried with the best weight of the output. A position is what bends
# the neck, a set-point what will: 10 gains 10 points in free run on sine and rotation (virtual neck, `paper`), 0.3
# lost as many.
_MOTOR_WEIGHTS = (3.0, 10.0)
# Of the base's angles: a radian of motor tilts the neck by about 0.2 rad, so that 5 makes the two equal in the norm.
_ANGLE_WEIGHTS = (1.0, 2.0, 5.0, 10.0)
# The end of the training rows on which epsilon and the scale are chosen, in free run.
_HOLD_OUT = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class SetMembership:
    """The estimator of Eq. 12-20 and Algorithm 1, one set for each axis, over the regressor of Eq. 21 or another.

    Attributes:
        form: "paper_eq21"; "lags", the same estimator over other lags; or "residual": set membership over simulated
            signals on what the free run of a linear base leaves over, where nothing is fed back and so nothing drifts.
        output_lags, setpoint_lags, motor_lags: lags [samples] in the regressor, of the output (both outputs of the
            base in form "residual"), of all set-points and of all motor positions; None takes the form's own. Not
            for "paper_eq21", whose lags are Eq. 21's; those of u and M go by another robot's time constant.
        scale: weights of the regressor's components in the norm of Eq. 16: "auto" chooses one for outputs and one
            for motors by free run on the last fifth of the training rows; "none" takes SI units as they are; "std"
            divides each by its standard deviation (a trap, see docs); or a vector as long as the regressor. Weights
            of another robot are for components that move as much as a neck's.
        output_weight: weight of the outputs, all others having 1: the scale without a choice.
        epsilon: noise bound of Eq. 15 [rad, or the SI unit of the outputs]; None chooses it by the same free run
            (form "residual": so that the bounds are narrowest among equal fits).
        base: linear kind of one pole that form "residual" stands on.
    """

    form: str = "paper_eq21"
    output_lags: tuple[int, ...] | None = None
    setpoint_lags: tuple[int, ...] | None = None
    motor_lags: tuple[int, ...] | None = None
    scale: str | tuple[float, ...] = "auto"
    output_weight: float | None = None
    epsilon: float | None = None
    base: str = "oe"

    def __post_init__(self) -> None:
        require_one_of("form", self.form, FORMS)
        for name in ("output_lags", "setpoint_lags", "motor_lags"):
            object.__setattr__(self, name, self._checked_lags(name))
        if isinstance(self.scale, str):
            require_one_of("scale", self.scale, RULES)
        else:
            object.__setattr__(self, "scale", _checked_scale(self.scale))
        if self.epsilon is not None:
            require_positive("epsilon", self.epsilon, "rad")
        if self.output_weight is not None:
            require_positive("output_weight", self.output_weight)
            if self.scale != "auto":
                raise SettingsError("`output_weight` is a scale of its own; leave `scale` at auto beside it.")
        require_one_of("base", self.base, _BASES)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Store the data set and find gamma and epsilon that are consistent with all of it.

        gamma is the paper's: the least for which f_u(i) >= y(i) and f_l(i) <= y(i) at every point.

        Raises:
            DataError: too short, constant, or `epsilon` so small that no function fits the data.
            SettingsError: a `scale` of another length than the regressor.
        """
        recording = training_recording(recordings, any_robot=True)
        robot = recording.robot
        noise = noise_levels(recording)
        drive = fit_drive(recording)
        directions = directions_of(recording, [run.set_points for run in recording.runs()])
        # In the time of a neck: lags go by the robot's time constant.
        necks = recording.sample_time / directions.stretch
        ground = self._ground(recording, drive, necks)
        data = ground.data(recording)
        chosen, tried = self._choose(ground, recording, noise, necks, progress)
        scale = chosen.scale if chosen.scale.size else ruled_scale(self.scale, ground.table, data)
        sets = [(scaled(X, scale), y) for X, y in data]
        # An epsilon that was asked for is kept or refused.
        if self.epsilon is None:
            epsilon, gamma = widened(data, scale, chosen.epsilon)
        else:
            epsilon, gamma = chosen.epsilon, gammas(data, scale, [chosen.epsilon])[0]
        require_feasible(recording, ground.table, sets, gamma, epsilon)
        arrays = ground.arrays(data, scale, gamma, epsilon)
        progress(1.0, "done")
        unit = robot.outputs.display_unit
        findings = {"form": self.form, f"noise_{unit}": in_display_unit(robot, noise).tolist()}
        findings |= _findings(replace(chosen, epsilon=epsilon), tried, scale, robot)
        if self.epsilon is None:
            sigmas = _RESIDUAL_SIGMAS if self.form == "residual" else _EPSILON_SIGMAS
            findings |= widening(np.minimum(sigmas[-1] * noise, epsilon), epsilon, robot)
        findings |= {"gamma": gamma.tolist(), "points": int(arrays["values"].shape[1])}
        findings[usual_finding(robot)] = in_display_unit(robot, usual_widths(sets, gamma, epsilon)).tolist()
        if not robot.is_neck:
            findings |= directions.findings()
        return fitted_model("nlsm", self, recording, arrays=arrays, findings=findings)

    def _ground(self, recording: Recording, drive: DriveModel, necks: float) -> Ground:
        """Return the set's ground; the base of form `residual` is identified on `recording`.

        Args:
            recording: to identify from.
            drive: of its motors.
            necks: sample time by the robot's time constant over the neck's [s].
        """
        residual = self.form == "residual"
        if residual:
            own = residual_lags(necks, recording)
            preset = (own, (), own)
        else:
            apart = 1 if recording.robot.is_neck else max(round(_EQ21_APART / necks), 1)
            preset = ((1,), (1 + apart, 1 + 2 * apart), (1 + 2 * apart,))
        given = (self.output_lags, self.setpoint_lags, self.motor_lags)
        lags = [known if lag is None else lag for lag, known in zip(given, preset, strict=True)]
        sizes = len(drive.pole), recording.outputs.shape[1]
        table = lag_table(*lags, both_outputs=residual, sizes=sizes)
        return Ground(
            table=table,
            drive=drive,
            base=resolve(find_kind(self.base, "model").settings)().fit(recording) if residual else None,
            # What the set sees when it is used: the drive model's positions in simulation, which `residual` always is.
            measured=not residual,
            units=regressor_units(recording, table),
        )

    def _choose(
        self, ground: Ground, recording: Recording, noise: Vector, necks: float, progress: Progress
    ) -> tuple[ScaleTrial, list[ScaleTrial]]:
        """Return scale and epsilon, and all that were tried; an empty scale is left to `ruled_scale`."""
        table = ground.table
        if self.epsilon is not None:
            epsilons = [np.full(noise.size, self.epsilon)]
        elif self.form == "residual":
            epsilons = [sigmas * noise for sigmas in _RESIDUAL_SIGMAS]
        else:
            epsilons = [sigmas * noise for sigmas in _EPSILON_SIGMAS]
        weighted = self.output_weight is not None
        if len(epsilons) == 1 and (weighted or self.scale != "auto"):
            scale = np.zeros(0)
            if self.output_weight is not None:
                scale = grouped_scale(table, self.output_weight) * ground.units
            return ScaleTrial(self.output_weight, None, scale, epsilons[0], np.nan, np.nan, np.nan, np.nan), []
        head, tail = recording.split(1.0 - _HOLD_OUT)
        if len(tail) <= 2 * WARM_UP:
            raise DataError(
                "the record is too short to choose epsilon and the scale; record longer, or set epsilon and "
                "output_weight."
            )
        # The drives are known from all rows: they are no part of what is chosen.
        first = self._ground(head, ground.drive, necks)
        hold_out = HoldOut(first, first.data(head), tail, epsilons, narrow=self.form == "residual")
        if self.scale != "auto":
            tried = hold_out.fixed(ruled_scale(self.scale, table, hold_out.data))
            return replace(tried[0], scale=np.zeros(0)), tried
        outputs, motors = self._weights(table)
        tried = hold_out.choose(outputs, motors, progress)
        return tried[0], tried

    def _weights(self, table: np.ndarray) -> tuple[Sequence[float], Sequence[float]]:
        """Return the weights to try of outputs and of motors beside 1; what the regressor lacks has none."""
        sources = set(table[:, 0].astype(int).tolist())
        if self.output_weight is not None:
            return (self.output_weight,), ()
        if self.form == "residual":
            return (_ANGLE_WEIGHTS if 3 in sources else (1.0,)), ()
        # Without set-points, a weight of motors is that of outputs upside down.
        motors = _MOTOR_WEIGHTS if {1, 2} <= sources else ()
        return (_OUTPUT_WEIGHTS if 0 in sources else (1.0,)), motors

    def _checked_lags(self, name: str) -> tuple[int, ...] | None:
        lags: Any = getattr(self, name)
        if lags is None:
            return None
        if self.form == "paper_eq21":
            raise SettingsError(f"form `paper_eq21` has the lags of Eq. 21; take form `lags` to set `{name}`.")
        lags = (lags,) if isinstance(lags, int) else tuple(lags)
        whole = all(isinstance(lag, int) and not isinstance(lag, bool) and 1 <= lag <= _LONGEST_LAG for lag in lags)
        if not whole or len(set(lags)) != len(lags):
            raise SettingsError(f"`{name}` must be different whole numbers of samples from 1 on; got {list(lags)}.")
        return tuple(sorted(lags))


def _checked_scale(scale: Any) -> tuple[float, ...]:
    try:
        values = np.asarray(scale, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.ndim != 1 or not values.size or not (np.isfinite(values) & (values > 0.0)).all():
        raise SettingsError(f"`scale` must be one of {', '.join(RULES)}, or a list of positive numbers; got {scale!r}.")
    return tuple(values.tolist())


def noise_levels(recording: Recording) -> Vector:
    """Return `noise_level` of each output (outputs,)."""
    return np.array([noise_level(recording, axis) for axis in range(recording.outputs.shape[1])])


def noise_level(recording: Recording, axis: int) -> float:
    """Return the standard deviation of white noise on one output in its SI unit, from its third differences.

    A motion of 4 rad/s sampled at 20 ms leaves almost nothing there; the median is not moved by jerks.
    """
    differences = [np.diff(run.outputs[:, axis], 3) for run in recording.runs() if len(run) > 3]
    d = np.concatenate([np.zeros(0), *differences])
    d = d[np.isfinite(d)]
    if not d.size:
        raise DataError("no run has four samples in a row: too few to identify from; record 500 rows or more.")
    # 20 = 1 + 9 + 9 + 1, squares of the binomials; 0.6745 is the quartile of a standard normal.
    sigma = float(np.median(np.abs(d))) / 0.6745 / np.sqrt(20.0)
    # A noise-free simulation: rounding is left, of 1e-7 rad beside a neck's motion.
    return max(sigma, 1e-7 if recording.robot.is_neck else 1e-6 * float(np.nanstd(recording.outputs[:, axis])))


def _findings(chosen: ScaleTrial, tried: list[ScaleTrial], scale: Vector, robot: Robot) -> dict[str, Any]:
    weights = {"output_weight": chosen.output_weight, "motor_weight": chosen.motor_weight}
    return {
        f"epsilon_{robot.outputs.display_unit}": in_display_unit(robot, chosen.epsilon).tolist(),
        **{name: weight for name, weight in weights.items() if weight is not None},
        "scale": scale.tolist(),
        # Rows: both weights, epsilon of the first output [deg], sum of all fits [%], coverage, mean width [deg].
        "hold_out_curve": [one.row(robot) for one in tried],
    }
