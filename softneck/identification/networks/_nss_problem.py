"""What a neural state space is trained on: inputs along simulated motors, outputs, and where a free run starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions
from softneck.signals import TENDON_ANGLES, Recording, redefinition_matrix

from ..models._drive import LoadedDrive, drive_start
from ..models._scores import nrmse_fit

FUNCTIONS = "softneck.identification.networks._nss_fit_runtime"
# Rows of each run in which its unknown past still shows [s]: those that `validate` does not score either.
_SETTLED = 0.5
_HOLD_OUT = 0.2
# From so many runs on, runs are held out as a whole.
_MANY_RUNS = 4
# The first input of each run is held for so long before it [s]: then the start is forgotten.
_HELD = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """What inputs and outputs are divided by, and what outputs are above.

    Attributes:
        inputs: (p,) of the redefined inputs and their plays [rad].
        middle, outputs: (2,) of pitch and roll [rad].
    """

    inputs: Vector
    middle: Vector
    outputs: Vector


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """Scaled inputs and outputs of all runs behind each other, each with its first input held before it.

    Attributes:
        inputs: (time, p).
        outputs: (time, 2), NaN where missed or held.
        first: (time,) whether a run begins here, with what is held before it.
        settled: (time,) rows to learn from and to judge.
        own: (time,) rows that the recording has.
        scales: of both.
        sample_time: [s].
    """

    inputs: Matrix
    outputs: Matrix
    first: np.ndarray
    settled: np.ndarray
    own: np.ndarray
    scales: Scales
    sample_time: float

    @classmethod
    def of(
        cls,
        recording: Recording,
        drive: LoadedDrive,
        widths: Vector,
        delay: int,
        *,
        scales: Scales | None = None,
        logged: bool = False,
    ) -> Records:
        """Return the records of a recording.

        Args:
            recording: its runs are never joined.
            drive: simulates the motors.
            widths: half-widths of the play operators [rad].
            delay: of the inputs [samples].
            scales: of another recording; None takes its own.
            logged: take logged motors where there are any.
        """
        held, border = round(_HELD / recording.sample_time), round(_SETTLED / recording.sample_time)
        functions, T = load_functions(FUNCTIONS), redefinition_matrix(TENDON_ANGLES)
        inputs, outputs, first, settled, own = [], [], [], [], []
        for run in recording.runs():
            motors = drive.simulate(run.set_points, drive_start(run))
            if logged:
                motors = np.where(np.isfinite(run.motor_positions), run.motor_positions, motors)
            motors = np.vstack([np.repeat(motors[:1], held + delay, axis=0), motors])[: held + len(run)]
            V = np.empty((len(motors), 3 * (1 + widths.size)))
            functions.nss_signals(T, widths, motors, V)
            since = np.arange(len(V)) - held
            Y = np.vstack([np.full((held, 2), np.nan), run.outputs])
            inputs.append(V)
            outputs.append(Y)
            first.append(since == -held)
            settled.append((since >= border) & np.isfinite(Y).any(axis=1))
            own.append(since >= 0)
        V, Y, there = np.concatenate(inputs), np.concatenate(outputs), np.concatenate(own)
        if scales is None:
            scales = Scales(np.maximum(V[there].std(axis=0), 1e-3), np.nanmean(Y, axis=0), np.nanstd(Y, axis=0))
        return cls(
            V / scales.inputs,
            (Y - scales.middle) / scales.outputs,
            np.concatenate(first),
            np.concatenate(settled),
            there,
            scales,
            recording.sample_time,
        )

    @property
    def held_out(self) -> np.ndarray:
        """(time,) the last fifth of each run; of many runs the last fifth of the runs."""
        number = np.cumsum(self.first) - 1
        count = int(number[-1]) + 1
        if count >= _MANY_RUNS:
            return number >= count - max(round(_HOLD_OUT * count), 1)
        masks = [np.arange(n) >= (1.0 - _HOLD_OUT) * n for n in np.bincount(number)]
        return np.concatenate(masks)

    def only(self, rows: np.ndarray) -> Records:
        """Return the same free runs, of which only `rows` (time,) are learnt from or judged."""
        return replace(self, settled=self.settled & rows)

    def fit(self, Y: Matrix) -> float:
        """Return the mean fit [%] of both axes of free runs `Y` (time, 2); one worse than the mean's counts 0.

        An axis that drifts, which no input explains, does not decide what the other one becomes.
        """
        y = self.outputs[self.settled]
        return float(np.mean([max(nrmse_fit(y[:, axis], Y[self.settled, axis]), 0.0) for axis in range(2)]))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Numbers of states, inputs and neurons, and where weights stand (see `_nss_fit_runtime`)."""

    states: int
    inputs: int
    neurons: int

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array, in their order."""
        n, p, q = self.states, self.inputs, self.neurons
        return {
            "A": (n, n), "B": (n, p), "E": (n, q), "F": (q, n), "G": (q, p), "h": (q,), "D": (q, q), "C": (2, n),
            "c": (2,),
        }  # fmt: skip

    @property
    def vector_size(self) -> int:
        """Number of weights."""
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def columns(self, J: Matrix) -> dict[str, Matrix]:
        """Return the columns of `J` (rows, weights) that belong to each array."""
        edges = np.cumsum([0, *(int(np.prod(shape)) for shape in self.shapes.values())])
        return {name: J[:, a:b] for name, a, b in zip(self.shapes, edges[:-1], edges[1:], strict=True)}

    def vector(self, arrays: Mapping[str, Matrix]) -> Vector:
        """Return the weights behind each other."""
        return np.concatenate([arrays[name].ravel() for name in self.shapes])

    def arrays(self, w: Vector) -> dict[str, Matrix]:
        """Return the weights as arrays."""
        sizes = [int(np.prod(shape)) for shape in self.shapes.values()]
        parts = np.split(w, np.cumsum(sizes)[:-1])
        return {name: part.reshape(shape) for (name, shape), part in zip(self.shapes.items(), parts, strict=True)}


def free_run(shape: Shape, w: Vector, records: Records) -> tuple[Matrix, Matrix]:
    """Return scaled outputs (time, 2) and states (time, n) of free runs."""
    none = np.zeros((1, 2))
    return _run(shape, w, records, np.zeros((shape.states, 2)), np.full_like(records.outputs, np.nan), none)


def observed(shape: Shape, w: Vector, records: Records, gain: Matrix) -> Matrix:
    """Return the states (time, n), each corrected by `gain` (n, 2) times the error of the output."""
    return _run(shape, w, records, gain, records.outputs, np.zeros((1, 2)))[1]


def _run(
    shape: Shape, w: Vector, records: Records, gain: Matrix, measured: Matrix, none: Matrix
) -> tuple[Matrix, Matrix]:
    Y, seen = np.empty((len(records.inputs), 2)), np.empty((len(records.inputs), shape.states))
    load_functions(FUNCTIONS).nss_free(
        w, shape.states, shape.neurons, records.inputs, records.first.astype(np.int64), none, gain, measured, seen, Y
    )
    return Y, seen
