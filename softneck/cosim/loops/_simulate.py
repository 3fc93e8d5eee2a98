"""Run a loop, time it, and say where its plant or its motors left what they know."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import SettingsError, Vector, shown_progress, silent, to_si
from softneck.identification import farthest, held
from softneck.loop import BlockPart, LoopResult, Part, StepCallback, System, run_loop
from softneck.loop import Loop as Loop  # re-exported by the subpackage
from softneck.robot import Robot

from ._loop_file import LoopSetup, load_loop, load_ssp, make_loop
from ._result import Result


def simulate(
    loop: Loop | LoopSetup | System | Mapping[str, Any] | str | Path,
    *,
    report: Callable[[float], None] | None = None,
    on_step: StepCallback | None = None,
    pace: float | None = None,
    keep: bool = False,
    compiled: bool = False,
) -> Result:
    """Run a loop from t = 0 to its end.

    Args:
        loop: a plain loop, one with limits as `load_loop` returns it, a loop file, an SSP archive, a system as
            `load_ssp` returns it, or a table of a loop file's keys, whose relative paths start at the working folder
            and which may hold objects (see `make_loop`).
        report: called now and then with the done fraction; a bar in a terminal if not given.
        on_step: called after each row with a `LoopStep`; it stops the run by returning True.
        pace: run at this multiple of real time; as fast as possible if not given.
        keep: leave the FMUs loaded, so that the next run of the same loop resets them; `loop.close()` ends it.
        compiled: run loops whose parts are all blocks (softneck files, the virtual neck, no FMUs) as one compiled
            function: the same bits, sooner after a second of compiling, which is kept.

    Where the plant's `validity` falls under 0.5 it warns once (`Result.remarks`).

    Raises:
        SettingsError: parts that do not fit together, or what `make_loop` refuses.
        DataError: a part returned what is not a number.
        FmuError: an FMU refused a call.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> controller = softneck.design_controller("pi", softneck.identify("rls", recording))
        >>> step = {"kind": "step", "pitch_deg": 10.0, "at_s": 0.5}
        >>> loop = {"duration_s": 3.0, "plant": "paper", "controller": controller, "reference": step}
        >>> result = softneck.simulate({**loop, "limits": {"pitch.overshoot_pct": 20.0}})
        >>> result.holds, list(result.to_pandas())[:2]
        (True, ['pitch', 'roll'])
    """
    with shown_progress("simulate", None if report is None else lambda done, _: report(done)) as tell:
        result = run_setup(
            _opened(loop), report=None if tell is silent else lambda done: tell(done, ""), on_step=on_step, pace=pace,
            keep=keep, compiled=compiled,
        )  # fmt: skip
    # A plant without validity is told in `remarks` and by the command: no warning for every model made by hand.
    for remark in result.remarks if np.any(result.signals.signals.get("validity", 0.0)) else ():
        warnings.warn(remark, stacklevel=2)
    return result


def run_setup(
    setup: LoopSetup | System,
    *,
    report: Callable[[float], None] | None = None,
    on_step: StepCallback | None = None,
    pace: float | None = None,
    keep: bool = False,
    compiled: bool = False,
) -> Result:
    """Run a loop as `simulate` does, whose remarks the caller tells."""
    plain = setup if isinstance(setup, System) else setup.loop
    begin = time.perf_counter()
    signals = run_loop(plain, report, on_step=on_step, pace=pace, keep=keep, compiled=compiled)
    wall = time.perf_counter() - begin
    if isinstance(setup, System):
        return Result(signals=signals, wall_time=wall, order=plain.order, closed=False)
    loop = setup.loop
    beyond = reach_beyond(loop.controller, loop.controller_parameters, loop.robot)
    return Result(
        signals=signals,
        bounds=setup.limits,
        wall_time=wall,
        files=setup.files,
        order=plain.order,
        angle=setup.angle,
        remarks=(*([f"{beyond}."] if beyond else []), *validity_remarks(signals, loop.plant)),
    )


def _opened(loop: Any) -> LoopSetup | System:
    if isinstance(loop, LoopSetup | System):
        return loop
    if isinstance(loop, Loop):
        return LoopSetup(loop=loop)
    if isinstance(loop, Mapping):
        return make_loop(loop)
    if isinstance(loop, str | Path):
        return load_ssp(loop) if Path(loop).suffix == ".ssp" else load_loop(loop)
    raise SettingsError(f"`loop` must be a Loop, a loop file or a table of its keys; got a {type(loop).__name__}.")


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
