"""The signals of a run on drives, one row for each sample of its loop."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import Matrix, Vector
from softneck.loop import LoopResult

from ..logs._motion import Motion
from ..logs._result import signal_units
from ..master import Master
from ._pilot import LoopPilot

_MEASURED = ("pitch_measured", "roll_measured")
_RATES = ("pitch_rate_measured", "roll_rate_measured")
_TRUTH = ("pitch", "roll", "tension_1", "tension_2", "tension_3", "compression")


class RunLog:
    """Collects one row for each sample while the controller runs."""

    def __init__(self, pilot: LoopPilot) -> None:
        """Prepare the columns."""
        self._pilot = pilot
        places = {}
        for name in ("pitch_reference", "roll_reference", "cocontraction_reference"):
            places[name] = pilot.slot("reference", name)
        for j in (1, 2, 3):
            places[f"motor_setpoint_{j}"] = pilot.slot("controller", f"motor_setpoint_{j}")
        for name in ("pitch", "roll"):
            places[f"{name}_estimate"] = pilot.slot("observer", name)
        places["healthy"] = pilot.slot("observer", "healthy")
        self._places = {name: place for name, place in places.items() if place is not None}
        self._rows: list[list[float]] = []
        self._index = -1
        self._motion, self._cycles = Motion(), list[int]()

    def take(self, now: float, master: Master, truth: Mapping[str, float] | None) -> dict[str, float] | None:
        """Take the cycle at `now` [s]; add the row of its sample, once, and return it by name."""
        self._motion.take(now, master.positions)
        if not master.ran or master.index <= self._index:
            return None
        self._index = master.index
        self._cycles.append(len(self._motion) - 1)
        signals = self._pilot.signals
        row = [float(signals[place]) for place in self._places.values()]
        tilt = master.tilt
        row += [*master.positions, *master.tensions]
        row += [tilt.pitch, tilt.roll, tilt.pitch_rate, tilt.roll_rate] if tilt is not None else [np.nan] * 4
        if truth is not None:
            row += [truth[name] for name in _TRUTH]
        self._rows.append(row)
        return dict(zip(self._names(truth is not None), row, strict=True))

    def _names(self, truth: bool) -> list[str]:
        names = [*self._places, *(f"motor_position_{j}" for j in (1, 2, 3))]
        names += [f"tension_estimate_{j}" for j in (1, 2, 3)] + [*_MEASURED, *_RATES]
        return names + (list(_TRUTH) if truth else [])

    def speeds(self) -> Matrix:
        """Return the motors' speeds at all rows, (rows, 3) [rad/s]."""
        return self._motion.at(self._cycles)[1]

    def result(self, sample_time: float, *, truth: bool) -> LoopResult:
        """Return all rows."""
        names = self._names(truth)
        table = np.array(self._rows) if self._rows else np.zeros((0, len(names)))
        signals: dict[str, Vector] = {name: table[:, i].copy() for i, name in enumerate(names)}
        return LoopResult(np.arange(len(table)) * sample_time, signals, signal_units(names), sample_time)
