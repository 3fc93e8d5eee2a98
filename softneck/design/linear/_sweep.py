"""Judge one axis of a controller on every plant of a family, fast enough for a search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.estimation import AxisPlant
from softneck.runtime import load_functions

from ..plants._step_and_load import StepAndLoad, StepAndLoadResult, judge
from ._assembly import AxisController, ReferenceFilter

_RUNTIME = "softneck.design.linear._sweep_runtime"


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """A family of plants made ready for many runs of the bake-off.

    Attributes:
        plants: (plants, 2, order) numerators and denominators.
        delays: (plants,) [samples].
        test: what is asked.
        nominal: index of the nominal plant.
    """

    plants: Matrix
    delays: Vector
    test: StepAndLoad
    nominal: int = 0

    def run(self, axis: AxisController, reference: ReferenceFilter | float, L: Matrix) -> StepAndLoadResult:
        """Return how the axis does; equal to `run_bake_off` with the assembled controller."""
        test = self.test
        led = reference if isinstance(reference, ReferenceFilter) else ReferenceFilter(reference)
        numbers = np.array([
            test.reference, led.pole(test.sample_time), test.position_limit, test.slew_limit, test.load, test.load_row,
            led.jump,
        ])  # fmt: skip
        angles = np.zeros((self.delays.size, test.rows))
        functions: Any = load_functions(_RUNTIME)
        functions.sweep_run(
            np.ascontiguousarray(axis.A),
            np.ascontiguousarray(np.hstack([axis.Br, axis.By])),
            np.ascontiguousarray(axis.C[0]),
            np.array([axis.Dr, axis.Dy]),
            np.ascontiguousarray(L[:, 0]),
            numbers,
            self.plants,
            self.delays,
            angles,
        )
        return judge(angles, np.zeros((0, 0)), test, self.nominal)


def make_sweep(plants: Sequence[AxisPlant], *, extra_delay: int = 0, test: StepAndLoad | None = None) -> Sweep:
    """Return `plants`, the nominal one first, ready to be swept with `extra_delay` samples more."""
    asked = test or StepAndLoad(sample_time=plants[0].sample_time)
    order = max(plant.order for plant in plants)
    numbers = np.zeros((len(plants), 2, order))
    for row, plant in zip(numbers, plants, strict=True):
        row[0, : plant.order] = plant.numerator
        row[1, : plant.order] = plant.denominator[1:]
    return Sweep(numbers, np.array([float(plant.delay + extra_delay) for plant in plants]), asked)
