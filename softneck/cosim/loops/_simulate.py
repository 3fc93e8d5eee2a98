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
from softneck.identification import find_farthest_motor
from softneck.loop import BlockPart, LoopResult, Part, StepCallback, System, check_limits, metrics, run_loop
from softneck.loop import Loop as Loop  # re-exported by the subpackage
from softneck.robot import Robot
from softneck.signals import Recording, dataset, file_unit, known_channels, table

from ._loop_file import LoopSetup, load_loop, load_ssp, make_loop

if TYPE_CHECKING:
    import pandas as pd
    import xarray  # pyright: ignore[reportMissingImports]  an extra
    from matplotlib.figure import Figure


# Rows of a run in its certificate, at equal distances: another run differs in some of them.
_TRACE_ROWS = 50


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Result(ReprMixin):
    """One simulated loop: its signals, metrics and limits.

    Attributes:
        signals: all signals, named as in a recording, with their units.
        bounds: metric -> limit, as in the loop file; that of `validity.min` is a lower one.
        wall_time: duration of the computation [s].
        files: role -> (path, SHA-256) of each file that was read.
        order: "sequential" or "jacobi".
        angle: the outputs of the metrics, "true" or "measured".
        closed: whether it was a closed loop; other systems have signals but no metrics.
        remarks: warnings, one line each, such as where the plant's model is not valid.
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
        """Return a line on the run, one on its limits, and the remarks."""
        rows, failed = self.limits, [row["metric"] for row in self.limits if not row["holds"]]
        kept = f"keeps {len(rows)} limits" if rows else "no limits stated"
        text = f"fails {', '.join(failed)}" if failed else kept
        return f"{self.signals.summary()}\n{text}" + "".join(f"\n{remark}" for remark in self.remarks)

    def __getitem__(self, name: str) -> Vector:
        """Return one signal (N,) in SI."""
        return self.signals[name]

    @property
    def robot(self) -> Robot:
        """The robot of the loop."""
        return self.signals.robot

    @property
    def metrics(self) -> dict[str, dict[str, float | None]]:
        """Rise, settling, overshoot and errors of each axis, and the use of the motors."""
        return metrics(self.signals, angle=self.angle) if self.closed else {}

    @property
    def limits(self) -> list[dict[str, Any]]:
        """For each limit of the loop: metric, limit, value, holds."""
        return check_limits(self.metrics, self.bounds)

    @property
    def holds(self) -> bool:
        """Whether there are limits, and all of them hold in a run that no part ended early."""
        return bool(self.bounds) and not self.signals.ended and all(row["holds"] for row in self.limits)

    @property
    def real_time_factor(self) -> float:
        """Simulated time divided by the duration of the computation."""
        return len(self.signals.time) * self.signals.sample_time / max(self.wall_time, 1e-9)

    @property
    def frame(self) -> pd.DataFrame:
        """All signals as a table; column names have units as in a recording's file."""
        import pandas as pd

        columns = {"time [s]": self.signals.time}
        for name, values in self.signals.signals.items():
            unit, factor = _table_unit(name, self.signals.units[name], self.robot)
            columns[f"{name} [{unit}]"] = values * factor
        return pd.DataFrame(columns)

    def to_pandas(self) -> pd.DataFrame:
        """Return all signals as a table over time [s], in SI; `attrs["units"]` has their units."""
        return table(self.signals.time, self.signals.signals, self.signals.units)

    def to_xarray(self) -> xarray.Dataset:
        """Return all signals as a Dataset over `time`, each with its unit; needs the extra `xarray`."""
        return dataset(self.signals.time, self.signals.signals, self.signals.units)

    def plot(self, title: str = "") -> Figure:
        """Return a matplotlib figure: references, outputs and motors of a closed loop, or all signals of a system."""
        from softneck.plots import chart_figure, loop_chart, signals_figure  # imports matplotlib

        time, signals = self.signals.time, self.signals.signals
        if not self.closed:
            return signals_figure(time, signals, self.signals.units, title)
        return chart_figure(loop_chart(time, signals, title, limits=self.bounds, robot=self.robot))

    def recording(self) -> Recording:
        """Return the run as a recording, with true outputs if the plant has them."""
        known = set(known_channels(self.robot))
        channels = {name: values for name, values in self.signals.signals.items() if name in known}
        for axis in self.robot.outputs.names:
            channels.setdefault(axis, self.signals.angle(axis))
        return Recording(self.signals.time, self.signals.sample_time, channels, robot=self.robot)

    def report(self) -> dict[str, Any]:
        """Return the JSON of `softneck simulate`."""
        return {"metrics": self.metrics, "limits": self.limits, "real_time_factor": self.real_time_factor}

    def trace(self) -> dict[str, list[Any]]:
        """Return some rows of the run, which identify it: row numbers, set-points and outputs.

        The keys are "row" and the robot's set-points and outputs; the values have shape (rows,), in SI, None where an
        output was not measured.
        """
        rows = np.unique(np.linspace(0, len(self.signals.time) - 1, _TRACE_ROWS).astype(int))
        kept = {name: self.signals[name] for name in self.robot.set_points}
        kept |= {axis: self.signals.angle(axis) for axis in self.robot.outputs.names}
        cells = {name: [x if np.isfinite(x) else None for x in values[rows].tolist()] for name, values in kept.items()}
        return {"row": rows.tolist(), **cells}

    def certificate(self) -> dict[str, Any]:
        """Return the certificate's JSON: limits, metrics, and the hash of every file that was read.

        Raises:
            SettingsError: the loop has no limits.
        """
        if not self.bounds:
            raise SettingsError("the loop has no [limits]: its certificate would certify nothing; add limits.")
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


