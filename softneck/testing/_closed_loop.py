"""The fixture `closed_loop`: run a closed loop in a user's test and check its limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softneck.core import SettingsError, atomic_write
from softneck.cosim import LoopSetup, Result, load_loop, make_loop, simulate
from softneck.loop import check_limits
from softneck.plots import chart_figure, loop_chart

# Settings that are parts of the loop, and those of its [reference].
_PART_KEYS = ("plant", "observer", "controller")
_REFERENCE_KEYS = (
    "kind",
    "pitch_deg",
    "roll_deg",
    "cocontraction_rad",
    "at_s",
    "rise_s",
    "frequency_hz",
    "inclination_deg",
)


class LimitsExceeded(AssertionError):
    """A limit does not hold; the message names metric, limit, value and the plot."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoop:
    """The value of the fixture `closed_loop`: call it to run a loop.

    `file`, `settings` and `limits` are from the markers, `plot` is the file for the plot of a failure.
    """

    folder: Path
    plot: Path
    file: Any = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)

    def __call__(self, loop_file: str | Path | None = None, **settings: Any) -> Outcome:
        """Run a loop and check the limits of the markers.

        Args:
            loop_file: of a loop; its own limits are checked too.
            settings: without a loop file, `plant`, `controller` and, if there is one, `observer` (an FMU, a softneck
                file, or a table as in a loop file), the keys of [reference] such as `pitch_deg` or `at_s` (0.5 s
                unless given), and the other keys of a loop file, such as `duration_s` (6 s) or `fault`.

        Raises:
            LimitsExceeded: a limit of a marker or of the loop file does not hold.
            SettingsError: an unknown setting.
        """
        # A file given by the test replaces file and settings of the markers.
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
    """A loop that ran in a test; `axis` is the output of limits without one."""

    result: Result
    plot: Path
    axis: str

    def holds(self, limits: Mapping[str, float] | None = None, **named: float) -> Outcome:
        """Check upper limits and return the outcome itself.

        Args:
            limits: as in a loop file, such as {"pitch.overshoot_pct": 10.0}.
            named: metrics of the stepped axis, such as overshoot_pct=10.0, or of the motors.

        Raises LimitsExceeded: a limit does not hold; the plot is saved.
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
        if key in _PART_KEYS:
            table[key] = value if isinstance(value, Mapping) else _source(key, str(value))
        elif key in _REFERENCE_KEYS:
            reference[key] = value
        elif key.partition("_")[0] in _PART_KEYS and key.endswith("_parameters"):
            continue
        else:
            table[key] = value
    for part in _PART_KEYS:
        if f"{part}_parameters" in settings and part in table:
            table[part] = {**table[part], "parameters": settings[f"{part}_parameters"]}
    return {"reference": reference, **table}


def _source(part: str, path: str) -> dict[str, str]:
    if path.endswith(".fmu"):
        return {"fmu": path}
    return {"model" if part == "plant" else "file": path}


def _axis(setup: LoopSetup) -> str:
    """Return the first output whose reference moves, or else the first."""
    names = setup.loop.robot.outputs.names
    moved = zip(names, getattr(setup.loop.reference, "values", ()), strict=False)
    return next((name for name, value in moved if value), names[0])


def _number(value: float | None) -> str:
    return "never reached" if value is None else f"{value:.4g}"
