"""What a nonlinear model is near rest: linear plants of one pole, found by steps of its free run; what they ask for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.estimation import AxisPlant
from softneck.identification import Model, weights_of
from softneck.robot import TIME_CONSTANT, Scaling

from ..linear._ports import motor_ranges
from ._tuning import samples_ahead

# Scaled seconds after a step of one; where nobody says how fast a robot is, as many samples as that is of the neck, and
# twice as many until nothing but this part changes in the last third.
_PROBE_SECONDS, _ROWS, _MOST_ROWS, _AT_REST = 6.0, 300, 40_000, 1e-3
# Of a scaled output: one that moves less does not follow.
_LEAST = 1e-3
# Samples of a reference ahead, each a cell of the state.
_MOST_PREVIEW = 100

S = TypeVar("S", bound=Any)


def probed(model: Model, pulled: float = 0.0) -> dict[str, dict[str, float]]:
    """Return static gain, pole [1/s] and dead time [samples] of each axis, as the model steps near rest.

    Args:
        model: of any robot.
        pulled: where all motors stand before a step, above rest [SI]: a payload may leave tendons hanging at zero.

    Raises:
        SettingsError: an input that does not move its output.
    """
    robot, weights, ends = model.robot, weights_of(model), motor_ranges(model.robot, None)
    scaling = Scaling.of(robot, set_points=None if ends is None else np.array(ends))
    sizes, inverse = scaling.input_units(weights), robot.redefinition(weights)[1][:, : len(weights)]
    moved = [_answer(model, step, scaling.motor_rest + pulled) for step in (sizes * inverse).T]
    answers = [y[:, axis] for axis, y in enumerate(moved)]
    known = Scaling.of(robot, outputs=np.array([[min(0.0, *y), max(0.0, *y)] for y in answers]).T).output_unit
    found = {}
    for name, y, size, unit in zip(robot.outputs.names, answers, sizes.tolist(), known, strict=True):
        if not np.isfinite(y).all() or abs(y[-1]) < _LEAST * unit or y[-1] == 0.0:
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
    """Return the linear plant of what `probed` found."""
    a = math.exp(-found["pole"] * sample_time)
    numerator = np.array([found["static_gain"] * (1.0 - a)])
    return AxisPlant(numerator, np.array([1.0, -a]), int(found["delay"]), sample_time)


def _answer(model: Model, step: Vector, middle: Vector) -> Matrix:
    """Return what a step (motors,) of the set-points changes of the outputs (time, outputs), until they rest."""
    block, seconds = model.block(), model.robot.time_constant_s
    rows = _ROWS if seconds is None else round(_PROBE_SECONDS * (seconds / TIME_CONSTANT) / model.sample_time)
    while True:
        u = np.full((rows, len(block.inputs)), np.nan)
        ends = []
        for set_points in (middle, middle + step):
            u[:, : step.size] = set_points
            ends.append(block.run(block.initial_state(use_measurement=0.0), u)[1][:, : len(model.robot.outputs.names)])
        y = ends[1] - ends[0]
        late = y[2 * rows // 3 :]
        if seconds is not None or rows >= _MOST_ROWS or np.ptp(late, axis=0).max() <= _AT_REST * np.abs(y[-1]).max():
            return y
        rows *= 2


def risen(settings: S) -> S:
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
    if settings.preview > _MOST_PREVIEW * Ts:
        raise SettingsError(
            f"`preview` {settings.preview:g} s is more than the {_MOST_PREVIEW} samples that are remembered, "
            f"{_MOST_PREVIEW * Ts:g} s; ask for less, the horizon sees {settings.horizon} samples."
        )
