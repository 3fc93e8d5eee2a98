"""Run a loop, and its result: signals, metrics, limits, and warnings where the plant's model does not hold."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import (
    DataError,
    ReprMixin,
    SettingsError,
    Vector,
    certificate_contents,
    shown_progress,
    silent,
    to_si,
)
from softneck.identification import find_farthest_motor, low_pass_motors
from softneck.loop import BlockPart, LoopResult, Part, StepCallback, System, check_limits, metrics, run_loop
from softneck.loop import Loop as Loop  # re-exported by the subpackage
from softneck.robot import Robot
from softneck.signals import Recording, dataset, file_unit, known_channels, signals_figure, table

from ._loop_file import LoopSetup, load_loop, load_ssp, make_loop

if TYPE_CHECKING:
    import pandas as pd
    import xarray  # pyright: ignore[reportMissingImports]  an extra
    from matplotlib.figure import Figure


# Rows of a run that its certificate keeps, spread over all of it: what goes another way is elsewhere in one of them.
_TRACE_ROWS = 50


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Result(ReprMixin):
    """One simulated loop: its signals, its metrics, and whether it keeps its limits.

    Attributes:
        signals: all signals, named as in a recording, with their units.
        bounds: metric -> limit, as in the loop file: an upper one, of `validity.min` a lower one.
        wall_time: what the run took [s].
        files: what it was told to read: role -> (path, SHA-256).
        order: "sequential" or "jacobi".
        angle: which outputs the metrics judge, "true" or "measured".
        closed: whether it was a closed loop; other systems have signals and no metrics.
        remarks: what there is to warn of, one line each: where the plant is a model and knows itself to be wrong.
    """

    signals: LoopResult
    bounds: Mapping[str, float] = field(default_factory=dict)
    wall_time: float = 0.0
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    order: str = "sequential"
    angle: str = "true"
    closed: bool = True
    remarks: tuple[str, ...] = ()

    def summary(self) -> str:
        """Return two lines: what ran, and whether it keeps its limits."""
        rows, failed = self.limits, [row["metric"] for row in self.limits if not row["holds"]]
        said = f"fails {', '.join(failed)}" if failed else f"keeps {len(rows)} limits" if rows else "no limits stated"
        return f"{self.signals.summary()}\n{said}" + "".join(f"\n{remark}" for remark in self.remarks)

    def __getitem__(self, name: str) -> Vector:
        """Return one signal (N,) in SI."""
        return self.signals[name]

    @property
    def robot(self) -> Robot:
        """Whose loop it was."""
        return self.signals.robot

    @property
    def metrics(self) -> dict[str, dict[str, float | None]]:
        """Rise, settling, overshoot and errors of each axis, and what the motors did."""
        return metrics(self.signals, angle=self.angle) if self.closed else {}

    @property
    def limits(self) -> list[dict[str, Any]]:
        """For each limit of the loop: metric, limit, value, holds."""
        return check_limits(self.metrics, self.bounds)

    @property
    def holds(self) -> bool:
        """Whether there are limits, and all of them hold."""
        return bool(self.bounds) and all(row["holds"] for row in self.limits)

    @property
    def real_time_factor(self) -> float:
        """Simulated time over the time it took."""
        return len(self.signals.time) * self.signals.sample_time / max(self.wall_time, 1e-9)

    @property
    def frame(self) -> pd.DataFrame:
        """All signals as a table; the columns say their unit as in a recording's file."""
        import pandas as pd

        columns = {"time [s]": self.signals.time}
        for name, values in self.signals.signals.items():
            unit, factor = _shown(name, self.signals.units[name], self.robot)
            columns[f"{name} [{unit}]"] = values * factor
        return pd.DataFrame(columns)

    def to_pandas(self) -> pd.DataFrame:
        """Return all signals as a table over time [s], in SI; `attrs["units"]` has their units."""
        return table(self.signals.time, self.signals.signals, self.signals.units)

    def to_xarray(self) -> xarray.Dataset:
        """Return all signals as a Dataset over `time`, each with its unit; needs the extra `xarray`."""
        return dataset(self.signals.time, self.signals.signals, self.signals.units)

    def plot(self, title: str = "") -> Figure:
        """Return a matplotlib figure: references, outputs and motors of a closed loop; of others all signals."""
        from softneck.plots import (
            chart_figure,  # matplotlib takes a while to import
            loop_chart,
        )

        time, signals = self.signals.time, self.signals.signals
        if not self.closed:
            return signals_figure(time, signals, self.signals.units, title)
        return chart_figure(loop_chart(time, signals, title, limits=self.bounds, robot=self.robot))

    def recording(self) -> Recording:
        """Return the run as a recording: its channels of those names, with pitch and roll true where offered."""
        known = set(known_channels(self.robot))
        channels = {name: values for name, values in self.signals.signals.items() if name in known}
        for axis in self.robot.outputs.names:
            channels.setdefault(axis, self.signals.angle(axis))
        return Recording(self.signals.time, self.signals.sample_time, channels, robot=self.robot)

    def report(self) -> dict[str, Any]:
        """Return the JSON of `softneck simulate`."""
        return {"metrics": self.metrics, "limits": self.limits, "real_time_factor": self.real_time_factor}

    def trace(self) -> dict[str, list[Any]]:
        """Return some rows of the run, by which it is known again: their numbers, set-points and outputs.

        The keys are "row", "motor_setpoint_1" to 3 and "pitch", "roll", or another robot's set-points and outputs; the
        values have shape (rows,), in SI; an output that was not measured there is None.
        """
        rows = np.unique(np.linspace(0, len(self.signals.time) - 1, _TRACE_ROWS).astype(int))
        kept = {name: self.signals[name] for name in self.robot.set_points}
        kept |= {axis: self.signals.angle(axis) for axis in self.robot.outputs.names}
        cells = {name: [x if np.isfinite(x) else None for x in values[rows].tolist()] for name, values in kept.items()}
        return {"row": rows.tolist(), **cells}

    def certificate(self) -> dict[str, Any]:
        """Return what held, with the hash of every file that was read.

        Raises:
            SettingsError: the loop has no limits, so nothing can hold.
        """
        if not self.bounds:
            raise SettingsError("the loop has no [limits]: a certificate of it would show nothing; state some.")
        more = {
            "trace": self.trace(),
            "limits": self.limits,
            "metrics": self.metrics,
            "order": self.order,
            "angle": self.angle,
            "sample_time_s": self.signals.sample_time,
            "duration_s": len(self.signals.time) * self.signals.sample_time,
            **({"robot": {"name": self.robot.name, "hash": self.robot.hash}} if self.robot.in_header() else {}),
        }
        return certificate_contents("simulate", holds=self.holds, files=self.files, more=more)


def _shown(name: str, unit: str, robot: Robot) -> tuple[str, float]:
    """Return the unit in which a table shows a signal, and the factor to it."""
    try:
        to_unit, si = to_si(unit or "1")
    except DataError:
        return unit, 1.0  # a foreign FMU's own unit stays as it is
    shown = file_unit(name, robot) if name in known_channels(robot) else {"rad": "deg", "rad/s": "deg/s"}.get(si, si)
    return (shown, to_unit / to_si(shown)[0]) if to_si(shown)[1] == si else (unit or "1", 1.0)


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
        return _nearest_end(plant, low_pass_motors(motors[: row + 1])[-1], robot)
    motor, stays, value, times = find_farthest_motor(plant.block, motors[: row + 1])
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
