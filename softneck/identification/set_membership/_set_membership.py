"""Nonlinear set membership identification (section 3): the data set is the model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
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
    one_blas_thread,
    require_one_of,
    require_positive,
    resolve,
    silent,
)
from softneck.robot import Robot, Scaling
from softneck.signals import Recording, scale_recording

from ..models._drive import DriveModel, fit_drive
from ..models._fitting import ScaledData, in_display_unit, training_recording
from ..models._model import WARM_UP, Model
from ..models._regressors import eq21_table, lag_table
from ._regressor import (
    Data,
    Ground,
    apply_scale,
    double_epsilon_until_feasible,
    gammas,
    require_feasible,
    residual_lags,
    set_in_si,
    usual_width,
    widening,
)

# Sources of a regressor's rows (`_narx_runtime`): own output or both of the base, set-points, motors.
_OUTPUTS, _MOTORS = (0, 3), 2
# Half a percent of fit an axis is less than the scores of two hold-outs differ by; narrower bounds are worth more.
AS_GOOD = 1.0
# Issue 5 asks it of the bounds on data like those they were made of.
COVERAGE = 0.97
_MAX_THREADS = 2


def grouped_scale(table: Matrix, output_weight: float, motor_weight: float = 1.0) -> Vector:
    """Return one weight for all outputs, one for all motor positions, and 1 for all set-points."""
    source = table[:, 0]
    return np.where(np.isin(source, _OUTPUTS), output_weight, np.where(source == _MOTORS, motor_weight, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class ScaleTrial:
    """One scale (n,) and epsilon (outputs,), scaled, with their simulation scores on the hold-out.

    score: sum of all axes' fits [%], -inf where it left all bounds; coverage: part of the samples within f_l and f_u;
    width: mean of f_u - f_l, scaled; slope: least gamma of all axes, 0 where epsilon swallowed all there was to learn.
    """

    output_weight: float | None
    motor_weight: float | None
    scale: Vector
    epsilon: Vector
    score: float
    coverage: float
    width: float
    slope: float

    def row(self, training: ScaledData) -> list[float | None]:
        """Weights, first epsilon, score, coverage and width as JSON values in the unit shown; None for none."""
        widths = np.full_like(self.epsilon, self.width)
        epsilon, width = (float(training.in_display_unit(values)[0]) for values in (self.epsilon, widths))
        judged = [value if np.isfinite(value) else None for value in (self.score, self.coverage, width)]
        return [self.output_weight, self.motor_weight, epsilon, *judged]


@dataclass(frozen=True, slots=True, eq=False)
class HoldOut:
    """Simulations over the last part of the training rows (`tail`), of sets made of the part before.

    epsilons: (outputs,) each, tried with every scale; narrow: of equally good ones take the narrowest that cover it.
    """

    ground: Ground
    data: Data
    tail: Recording
    epsilons: Sequence[Vector]
    narrow: bool = False

    def choose(self, outputs: Sequence[float], motors: Sequence[float], progress: Progress) -> list[ScaleTrial]:
        """Return all that was tried, the best first: weights of outputs, then of motors beside the best of those."""
        tried = self._try([(weight, 1.0) for weight in outputs], progress)
        if not tried:  # no function fits with any: equal regressors have unequal outputs, so that all are widened
            return replace(self, epsilons=[2.0 * epsilon for epsilon in self.epsilons]).choose(
                outputs, motors, progress
            )
        best = self.best_first(tried)[0]
        tried += self._try([(best.output_weight or 1.0, weight) for weight in motors], progress)
        return self.best_first(tried)

    def best_first(self, tried: list[ScaleTrial]) -> list[ScaleTrial]:
        """Return them by falling score."""
        ranked = sorted(tried, key=lambda one: -one.score)
        if self.narrow:
            as_good = [t for t in ranked if t.score >= ranked[0].score - AS_GOOD and t.coverage >= COVERAGE]
            chosen = min((t for t in as_good if t.slope > 0.0), key=lambda one: one.width, default=ranked[0])
            ranked = [chosen, *(one for one in ranked if one is not chosen)]
        return ranked

    def _try(self, weights: Sequence[tuple[float, float]], progress: Progress) -> list[ScaleTrial]:
        tried: list[ScaleTrial] = []
        # Queries and the search for gamma are compiled and let go of Python's lock.
        with ThreadPoolExecutor(_MAX_THREADS) as pool:
            for number, part in enumerate(pool.map(self._weights, weights), start=1):
                progress(number / (len(weights) + 1), f"weights of outputs and motors {weights[number - 1]}")
                tried += part
        return tried

    def _weights(self, weights: tuple[float, float]) -> list[ScaleTrial]:
        return list(self._scale(grouped_scale(self.ground.table, *weights), *weights))

    def _scale(self, scale: Vector, output: float | None, motor: float | None) -> Iterator[ScaleTrial]:
        for epsilon, gamma in zip(self.epsilons, gammas(self.data, scale, self.epsilons), strict=True):
            if gamma.max() > 1e100:
                continue
            arrays = self.ground.arrays(self.data, scale, gamma, epsilon)
            yield ScaleTrial(
                output, motor, scale, epsilon, *self.ground.free_run(arrays, self.tail), float(gamma.min())
            )


_WIDTH_FINDING = "usual_half_width"
# Of the training rows' widths, themselves left out.
_WIDTH_QUANTILE = 0.99


def usual_widths(data: Sequence[tuple[Matrix, Vector]], gamma: Vector, epsilon: Vector) -> Vector:
    """Return each axis' half-width that 99 % of the training rows stay below; epsilon (outputs,) [rad]."""
    # Half a second on either side is the same motion; less where there is hardly more than that.
    widths = [
        usual_width(points, values, float(gamma[axis]), min(WARM_UP, values.size // 8), _WIDTH_QUANTILE)
        for axis, (points, values) in enumerate(data)
    ]
    return epsilon + np.array(widths)


def can_detect_extrapolation(model: Model) -> bool:
    """Return whether `is_extrapolating` can judge by this model."""
    return usual_finding(model.robot) in model.findings


def usual_finding(robot: Robot) -> str:
    """Return the name of the finding that holds `usual_widths`, with its unit."""
    return f"{_WIDTH_FINDING}_{robot.outputs.display_unit}"


def is_extrapolating(model: Model, outputs: Matrix) -> np.ndarray:
    """Return (rows, outputs) whether the bounds of each output are wider than the training data's usually are.

    Args:
        model: of kind `nlsm`.
        outputs: (rows, 10 of a neck) what `model.simulate` or `model.predict` returned.

    Raises:
        SettingsError: a model without bounds, or one identified before this was learned.
    """
    if not can_detect_extrapolation(model):
        raise SettingsError("only a model of kind nlsm knows what it has seen; identify one (again).")
    first, axes = len(model.robot.outputs.names) + len(model.robot.motors.names), len(model.robot.outputs.names)
    columns = first + 2 * axes + 1  # `validity` is the last
    if outputs.ndim != 2 or outputs.shape[1] != columns:
        raise DataError(f"`outputs` must be (rows, {columns}), as a model of kind nlsm returns; got {outputs.shape}.")
    half = 0.5 * (outputs[:, first + 1 : columns : 2] - outputs[:, first : columns - 1 : 2])
    return in_display_unit(model.robot, half) > np.array(model.findings[usual_finding(model.robot)])


FORMS = ("paper_eq21", "residual")
# Kinds whose arrays hold `a`, `b`, `delay` over the redefined set-points, as the runtime runs them.
_BASES = tuple(name for name in ("rls", "oe") if name in KINDS)
# Simulation of form `residual` hardly depends on it, the width of its bounds does: below what the base and the last
# 0.8 s leave unexplained, gamma and the width grow a hundredfold.
_RESIDUAL_SIGMAS = (4.0, 8.0, 16.0, 32.0)
# The knee of gamma*(epsilon) lies at 3 to 5 sigma of the noise; in simulation more is better, as the model's own
# errors stand in the regressor too. The hold-out decides.
_EPSILON_SIGMAS = (3.0, 5.0, 8.0, 12.0)
# Weight of the output in the regressor, set-points having 1: half a decade apart up to the paper's own, 57.3, which
# logs angles in degrees beside motors in radians. A high weight trusts the fed-back output and drifts in simulation.
_OUTPUT_WEIGHTS = (3.0, 10.0, 30.0, 57.29577951308232)
# Weights of measured motors beside set-points, tried with the best weight of the output. A position is what bends
# the neck, a set-point what will: 10 gains 10 points in simulation on sine and rotation (virtual neck, `paper`), 0.3
# lost as many.
_MOTOR_WEIGHTS = (3.0, 10.0)
# Of the base's angles: a radian of motor tilts the neck by about 0.2 rad, so that 5 makes the two equal in the norm.
_ANGLE_WEIGHTS = (1.0, 2.0, 5.0, 10.0)
# The end of the training rows on which epsilon and the scale are chosen, in simulation.
_HOLD_OUT = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class SetMembership:
    """The estimator of Eq. 12-20 and Algorithm 1, one set for each axis, over the regressor of Eq. 21 or another.

    Attributes:
        form: "paper_eq21", the lags of Eq. 21 (by the robot's time constant); or "residual": set membership over
            simulated signals on what the simulation of a linear base leaves over, where nothing is fed back and so
            nothing drifts.
        output_weight: weight of the outputs in the norm of Eq. 16, all other components having 1; None chooses it, and
            one of the motors, by simulation on the last fifth of the training rows. It is for scaled components, which
            range as a neck's do.
        epsilon: noise bound of Eq. 15 [rad, or the SI unit of the outputs]; None chooses it by the same simulation
            (form "residual": so that the bounds are narrowest among equal fits).
        base: linear kind of one pole that form "residual" stands on.
    """

    form: str = "paper_eq21"
    output_weight: float | None = None
    epsilon: float | None = None
    base: str = "oe"

    def __post_init__(self) -> None:
        require_one_of("form", self.form, FORMS)
        if self.epsilon is not None:
            require_positive("epsilon", self.epsilon, "rad")
        if self.output_weight is not None:
            require_positive("output_weight", self.output_weight)
        require_one_of("base", self.base, _BASES)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Store the data set and find gamma and epsilon that are consistent with all of it.

        gamma is the paper's: the least for which f_u(i) >= y(i) and f_l(i) <= y(i) at every point.

        Raises:
            DataError: too short, constant, or `epsilon` so small that no function fits the data.
        """
        training = ScaledData.of(training_recording(recordings), alike=True)
        recording, robot = training.data, training.recording.robot
        noise = noise_levels(recording)
        ground = self._ground(recording, fit_drive(recording), training.has_time_constant)
        data = ground.data(recording)
        # One epsilon in SI, of outputs that have one unit.
        asked = None if self.epsilon is None else self.epsilon / training.scaling.output_unit
        chosen, tried = self._choose(ground, training, noise, asked, progress)
        scale = chosen.scale
        sets = [(apply_scale(X, scale), y) for X, y in data]
        # An epsilon that was asked for is kept or refused.
        if asked is None:
            epsilon, gamma = double_epsilon_until_feasible(data, scale, chosen.epsilon)
        else:
            epsilon, gamma = chosen.epsilon, gammas(data, scale, [chosen.epsilon])[0]
        require_feasible(training, ground.table, sets, gamma, epsilon)
        arrays = ground.arrays(data, scale, gamma, epsilon)
        progress(1.0, "done")
        unit = robot.outputs.display_unit
        findings = {"form": self.form, f"noise_{unit}": training.in_display_unit(noise).tolist()}
        findings |= _findings(replace(chosen, epsilon=epsilon), tried, scale, training)
        if asked is None:
            sigmas = _RESIDUAL_SIGMAS if self.form == "residual" else _EPSILON_SIGMAS
            findings |= widening(np.minimum(sigmas[-1] * noise, epsilon), epsilon, training)
        gamma_si = training.scaling.output_unit * gamma
        findings |= {"gamma": gamma_si.tolist(), "points": int(arrays["values"].shape[1])}
        findings[usual_finding(robot)] = training.in_display_unit(usual_widths(sets, gamma, epsilon)).tolist()
        return training.model("nlsm", self, set_in_si, arrays=arrays, findings=findings)

    def _ground(self, recording: Recording, drive: DriveModel, paced: bool) -> Ground:
        """Return the set's ground; the base of form `residual` is identified on `recording`."""
        residual = self.form == "residual"
        table = eq21_table(recording)
        if residual:
            own, sizes = residual_lags(recording, paced), (len(drive.pole), recording.outputs.shape[1])
            table = lag_table(own, (), own, both_outputs=True, sizes=sizes)
        return Ground(
            table=table,
            drive=drive,
            base=self._base().fit(recording) if residual else None,
            # What the set sees when it is used: the drive model's positions in simulation, which `residual` always is.
            measured=not residual,
        )

    def _base(self) -> Any:
        """Return the settings of the base; `oe` takes two poles where a recording resonates, unless told otherwise."""
        settings = resolve(find_kind(self.base, "model").settings)
        return settings(nf=1) if self.base == "oe" else settings()

    def _choose(
        self, ground: Ground, training: ScaledData, noise: Vector, asked: Vector | None, progress: Progress
    ) -> tuple[ScaleTrial, list[ScaleTrial]]:
        """Return the chosen scale and epsilon (`asked` if given), and all candidates."""
        sigmas = _RESIDUAL_SIGMAS if self.form == "residual" else _EPSILON_SIGMAS
        epsilons = [factor * noise for factor in sigmas] if asked is None else [asked]
        if asked is not None and self.output_weight is not None:
            scale = grouped_scale(ground.table, self.output_weight)
            return ScaleTrial(self.output_weight, None, scale, asked, np.nan, np.nan, np.nan, np.nan), []
        head, tail = training.data.split(1.0 - _HOLD_OUT)
        if len(tail) <= 2 * WARM_UP:
            raise DataError(
                "the record is too short to choose epsilon and the scale; record longer, or set epsilon and "
                "output_weight."
            )
        # The drives are known from all rows: they are no part of what is chosen.
        first = self._ground(head, ground.drive, training.has_time_constant)
        first = replace(first, table=ground.table)  # the scale is of these lags, and fewer rows would shorten them
        hold_out = HoldOut(first, first.data(head), tail, epsilons, narrow=self.form == "residual")
        if self.output_weight is not None:
            outputs, motors = (self.output_weight,), ()
        elif self.form == "residual":
            outputs, motors = _ANGLE_WEIGHTS, ()
        else:
            outputs, motors = _OUTPUT_WEIGHTS, _MOTOR_WEIGHTS
        tried = hold_out.choose(outputs, motors, progress)
        return tried[0], tried


def noise_si(recording: Recording) -> Vector:
    """Return `noise_level` of each output (outputs,) of a recording in SI, in SI."""
    scaling = Scaling.of(recording.robot, set_points=recording.set_points, outputs=recording.outputs)
    return scaling.output_unit * noise_levels(scale_recording(recording, replace(scaling, second=1.0)))


def noise_levels(recording: Recording) -> Vector:
    """Return `noise_level` of each output (outputs,)."""
    return np.array([noise_level(recording, axis) for axis in range(recording.outputs.shape[1])])


def noise_level(recording: Recording, axis: int) -> float:
    """Return the standard deviation of white noise on one scaled output, from its third differences.

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
    return max(sigma, 1e-7)


def _findings(chosen: ScaleTrial, tried: list[ScaleTrial], scale: Vector, training: ScaledData) -> dict[str, Any]:
    weights = {"output_weight": chosen.output_weight, "motor_weight": chosen.motor_weight}
    return {
        f"epsilon_{training.recording.robot.outputs.display_unit}": training.in_display_unit(chosen.epsilon).tolist(),
        **{name: weight for name, weight in weights.items() if weight is not None},
        "scale": scale.tolist(),
        # Rows: both weights, epsilon of the first output [deg], sum of all fits [%], coverage, mean width [deg].
        "hold_out_curve": [one.row(training) for one in tried],
    }