def _table_unit(name: str, unit: str, robot: Robot) -> tuple[str, float]:
    """Return the unit of a signal in tables, and the factor to it."""
    try:
        to_unit, si = to_si(unit or "1")
    except DataError:
        return unit, 1.0  # an unknown unit of another tool's FMU
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
        loop: a loop, with limits as from `load_loop` or without; a loop file; an SSP archive; a system as from
            `load_ssp`; or a table with the keys of a loop file, which may hold objects (see `make_loop`) and whose
            relative paths start at the working folder.
        report: called regularly with the done fraction; default: a progress bar in a terminal.
        on_step: called after each row with a `LoopStep`; it stops the run by returning True.
        pace: run at this multiple of real time; default: as fast as possible.
        keep: leave the FMUs loaded, so that the next run of the same loop resets them; `loop.close()` frees them.
        compiled: run loops of blocks only (softneck files, the virtual neck, no FMUs) as one compiled function; the
            results are the same to the bit.

    It warns once if the plant's `validity` falls under 0.5 (`Result.remarks`).

    Raises:
        SettingsError: parts that do not fit together, or an error of `make_loop`.
        DataError: a part returned NaN or infinity.
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
        inner = None if tell is silent else lambda done: tell(done, "")
        result = run_setup(_open_loop(loop), report=inner, on_step=on_step, pace=pace, keep=keep, compiled=compiled)
    # No warning for models made by hand, without validity: `remarks` and the command mention it.
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
    """Run a loop as `simulate` does, without warnings for its remarks."""
    plain = setup if isinstance(setup, System) else setup.loop
    begin = time.perf_counter()
    signals = run_loop(plain, report, on_step=on_step, pace=pace, keep=keep, compiled=compiled)
    wall = time.perf_counter() - begin
    ended = (f"the run ended early: {signals.ended}",) if signals.ended else ()
    if isinstance(setup, System):
        return Result(signals=signals, wall_time=wall, order=plain.order, closed=False, remarks=ended)
    loop = setup.loop
    beyond = describe_excess_range(loop.controller, loop.controller_parameters, loop.robot)
    return Result(
        signals=signals,
        bounds=setup.limits,
        wall_time=wall,
        files=setup.files,
        order=plain.order,
        angle=setup.angle,
        remarks=(*ended, *([f"{beyond}."] if beyond else []), *validity_remarks(signals, loop.plant)),
    )


def _open_loop(loop: Any) -> LoopSetup | System:
    if isinstance(loop, LoopSetup | System):
        return loop
    if isinstance(loop, Loop):
        return LoopSetup(loop=loop)
    if isinstance(loop, Mapping):
        return make_loop(loop)
    if isinstance(loop, str | Path):
        return load_ssp(loop) if Path(loop).suffix == ".ssp" else load_loop(loop)
    raise SettingsError(f"`loop` must be a Loop, a loop file or a table of its keys; got a {type(loop).__name__}.")


# Below this validity the model's error is more often above its tolerance than below.
_MIN_VALIDITY = 0.5


def validity_remarks(result: LoopResult, plant: Part) -> tuple[str, ...]:
    """Return the warning for the first sample with the plant's `validity` under 0.5, and its cause; empty if none."""
    if "validity" not in result.signals:
        return ()
    validity = result["validity"]
    # Only a model without a training region has validity 0 everywhere.
    if not validity.any():
        return ("no validity in this file: identify it again; how far the plant can be trusted here is not known.",)
    doubtful = np.flatnonzero(validity < _MIN_VALIDITY)
    if not doubtful.size:
        return ()
    row = int(doubtful[0])
    return (
        f"the plant's validity falls under {_MIN_VALIDITY:g} at t = {result.time[row]:.2f} s "
        f"(least {validity.min():.2f}): {_validity_cause(result, plant, row)}.",
    )


def describe_excess_range(controller: Part, parameters: Mapping[str, float], robot: Robot) -> str:
    """Return a line if a controller may send a motor outside the range of `robot`, else "".

    A controller fits robots that differ only in limits, so it may be designed for wider ones.
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


def _validity_cause(result: LoopResult, plant: Part, row: int) -> str:
    """Return the motor outside the training region at a row, and by how much."""
    if beyond := _outside_training(result, plant, row):
        return beyond
    robot, unit = result.robot, result.robot.motors.unit
    motors = np.column_stack([result[name] for name in robot.motor_positions])
    if not isinstance(plant, BlockPart):  # an FMU tells its ranges alone
        return "its motors have a combination of values that was not in training"
    motor, stays, value, times = find_farthest_motor(plant.block, motors[: row + 1])
    what = "has been held around" if stays else "is at"
    place = f"`{robot.motor_positions[motor]}` {what} {value / to_si(unit)[0]:.3g} {unit}"
    if times <= 1.0:
        return f"{place}, a combination with the others that was not in training"
    return f"{place}, {times:.1f} times as far from its mean as most of the training"


def _outside_training(result: LoopResult, plant: Part, row: int) -> str:
    """Return the set-point farthest outside the plant's training range up to a row; "" if none is."""
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
