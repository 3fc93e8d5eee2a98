"""The problem of a nonlinear predictive controller: its model near rest, its numbers and the arrays of its runtime."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.estimation import AxisPlant
from softneck.identification import Model, weights_of
from softneck.robot import TIME_CONSTANT, Scaling

from ..linear._ports import motor_ranges
from ._nmpc_state_runtime import NMPC_NO_BOUND
from ._plant import TAUTNESS_LEVER, samples_ahead, scale_numbers
from ._prediction import idle_moves

# Scaled seconds after a step of one; where nobody says how fast a robot is, as many samples as that is of the neck, and
# twice as many until nothing but this part changes in the last third.
_PROBE_S, _PROBE_ROWS, _MAX_PROBE_ROWS, _REST_TOLERANCE = 6.0, 300, 40_000, 1e-3
# Of a scaled output: one that moves less does not follow.
_MIN_RESPONSE = 1e-3
# Samples of a reference ahead, each a cell of the state.
_MAX_PREVIEW_SAMPLES = 100

S = TypeVar("S", bound=Any)


def identify_near_rest(model: Model, pulled: float = 0.0) -> dict[str, dict[str, float]]:
    """Return static gain, pole [1/s] and dead time [samples] of each axis, as the model steps near rest.

    `model`: of any robot. `pulled`: where all motors stand before a step, above rest [SI]: a payload may leave tendons
    hanging at zero. Raises SettingsError: an input that does not move its output.
    """
    robot, weights, ends = model.robot, weights_of(model), motor_ranges(model.robot, None)
    scaling = Scaling.of(robot, set_points=None if ends is None else np.array(ends))
    sizes, inverse = scaling.input_units(weights), robot.redefinition(weights)[1][:, : len(weights)]
    moved = [_step_response(model, step, scaling.motor_rest + pulled) for step in (sizes * inverse).T]
    answers = [y[:, axis] for axis, y in enumerate(moved)]
    known = Scaling.of(robot, outputs=np.array([[min(0.0, *y), max(0.0, *y)] for y in answers]).T).output_unit
    found = {}
    for name, y, size, unit in zip(robot.outputs.names, answers, sizes.tolist(), known, strict=True):
        if not np.isfinite(y).all() or abs(y[-1]) < _MIN_RESPONSE * unit or y[-1] == 0.0:
            hint = " or ask for `minimum_tautness` if its tendons hang" if robot.tendon_angles is not None else ""
            raise SettingsError(
                f"the model's {name} does not follow its input `{robot.input_names[len(found)]}`; identify it "
                f"again{',' + hint if hint else ''}."
            )
        share = y / y[-1]
        dead, risen = (int(np.argmax(share > part)) for part in (0.05, 0.632))
        a = math.exp(-1.0 / max(1, risen - dead))
        gain = float(y[-1] / size)
        found[name] = {"static_gain": gain, "pole": -math.log(a) / model.sample_time, "delay": dead}
    return found


def plant_of(found: Mapping[str, float], sample_time: float) -> AxisPlant:
    """Return the linear plant of the result of `identify_near_rest`."""
    a = math.exp(-found["pole"] * sample_time)
    numerator = np.array([found["static_gain"] * (1.0 - a)])
    return AxisPlant(numerator, np.array([1.0, -a]), int(found["delay"]), sample_time)


def _step_response(model: Model, step: Vector, middle: Vector) -> Matrix:
    """Return the response (time, outputs) to a step (motors,) of the set-points, until rest."""
    block, seconds = model.block(), model.robot.time_constant_s
    rows = _PROBE_ROWS if seconds is None else round(_PROBE_S * (seconds / TIME_CONSTANT) / model.sample_time)
    while True:
        u = np.full((rows, len(block.inputs)), np.nan)
        ends = []
        for set_points in (middle, middle + step):
            u[:, : step.size] = set_points
            ends.append(block.run(block.initial_state(use_measurement=0.0), u)[1][:, : len(model.robot.outputs.names)])
        y = ends[1] - ends[0]
        late = y[2 * rows // 3 :]
        if (
            seconds is not None
            or rows >= _MAX_PROBE_ROWS
            or np.ptp(late, axis=0).max() <= _REST_TOLERANCE * np.abs(y[-1]).max()
        ):
            return y
        rows *= 2


def apply_rise_time(settings: S) -> S:
    """Return the settings with the filter, or the bandwidth, that their `rise_s` asks for."""
    if settings.rise_s is None:
        return settings
    # Two lags a and b in series rise in ln 9 sqrt(a^2 + b^2), to 8 %.
    whole, loop = settings.rise_s / math.log(9.0), 1.0 / settings.bandwidth
    if whole < loop:
        return replace(settings, rise_s=None, bandwidth=1.0 / whole, reference_time=0.0)
    return replace(settings, rise_s=None, reference_time=math.sqrt(whole**2 - loop**2))


def require_horizon(settings: Any, plants: Sequence[AxisPlant]) -> None:
    """Raise SettingsError for a horizon that sees no move's effect, or a preview that is more than is remembered."""
    Ts = plants[0].sample_time
    late = max(0, max(plant.delay for plant in plants) - samples_ahead(settings.look_ahead, Ts))
    if settings.horizon <= late:
        raise SettingsError(
            f"`horizon` {settings.horizon} samples end within the model's dead time of {late}: no move would be seen "
            f"to do anything. Ask for {late + 10}."
        )
    if settings.preview > _MAX_PREVIEW_SAMPLES * Ts:
        raise SettingsError(
            f"`preview` {settings.preview:g} s is more than the {_MAX_PREVIEW_SAMPLES} samples that are remembered, "
            f"{_MAX_PREVIEW_SAMPLES * Ts:g} s; ask for less, the horizon sees {settings.horizon} samples."
        )


