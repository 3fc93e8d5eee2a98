"""The plant that is predicted, its samples, and what a design takes of its loop's observer: look-ahead and tautness."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from softneck.core import SettingsError, to_si
from softneck.estimation import slowest_seconds
from softneck.identification import Model, weights_of
from softneck.robot import Scaling

from ..plants._coupled_axis import AnyAxes, AnyAxis, CoupledAxis, times
from ..plants._uncertain import doubts_of
from ._scale import ScaledPlant
from ._tuning import samples_ahead

# That many samples of a family judge robustness; they are spread evenly over all.
_JUDGES = 12
# A fit of free runs hides more of the dead time than a plant of one's own has: by so much.
HIDDEN = 1.25

# Small moves that tell whether tendons hang, of a scaled redefined input, and the scaled seconds that a model settles.
_MOVE, _SETTLED = 0.3, 3.0
# Tendons are taut where such a move does this part of the most that it does anywhere.
_TAUT = 0.9
# Scaled co-contractions that are tried, from rest on.
_STEP, _MOST = 0.25, 4.0

# Part of `least_delay` that is a sensor's at most.
_BEHIND = 0.5

S = TypeVar("S", bound=Any)


def predicted_plants(settings: Any, plant: ScaledPlant) -> AnyAxes:
    """Return the plant of each output that is predicted, with settings in scaled seconds."""
    return tuple(_predicted(settings, plant, axis) for axis in range(len(plant.axes)))


def taken(settings: Any, asked: Any, plant: ScaledPlant) -> dict[str, float]:
    """Return the assumed dead time and pole that change the plant, where the settings do not give their own."""
    found: dict[str, float] = {}
    for name in ("least_delay", "small_move_pole", "taut_pole"):
        value, second = float(getattr(settings, name)), plant.scaling.second
        if getattr(asked, name) is not None or value == 0.0:
            continue
        if name == "least_delay":
            changes = any(axis.with_min_delay(value / second).delay > axis.delay for axis in plant.axes)
        else:
            changes = any(axis.faster(value * second) is not axis for axis in plant.axes)
        found |= {name: value} if changes else {}
    return found


def families(nominal: AnyAxes, small_move_pole: float) -> list[AnyAxes]:
    """Return what the robot may be: as identified, and faster."""
    if small_move_pole == 0.0:
        return [nominal]
    fast = tuple(plant.faster(small_move_pole) for plant in nominal)
    return [nominal] if fast == nominal else [nominal, fast]


def _predicted(settings: Any, whole: ScaledPlant, axis: int) -> AnyAxis:
    plant = timed(whole.axes[axis], settings)
    if settings.taut_pole == 0.0 or isinstance(plant, CoupledAxis):
        return plant
    # Recordings in which tendons hang say less than a taut neck does, none says more.
    ratios = [abs(sample.static_gain / plant.static_gain) for sample in whole.samples[axis]]
    (taut,) = times((plant.faster(settings.taut_pole),), max([1.0, *ratios]))
    return taut


def timed(plant: AnyAxis, timing: Any) -> Any:
    """Return a plant with the dead time that the controller sees: at least so much, less what the observer is ahead."""
    late = plant.with_min_delay(timing.least_delay)
    return replace(late, delay=max(0, late.delay - samples_ahead(timing.look_ahead, plant.sample_time)))


def sample_pairs(plant: ScaledPlant, timing: Any) -> list[AnyAxes]:
    """Return samples of a family, axes joined by the order of their static gains; none for a single model."""
    axes = [sorted((timed(item, timing) for item in each), key=lambda item: item.static_gain) for each in plant.samples]
    count = min(_JUDGES, *(len(plants) for plants in axes))
    picks = [np.linspace(0, len(plants) - 1, count).round().astype(int) for plants in axes]
    return [tuple(plants[i] for plants, i in zip(axes, chosen, strict=True)) for chosen in zip(*picks, strict=True)]


def over(settings: S, observer: Any) -> S:
    """Return settings for a loop with this observer; what was given stays.

    Args:
        settings: of `mpc` or `nmpc`.
        observer: whose `lead` becomes `look_ahead`, of `mpc` at most half of `least_delay`; if it tells a payload, its
            model says `payload_tautness`.

    Raises:
        SettingsError: what is no observer.
    """
    if not hasattr(observer, "lead"):
        raise SettingsError(f"an observer is needed, of `softneck observer`; got {type(observer).__name__}.")
    found: dict[str, float] = {}
    if settings.look_ahead is None:
        # What `least_delay` adds stands for a dead time that recordings hide, and no sensor is later for that.
        least = getattr(settings, "least_delay", 0.0)
        least = HIDDEN * doubts_of(observer.robot).least_delay if least is None else least
        found["look_ahead"] = min(observer.lead, _BEHIND * least or math.inf)
    told, wished = getattr(observer, "payloads", None), settings.minimum_tautness is not None
    asks = getattr(settings, "payload_tautness", 0.0) is None
    if asks and wished and told is not None and told[1] > 0.0 and observer.robot.tendon_angles is not None:
        # On top of `minimum_tautness`: what is in reserve without payload is there with it.
        found["payload_tautness"] = taut_from(observer.model, told[1]) / told[1]
    return replace(settings, **found)


def taut_from(model: Model, payload: float) -> float:
    """Return the least co-contraction [SI] from rest on at which small moves do under a payload what they can."""
    tried = np.arange(0.0, _MOST + _STEP / 2, _STEP)
    gains = np.array([_gain(model, payload, common) for common in tried])
    return float(tried[np.argmax(gains >= _TAUT * gains.max())]) * _scaling(model).motor_unit


def _scaling(model: Model) -> Scaling:
    motors = model.robot.motors
    ends = None
    if motors.setpoint_min is not None and motors.setpoint_max is not None:
        ends = to_si(motors.unit)[0] * np.array([motors.setpoint_min, motors.setpoint_max])
    return Scaling.of(model.robot, set_points=ends, time_constant=slowest_seconds(model))


def _gain(model: Model, payload: float, common: float) -> float:
    """Return the mean static gain of small moves to both sides of a scaled co-contraction, of all axes."""
    block, weights, scaling = model.block(), weights_of(model), _scaling(model)
    inverse = model.robot.redefinition(weights)[1]
    moves = _MOVE * scaling.input_units(weights)
    rows, motors, found = round(_SETTLED * scaling.second / model.sample_time), inverse.shape[0], []
    for axis in range(len(model.robot.outputs.names)):
        inputs = np.full((3 * rows, len(block.inputs)), np.nan)
        for part, side in enumerate((0.0, 1.0, -1.0)):
            inputs[part * rows : (part + 1) * rows, :motors] = (
                scaling.unscale_motors(np.full(motors, common)) + side * moves[axis] * inverse[:, axis]
            )
        _, outputs = block.run(block.initial_state(use_measurement=0.0, payload=payload), inputs)
        found.append(abs(outputs[2 * rows - 1, axis] - outputs[-1, axis]) / (2.0 * moves[axis]))
    return float(np.mean(found))
