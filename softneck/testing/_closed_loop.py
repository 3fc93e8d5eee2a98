"""A closed loop in a user's test: run it, hold it to limits, and show what failed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softneck.core import SettingsError, atomic_write
from softneck.cosim import Result, load_loop, make_loop, simulate
from softneck.cosim.loops._loop_file import LoopSetup
from softneck.loop import check_limits
from softneck.plots import chart_figure
from softneck.plots._charts import loop_chart

# Settings of the test that are no part of a loop file, and those of its [reference].
_PARTS = ("plant", "observer", "controller")
_REFERENCE = ("kind", "pitch_deg", "roll_deg", "cocontraction_rad", "at_s", "rise_s", "frequency_hz", "inclination_deg")


class LimitsExceeded(AssertionError):
    """A limit did not hold; the message names metric, limit, value and the plot."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoop:
    """What the fixture `closed_loop` gives to a test.

    Attributes:
        folder: where relative paths start.
        plot: file of the plot that a failure leaves.
        file, settings: the defaults of the markers.
        limits: those of the markers; every loop must hold them.
    """

    folder: Path
    plot: Path
    file: Any = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, loop_file: str | Path | None = None, **settings: Any) -> Outcome:
        """Run a loop and hold it to the limits of the markers.

        Args:
            loop_file: of a loop; its own limits are held too.
            settings: without a loop file, `plant`, `controller` and, if there is one, `observer` (an FMU, a file of
                ours, or a table as in a loop file), the keys of [reference] such as `pitch_deg` or `at_s` (0.5 s
                unless given), and the other keys of a loop file, such as `duration_s` (6 s) or `fault`.

        Raises:
            LimitsExceeded: a limit of a marker or of the loop file does not hold.
            SettingsError: no such setting.
        """
        # A file that the test names itself stands for all that the markers say.
        chosen = settings if loop_file is not None else {**self.settings, **settings}
        file = loop_file if loop_file is not None else self.file
        if file is not None and chosen:
            raise SettingsError(f"give a loop file or settings, not both; got {file} and {', '.join(chosen)}.")
        setup = load_loop(self.folder / file) if file is not None else make_loop(_table(chosen), self.folder)
        outcome = Outcome(simulate(setup), self.plot, _axis(setup))
        outcome.holds({**setup.limits, **self.limits})
        return outcome


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A loop that ran in a test.

    Attributes:
        result: signals, metrics.
        plot: file of the plot that a failure leaves.
        axis: "pitch" or "roll", which a limit without an axis is about.
    """

    result: Result
    plot: Path
    axis: str

    def holds(self, limits: Mapping[str, float] | None = None, **named: float) -> Outcome:
        """Hold the loop to upper limits and return it again.

        Args:
            limits: as in a loop file, such as {"pitch.overshoot_pct": 10.0}.
            named: metrics of the stepped axis, such as overshoot_pct=10.0, or of the motors.

        Raises:
            LimitsExceeded: one does not hold; the plot is saved.
        """
        table = self.result.metrics
        wanted = {self._full(name, table): limit for name, limit in {**(limits or {}), **named}.items()}
        failed = [row for row in check_limits(table, wanted) if not row["holds"]]
        if failed:
            self._save_plot()
            lines = [f"{row['metric']} = {_number(row['value'])}, limit {row['limit']:g}" for row in failed]
            raise LimitsExceeded("\n".join([f"{len(failed)} limit(s) do not hold:", *lines, f"plot: {self.plot}"]))
        return self

    def _full(self, name: str, table: Mapping[str, Mapping[str, Any]]) -> str:
        if "." in name:
            return name
        return f"motors.{name}" if name in table["motors"] else f"{self.axis}.{name}"

    def _save_plot(self) -> None:
        signals = self.result.signals
        figure = chart_figure(loop_chart(signals.time, signals.signals, self.plot.stem, robot=signals.robot))
        self.plot.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.plot, force=True) as temporary:
            figure.savefig(temporary, format="png")


def _table(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a loop file for the settings of a test."""
    table: dict[str, Any] = {"duration_s": 6.0}
    reference: dict[str, Any] = {"kind": "step", "at_s": 0.5}
    for key, value in settings.items():
        if key in _PARTS:
            table[key] = value if isinstance(value, Mapping) else _source(key, str(value))
        elif key in _REFERENCE:
            reference[key] = value
        elif key.partition("_")[0] in _PARTS and key.endswith("_parameters"):
            continue
        else:
            table[key] = value
    for part in _PARTS:
        if f"{part}_parameters" in settings and part in table:
            table[part] = {**table[part], "parameters": settings[f"{part}_parameters"]}
    return {"reference": reference, **table}


def _source(part: str, path: str) -> dict[str, str]:
    if path.endswith(".fmu"):
        return {"fmu": path}
    return {"model" if part == "plant" else "file": path}


def _axis(setup: LoopSetup) -> str:
    reference = setup.loop.reference
    return "roll" if not getattr(reference, "pitch", 1.0) and getattr(reference, "roll", 0.0) else "pitch"


def _number(value: float | None) -> str:
    return "never reached" if value is None else f"{value:.4g}"
