"""What a nonlinear model is near rest: linear plants of one pole, found by steps of its free run; what they ask for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.estimation import AxisPlant
from softneck.identification import Model
from softneck.identification.models._directions import NECK_SECONDS

from ..linear._ports import ControllerLimits
from ._tuning import samples_ahead

# A neck's model is moved by this much of a redefined input to learn its gain and its time constant [rad]; another
# robot's by as much of its motors' range: 2/3 rad of 6 rad to either side.
_PROBE = 1.0
_PROBE_SECONDS = 6.0
_OF_RANGE = 1.0 / 9.0
# Another robot is watched for as many samples as a neck at 20 ms, and twice as long until nothing but this part changes
# in the last third.
_ROWS, _MOST_ROWS = 300, 40_000
_AT_REST = 1e-3
# Of the largest answer: an output that moves less does not follow.
_LEAST = 1e-3
# Samples of a reference ahead, each a cell of the state.
_MOST_PREVIEW = 100

S = TypeVar("S", bound=Any)


def probed(model: Model, inverse: Matrix, limits: ControllerLimits, pulled: float = 0.0) -> dict[str, dict[str, float]]:
    """Return static gain, pole [1/s] and dead time [samples] of each axis, as the model steps near rest.

    Args:
        model: of any robot.
        inverse: from redefined inputs to motors.
        limits: of its motors.
        pulled: where all motors of a neck stand before a step [rad]: a payload may leave its tendons hanging at zero.

    Raises:
        SettingsError: an input that does not move its output.
    """
    neck, found, answers = model.robot.is_neck, {}, {}
    for axis, name in enumerate(model.robot.outputs.names):
        direction = inverse[:, axis]
        size = _PROBE if neck else _places(limits)[1] / float(np.abs(direction).max())
        answers[name] = _answer(model, size * direction, limits, pulled)[:, axis] / size
    largest = max(float(np.abs(y).max()) for y in answers.values())
    for name, y in answers.items():
        if not np.isfinite(y).all() or abs(y[-1]) < (_LEAST if neck else _LEAST * largest) or y[-1] == 0.0:
            told = "its input (Eq. 9, 10)" if neck else "its direction"
            hint = (
                "identify it again, or ask for `minimum_tautness` if its tendons hang" if neck else "identify it again"
            )
            raise SettingsError(f"the model's {name} does not follow {told}; {hint}.")
        share = y / y[-1]
        dead, risen = (int(np.argmax(share > part)) for part in (0.05, 0.632))
        a = math.exp(-1.0 / max(1, risen - dead))
        found[name] = {"static_gain": float(y[-1]), "pole": -math.log(a) / model.sample_time, "delay": dead}
    return found


def plant_of(found: Mapping[str, float], sample_time: float, neck: bool) -> AxisPlant:
    """Return the linear plant of what `probed` found."""
    a = math.exp(-found["pole"] * sample_time)
    numerator = np.array([found["static_gain"] * (1.0 - a)])
    stretch = 1.0 if neck else max(1.0 / found["pole"], sample_time) / NECK_SECONDS
    return AxisPlant(numerator, np.array([1.0, -a]), int(found["delay"]), sample_time, stretch)


def _answer(model: Model, step: Vector, limits: ControllerLimits, pulled: float) -> Matrix:
    """Return what a step (motors,) of the set-points changes of the outputs (time, outputs), until they rest."""
    neck, block = model.robot.is_neck, model.block()
    middle = np.full(step.size, pulled) if neck else _places(limits)[0]
    rows = round(_PROBE_SECONDS / model.sample_time) if neck else _ROWS
    while True:
        u = np.full((rows, len(block.inputs)), np.nan)
        ends = []
        for set_points in (middle, middle + step):
            u[:, : step.size] = set_points
            ends.append(block.run(block.initial_state(use_measurement=0.0), u)[1][:, : len(model.robot.outputs.names)])
        y = ends[1] - ends[0]
        late = y[2 * rows // 3 :]
        if neck or rows >= _MOST_ROWS or np.ptp(late, axis=0).max() <= _AT_REST * np.abs(y[-1]).max():
            return y
        rows *= 2


def _places(limits: ControllerLimits) -> tuple[Vector, float]:
    """Return where another robot's motors stand before a step (motors,), and by how much one is moved."""
    motors = len(limits.robot.motors.names)
    low, high = np.split(limits.constants(1.0)[1 : 2 * motors + 1], 2)
    return 0.5 * (low + high), 0.5 * _OF_RANGE * float((high - low).min())


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