# Scaled seconds without measurement until the motors hold, and after which a model has settled.
_COAST_S, _SETTLE_S = 0.5, 4.0
# On violations of soft limits against errors of the angles, squared; iterations of the QP's solver.
SLACK_WEIGHT, BUDGET = 1e3, 200


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class NonlinearProblem:
    """The problem condensed to the moves z of the motors (Bock 1983; Diehl et al. 2005, sec. 3).

        min  sum_i w_i |y_i(z) - t_i|^2 + lambda |z - a|^2 + rho sum_i (delta_i(z) - c)^2

    with y_i the model's simulation and t_i the reference less the estimated disturbance.

    Attributes:
        model: that is predicted.
        horizon: N, samples from now.
        starts: samples at which the motors may move.
        T: (outputs + 1, motors) of Eq. 9-11, of a neck with 3 motors and 2 outputs.
        T_inverse: (motors, outputs + 1).
        weights: (N, outputs) on angle errors [1/rad^2].
        move_weight: lambda.
        cocontraction_weight: rho.
        look: samples by which the observer is ahead of its sensor.
    """

    model: Model
    horizon: int
    starts: tuple[int, ...]
    T: Matrix
    T_inverse: Matrix
    weights: Matrix
    move_weight: float
    cocontraction_weight: float
    look: int = 0

    @property
    def levels(self) -> Matrix:
        """(kept, motors) co-contraction, and other directions of the motors that move no output."""
        return np.vstack([self.T[-1:], idle_moves(self.T)])


def estimate_gains(pole: float, window: int) -> Matrix:
    """Return (2, window): gains from past model errors, newest first, to level and rate of the disturbance.

    Of all `o(k+1) = o(k) + r(k)`, `r(k+1) = a r(k)` the one nearest to the last `window` residuals, in least squares:
    with the model's inputs known and its state that of its simulation the estimation over the horizon is linear.
    `pole`: a, the plant's slowest. `window`: residuals, at least 2.
    """
    back = np.arange(window)
    # i samples ago the level was lower by the rates since then, r(k-j) = a^-j r(k).
    since = np.concatenate([[0.0], np.cumsum(pole ** -back[1:].astype(float))])
    regressor = np.column_stack([np.ones(window), -since])
    return np.linalg.pinv(regressor)


def disturbance_ahead(pole: float, horizon: int) -> Matrix:
    """Return (horizon, 2): the predicted disturbance from its present level and rate."""
    i = np.arange(1, horizon + 1)
    return np.column_stack([np.ones(horizon), (1.0 - pole**i) / (1.0 - pole)])


def reference_slopes(problem: NonlinearProblem, delay: int) -> Matrix:
    """Return (moves, path): the map from future references, over horizon and dead time, to wanted moves."""
    p, L = problem, problem.horizon + delay + 1
    ends = (*p.starts[1:], p.horizon)
    middles = np.array([-0.5, *(0.5 * (a + b) for a, b in zip(p.starts, ends, strict=True))]) + delay
    places = np.clip(middles, 0.0, L - 1.0)
    low = np.minimum(np.floor(places).astype(int), L - 2)
    weights = np.zeros((places.size, L))
    weights[np.arange(places.size), low] += 1.0 - (places - low)
    weights[np.arange(places.size), low + 1] += places - low
    return np.diff(weights, axis=0)


def controller_arrays(controller: Any) -> tuple[Matrix, ...]:
    """Return the controller's own arrays, in the order of `_nmpc_runtime`; those of the model follow."""
    s, p, plant, Ts = controller.settings, controller.problem(), controller.near_rest, controller.sample_time
    block, m = controller.model.block(), len(plant.axes)
    start = block.initial_state(use_measurement=0.0, noise_std=0.0)
    pole = max(float(-axis.denominator[1]) for axis in plant.axes)
    ahead = round(s.preview / Ts)
    lead = min(round(s.reference_time / Ts), ahead)
    slopes = reference_slopes(p, max(0, max(axis.delay for axis in plant.axes) - p.look))
    asked_at = np.minimum(np.arange(1, slopes.shape[1] + 1) + lead, max(ahead, 1)) - 1
    slack = 0.0 if s.angle_limit is None else SLACK_WEIGHT * float(p.weights[0].max())
    coast, settle = (max(1, round(time / plant.axes[0].sample_time)) for time in (_COAST_S, _SETTLE_S))
    scale = scale_numbers(plant, controller.limits)
    constants = np.array([
        Ts, p.horizon, s.window, ahead, lead, math.exp(-Ts / s.reference_time) if s.reference_time > 0.0 else 0.0,
        p.move_weight, p.cocontraction_weight, slack, s.angle_limit or 0.0, BUDGET, coast, settle, len(block.outputs),
        -NMPC_NO_BOUND if s.minimum_tautness is None else s.minimum_tautness / plant.scaling.motor_unit,
        TAUTNESS_LEVER, p.look,
        # The redefined inputs' units are no numbers of this runtime.
        *scale[: max(0, len(scale) - m)],
    ])  # fmt: skip
    return (
        constants, np.array(p.starts, dtype=np.float64), p.T, p.levels, p.weights, estimate_gains(pole, s.window),
        disturbance_ahead(pole, p.horizon), slopes,
        p.T_inverse[:, :-1] / np.array([axis.static_gain for axis in plant.axes]), asked_at.astype(np.float64),
        start.parameters,
    )  # fmt: skip
