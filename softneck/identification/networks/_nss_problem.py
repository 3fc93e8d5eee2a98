"""What a neural state space is trained on: inputs along simulated motors, outputs, and where a free run starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._directions import Directions
from ..models._drive import LoadedDrive, drive_start
from ..models._fitting import payload_of
from ..models._model import WARM_UP
from ..models._scores import nrmse_fit

FUNCTIONS = "softneck.identification.networks._nss_fit_runtime"
# Rows of each run in which its unknown past still shows [s]: those that `validate` does not score either.
_SETTLED = 0.5
_HOLD_OUT = 0.2
# A row is learnt from every so often [s]: a quarter of the neck's time constant.
_EVERY = 0.06
# So many equal samples at the end of its range are a sensor's limit.
_STANDS = 5
# Rows that are too few to leave any out: of every so many.
_FEW = 2000
# A record of another robot that is too short to hold rows out, in the time of a neck [s]: of 0, 7 and 15 the one that
# `benchmarks/leave_one_neck_out.py robot.whole` chooses.
_WHOLE = 15.0
# From so many runs on, runs are held out as a whole.
_MANY_RUNS = 4
# The first input of each run is held for so long before it [s]: then the start is forgotten.
_HELD = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """What inputs and outputs are divided by, and what outputs are above.

    Attributes:
        rest: (p,) what the inputs are above; zero for a neck.
        inputs: (p,) of the redefined inputs and their plays [rad].
        middle, outputs: (outputs,) of the outputs [rad].
    """

    rest: Vector
    inputs: Vector
    middle: Vector
    outputs: Vector


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """What makes a map's inputs of set-points.

    Attributes:
        drive: simulates the motors.
        directions: of the robot.
        redefinition: (channels, motors) T of Eq. 9-11.
        widths: half-widths of the play operators [rad].
        delay: of the inputs [samples].
        loaded: the payload is an input as well, alone and times each other (see `_loaded_nss_runtime`).
    """

    drive: LoadedDrive
    directions: Directions
    redefinition: Matrix
    widths: Vector
    delay: int
    loaded: bool = False


def sensor_limits(recording: Recording) -> Matrix:
    """Return the least and largest that each sensor shows, (outputs, 2); infinite where it has not stood at either.

    A tank that is full and an arm at its stop repeat one value for many samples; what goes on behind it is not seen.
    """
    limits = np.array([[-np.inf, np.inf]] * recording.outputs.shape[1])
    if recording.robot.is_neck:
        return limits
    for axis, y in enumerate(recording.outputs.T):
        for side, value in enumerate((np.nanmin(y), np.nanmax(y))):
            stands = np.convolve(y == value, np.ones(_STANDS), "valid")
            if stands.max() >= _STANDS and np.ptp(y) > 0.0:
                limits[axis, side] = value
    return limits


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """Scaled inputs and outputs of all runs behind each other, each with its first input held before it.

    Attributes:
        inputs: (time, p).
        outputs: (time, outputs), NaN where missed or held.
        first: (time,) whether a run begins here, with what is held before it.
        settled: (time,) rows to learn from and to judge.
        own: (time,) rows that the recording has.
        told: (time, outputs) outputs that correct the state of a free run, NaN where none: as in use until the warm-up
            is over; nowhere for a neck, whose start is soon forgotten.
        limits: (outputs, 2) between which the sensors show anything; infinite for a neck.
        scales: of both.
        sample_time: in the time of a neck [s]: by the time constant over the neck's.
    """

    inputs: Matrix
    outputs: Matrix
    first: np.ndarray
    settled: np.ndarray
    own: np.ndarray
    told: Matrix
    limits: Matrix
    scales: Scales
    sample_time: float

    @classmethod
    def of(
        cls,
        recording: Recording,
        made: Inputs,
        *,
        scales: Scales | None = None,
        logged: bool = False,
    ) -> Records:
        """Return the records of a recording.

        Args:
            recording: its runs are never joined.
            made: how inputs are made.
            scales: of another recording; None takes its own.
            logged: take logged motors where there are any.
        """
        sample_time = recording.sample_time / made.directions.stretch
        held = round(_HELD / sample_time)
        # Of another robot what `validate` does not score either.
        border = round(_SETTLED / sample_time) if recording.robot.is_neck else WARM_UP
        functions, T, widths = load_functions(FUNCTIONS), made.redefinition, made.widths
        inputs, outputs, first, settled, own, told = [], [], [], [], [], []
        for run in recording.runs():
            motors = made.drive.simulate(run.set_points, drive_start(run))
            if logged:
                motors = np.where(np.isfinite(run.motor_positions), run.motor_positions, motors)
            motors = np.vstack([np.repeat(motors[:1], held + made.delay, axis=0), motors])[: held + len(run)]
            V = np.empty((len(motors), len(T) * (1 + widths.size)))
            functions.nss_signals(T, widths, motors, V)
            if made.loaded:
                payload = payload_of(run)
                V = np.column_stack([V, payload * V, np.full(len(V), payload)])
            since = np.arange(len(V)) - held
            Y = np.vstack([np.full((held, run.outputs.shape[1]), np.nan), run.outputs])
            inputs.append(V)
            outputs.append(Y)
            first.append(since == -held)
            settled.append((since >= border) & np.isfinite(Y).any(axis=1))
            own.append(since >= 0)
            known = np.where((since < (0 if recording.robot.is_neck else WARM_UP))[:, None], Y, np.nan)
            known[:held] = np.nan if recording.robot.is_neck else run.outputs[0]
            told.append(known)
        V, Y, there = np.concatenate(inputs), np.concatenate(outputs), np.concatenate(own)
        if scales is None:
            mean, spread = V[there].mean(axis=0), np.maximum(V[there].std(axis=0), 1e-3)
            rest = np.zeros_like(mean) if recording.robot.is_neck else mean
            scales = Scales(rest, spread, np.nanmean(Y, axis=0), np.nanstd(Y, axis=0))
        return cls(
            (V - scales.rest) / scales.inputs,
            (Y - scales.middle) / scales.outputs,
            np.concatenate(first),
            np.concatenate(settled),
            there,
            (np.concatenate(told) - scales.middle) / scales.outputs,
            (sensor_limits(recording) - scales.middle[:, None]) / scales.outputs[:, None],
            scales,
            sample_time,
        )

    @property
    def held_out(self) -> np.ndarray:
        """(time,) the last fifth of each run; of many runs the last fifth of the runs."""
        number = np.cumsum(self.first) - 1
        count = int(number[-1]) + 1
        if count >= _MANY_RUNS:
            return number >= count - max(round(_HOLD_OUT * count), 1)
        # What is held before a run has a part in a neck's.
        held = [0 if np.isnan(self.told).all() else int((~self.own[number == run]).sum()) for run in range(count)]
        sizes = np.bincount(number)
        masks = [np.arange(n) >= h + (1.0 - _HOLD_OUT) * (n - h) for n, h in zip(sizes, held, strict=True)]
        return np.concatenate(masks)

    @property
    def learnt(self) -> np.ndarray:
        """The numbers of the rows that are learnt from, so often; of other robots all where there are few."""
        rows, often = np.flatnonzero(self.settled), round(_EVERY / self.sample_time)
        return rows[:: max(often if np.isnan(self.told).all() else min(often, rows.size // _FEW), 1)]

    def apart(self) -> tuple[Records, Records]:
        """Return what to learn from and what to choose by; of another robot both are all rows where it is slow.

        A fifth of few time constants is one event or none: it chooses among starts by chance, and the rest lacks it.
        """
        if not np.isnan(self.told).all() and self.settled.sum() * self.sample_time < _WHOLE:
            return self, self
        return self.only(~self.held_out), self.only(self.held_out)

    def only(self, rows: np.ndarray) -> Records:
        """Return the same free runs, of which only `rows` (time,) are learnt from or judged."""
        return replace(self, settled=self.settled & rows)

    def fit(self, Y: Matrix) -> float:
        """Return the mean fit [%] of all axes of free runs `Y` (time, outputs); one worse than the mean's counts 0.

        An axis that drifts, which no input explains, does not decide what the other one becomes.
        """
        y, free = self.outputs[self.settled], np.clip(Y[self.settled], self.limits[:, 0], self.limits[:, 1])
        return float(np.mean([max(nrmse_fit(y[:, axis], free[:, axis]), 0.0) for axis in range(y.shape[1])]))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Numbers of states, inputs, neurons and outputs, and where weights stand (see `_nss_fit_runtime`)."""

    states: int
    inputs: int
    neurons: int
    outputs: int

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array, in their order."""
        n, p, q, m = self.states, self.inputs, self.neurons, self.outputs
        return {
            "A": (n, n), "B": (n, p), "E": (n, q), "F": (q, n), "G": (q, p), "h": (q,), "D": (q, q), "C": (m, n),
            "c": (m,),
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


def free_run(shape: Shape, w: Vector, records: Records, gain: Matrix) -> tuple[Matrix, Matrix]:
    """Return scaled outputs (time, outputs) and states (time, n) of free runs, told what they are at the start."""
    return _run(shape, w, records, gain, records.told, np.zeros((1, shape.outputs)))


def observed(shape: Shape, w: Vector, records: Records, gain: Matrix) -> Matrix:
    """Return the states (time, n), each corrected by `gain` (n, outputs) times the error of the output."""
    return _run(shape, w, records, gain, records.outputs, np.zeros((1, shape.outputs)))[1]


def _run(
    shape: Shape, w: Vector, records: Records, gain: Matrix, measured: Matrix, none: Matrix
) -> tuple[Matrix, Matrix]:
    Y, seen = np.empty((len(records.inputs), shape.outputs)), np.empty((len(records.inputs), shape.states))
    load_functions(FUNCTIONS).nss_free(
        w, shape.states, shape.neurons, records.inputs, records.first.astype(np.int64), none, gain, measured, seen, Y
    )
    return Y, seen
