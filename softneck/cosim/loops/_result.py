"""What a simulated loop leaves for people, programs and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, ReprMixin, SettingsError, Vector, certificate_contents, to_si
from softneck.loop import LoopResult, check_limits, metrics
from softneck.robot import Robot
from softneck.signals import Recording, dataset, file_unit, known_channels, signals_figure, table

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
