"""What to say of a loop: a plant that left what it knows, and a controller of motors that may go further."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import Vector, to_si
from softneck.identification.models._validity import farthest, held
from softneck.loop import LoopResult, Part
from softneck.loop._part import BlockPart
from softneck.robot import Robot

# Below it the model is more often wrong than right by its tolerance.
_DOUBTFUL = 0.5


def validity_remarks(result: LoopResult, plant: Part) -> tuple[str, ...]:
    """Return the warning about the plant's `validity`: its first sample under 0.5 and the input to blame; or nothing.

    Args:
        result: all signals of the run.
        plant: its ports, and where it is a model what it knows.
    """
    if "validity" not in result.signals:
        return ()
    validity = result["validity"]
    # A model that knows where it was trained is never certain to be wrong.
    if not validity.any():
        return ("no validity in this file: identify it again; how far the plant can be trusted here is not known.",)
    doubtful = np.flatnonzero(validity < _DOUBTFUL)
    if not doubtful.size:
        return ()
    row = int(doubtful[0])
    return (
        f"the plant's validity falls under {_DOUBTFUL:g} at t = {result.time[row]:.2f} s "
        f"(least {validity.min():.2f}): {_why(result, plant, row)}.",
    )


def reach_beyond(controller: Part, parameters: Mapping[str, float], robot: Robot) -> str:
    """Return where a controller may send a motor beyond the range that `robot` has, in a line; "" if nowhere.

    Robots that differ in limits alone fit each other's files: a controller may be of one that goes further.

    Args:
        controller: its outputs' ranges, and `position_limit` among its parameters.
        parameters: as the loop sets them.
        robot: whose motors are moved.
    """
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    if motors.setpoint_min is None or motors.setpoint_max is None:
        return ""
    block = controller.block if isinstance(controller, BlockPart) else controller
    starts = {port.name: port.start for port in getattr(block, "parameters", ())} | dict(parameters)
    most = starts.get("position_limit", np.inf)
    ports = {port.name: port for port in controller.outputs}
    for name, low, high in zip(robot.set_points, motors.setpoint_min, motors.setpoint_max, strict=True):
        port = ports.get(name)
        ends = () if port is None else ((port.minimum, -1.0, low), (port.maximum, 1.0, high))
        for end, sign, limit in ends:
            far = sign * min(most, np.inf if end is None else sign * end) / factor
            if np.isfinite(far) and sign * (far - limit) > 1e-9 * (high - low):
                return (
                    f"the controller may send `{name}` to {far:.3g} {motors.unit}, and robot {robot.label()} goes to "
                    f"{limit:.3g} {motors.unit}: it was designed for other limits"
                )
    return ""


def _why(result: LoopResult, plant: Part, row: int) -> str:
    """Return which input is to blame at a row, and how far it is outside."""
    beyond = _beyond_training(result, plant, row)
    if beyond:
        return beyond
    robot, unit = result.robot, result.robot.motors.unit
    motors = np.column_stack([result[name] for name in robot.motor_positions])
    if not isinstance(plant, BlockPart):
        return _nearest_end(plant, held(motors[: row + 1])[-1], robot)
    motor, stays, value, times = farthest(plant.block, motors[: row + 1])
    what = "has been held around" if stays else "is at"
    place = f"`{robot.motor_positions[motor]}` {what} {value / to_si(unit)[0]:.3g} {unit}"
    if times <= 1.0:
        return f"{place}, together with the others as it was not in training"
    return f"{place}, {times:.1f} times as far from its mean as most of the training"


def _nearest_end(plant: Part, places: Vector, robot: Robot) -> str:
    """Return which motor has been held nearest to an end of its training: an FMU tells no more of it than its range.

    Args:
        plant: its set-points' minimum and maximum.
        places: (motors,) where they have been held.
        robot: whose motors.
    """
    unit, worst, found = robot.motors.unit, -1.0, "its motors move together, or are held, as they were not in training"
    ports = {port.name: port for port in plant.inputs}
    for name, motor, place in zip(robot.set_points, robot.motor_positions, places, strict=True):
        low, high = (ports[name].minimum, ports[name].maximum) if name in ports else (None, None)
        if low is None or high is None or high <= low:
            continue
        share = abs(2.0 * place - low - high) / (high - low)
        if share > worst:
            worst = share
            place, low, high = (value / to_si(unit)[0] for value in (place, low, high))
            found = (
                f"`{motor}` has been held around {place:.3g} {unit}, which is within the {low:.3g} to {high:.3g} "
                f"{unit} of its training: there it was not held, or not together with the others"
            )
    return found


def _beyond_training(result: LoopResult, plant: Part, row: int) -> str:
    """Return the set-point farthest beyond the range that the plant was trained on, up to a row; "" if none is."""
    robot: Robot = result.robot
    unit = robot.motors.unit
    scale, found, worst = to_si(unit)[0], "", 0.0
    for port in plant.inputs:
        if port.name not in robot.set_points or port.minimum is None or port.maximum is None:
            continue
        values = result[port.name][: row + 1]
        for limit, over in ((port.maximum, values.max() - port.maximum), (port.minimum, port.minimum - values.min())):
            if over > max(worst, 1e-6 * (port.maximum - port.minimum)):
                worst = float(over)
                found = (
                    f"`{port.name}` was {worst / scale:.3g} {unit} beyond the {limit / scale:.3g} {unit} that it was "
                    "trained on"
                )
    return found
