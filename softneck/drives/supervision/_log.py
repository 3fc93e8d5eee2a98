"""Undisturbed motion, gathered while an experiment runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ._motor_models import Motion


class MotionLog:
    """Called after each cycle of a run, as all who watch one are."""

    def __init__(self) -> None:
        """Hold nothing yet."""
        self._rows: list[tuple[tuple[float, ...], ...]] = []
        self._sent: tuple[float, ...] | None = None
        self._asked: tuple[float, ...] = ()
        self._outputs = 0

    def __call__(self, _now: float, _in: Sequence[Any], _out: Sequence[Any], sample: Any, master: Any) -> None:
        """Take one cycle; `sample` is what the sensor said."""
        # The step that is over has counted itself already.
        due = (master.cycle - 1) % master.settings.sample_cycles == 0
        values, rates = (), ()
        if sample is not None and sample.valid:
            values, rates = sample.values, sample.rates
        self._outputs = max(self._outputs, len(values))
        if self._sent is not None and master.supervisor.phase == "running":
            row = (self._sent, master.positions, master.tensions, values, rates, (float(due),), self._asked)
            self._rows.append(row)
        self._sent, self._asked = master.setpoints, master.reference

    def motion(self) -> Motion:
        """Return what was gathered."""
        none = (math.nan,) * self._outputs
        columns = [[row[k] or none for row in self._rows] for k in range(7)]
        arrays = [np.array(column, dtype=np.float64) for column in columns]
        s, p, tension, values, rates, due, asked = arrays
        return Motion(
            setpoints=s, positions=p, tensions=tension, values=values, rates=rates, due=due[:, 0] > 0.5,
            references=asked if np.isfinite(asked).any() else None,
        )  # fmt: skip
