"""Neural state space with play operators: contracting, started from the linear output-error model."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import DataError, FileFormatError, Matrix, Progress, require_positive, require_whole, silent
from softneck.core._blas_threads import one_blas_thread
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._arrays import check_payloads, memory_array, within
from ..models._directions import directions_of
from ..models._drive import BEYOND, drive_start, fit_echo, fit_loaded_drive
from ..models._fitting import SAME_EXCITATION, fitted_model, payload_of, training_recording
from ..models._model import Model
from ..models._state_space import history_array
from ._nss_problem import FUNCTIONS, Inputs, Records, Shape, free_run, sensor_limits
from ._nss_training import (
    BestMap,
    Contraction,
    Training,
    largest_rate,
    linear_start,
    random_start,
    train_start,
    whitened,
)

# Steps of each start over windows of 1 sample, 0.2, 1 and 5 s; the whole free run takes what `iterations` says.
_WINDOW_STEPS = (3, 3, 5, 5)
# A held input is forgotten after this [s]: three times the slowest that the contraction allows.
_MEMORY = 15.0
_ECHO = 8
# y is kept within the range of the training outputs, widened by half of it to either side.
_BEYOND = 0.5
INTERRUPTED = "training was interrupted; this is the best model until then"


@dataclass(frozen=True, slots=True, kw_only=True)
class NeuralStateSpace:
    """Neural state space over the simulated motors and play operators of them, by the error of its free run.

    It contracts, whatever its weights: two free runs under the same inputs draw together. Each start is the
    output-error linear model with whitened states and neurons that do nothing yet, trained by Levenberg-Marquardt with
    exact sensitivities over windows from one sample to 5 s and then over the whole free run. The start with the best
    free run on the hold-out (`hold_out`, else the last fifth of each run; of another robot than a neck all rows where
    they last less than 75 time constants) goes on, at last on all rows.

    Attributes:
        order: poles of the linear model of each axis; each input that moves none (co-contraction) has a state more.
        neurons: tanh neurons, each of which sees the states, the inputs and the neurons before it.
        widths: half-widths of the play operators [rad].
        starts: random starts.
        iterations: steps of each start over the whole free run; the best one takes twice as many on top.
        decay: weight of the squared distance from the linear model beside the squared errors of scaled outputs.
        echo: past errors that correct a prediction where outputs are measured.
        seed: of the starts.
    """

    order: int = 2
    neurons: int = 8
    widths: tuple[float, ...] = (0.3,)
    starts: int = 4
    iterations: int = 20
    decay: float = 0.01
    echo: int = _ECHO
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", tuple(self.widths))
        for width in self.widths:
            require_positive("widths", width, "rad")
        require_whole("order", self.order, 1, 10)
        require_whole("neurons", self.neurons, 1, 200)
        require_whole("starts", self.starts, 1, 100)
        require_whole("iterations", self.iterations, 1, 100_000)
        require_positive("decay", self.decay)
        require_whole("echo", self.echo, 1, 100)
        require_whole("seed", self.seed, 0, 2**63)

    @one_blas_thread
    def fit(
        self,
        recordings: Recording | list[Recording],
        *,
        hold_out: Recording | None = None,
        progress: Progress = silent,
    ) -> Model:
        """Identify all axes, two starts at a time; Ctrl-C keeps the best so far.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            hold_out: another excitation, on whose free run to choose.
            progress: called with the part done and the loss and hold-out fit.

        Raises:
            DataError: too short, constant, or fewer rows than weights.
        """
        recording = training_recording(recordings, all_motors=True)
        progress(0.0, "drives and linear model")
        drive = fit_loaded_drive(recording)
        directions = directions_of(recording, [drive.simulate(r.set_points, drive_start(r)) for r in recording.runs()])
        fits, delay = linear_start(recording, drive, directions, self.order)
        loads = [payload_of(run) for run in recording.runs()] if recording.robot.is_neck else [0.0]
        made = Inputs(
            drive, directions, directions.inputs(recording), np.array(self.widths), delay, len(set(loads)) > 1
        )
        records = Records.of(recording, made)
        shape, linear, gain = whitened(fits, records, made, self.neurons)
        contraction = Contraction(shape.states, self.neurons, largest_rate(records.sample_time))
        self._check_rows(records, shape)
        rows, judge = records.apart()
        if hold_out is not None:
            rows, judge = records, Records.of(hold_out, made, scales=records.scales)
        job = _Job(self, shape, contraction, gain, shape.arrays(linear), records, rows, judge)
        theta, found = job.run(progress)
        weights = shape.arrays(job.weights(theta))
        arrays = _arrays(recording, made, records, weights, (self.echo, gain))
        if made.loaded:
            arrays["payload"] = np.array([min(loads), max(loads)])
        findings: dict[str, Any] = {"delay": delay, "parameters": theta.size, **found}
        if not recording.robot.is_neck:
            findings |= directions.findings()
        if hold_out is None:
            findings["remark"] = SAME_EXCITATION
        progress(1.0, "done")
        return fitted_model("nss", self, recording, arrays=arrays, findings=findings)

    def _check_rows(self, records: Records, shape: Shape) -> None:
        rows = int(records.settled.sum())
        if 2 * rows < shape.vector_size:
            raise DataError(
                f"{rows} settled rows are too few for {shape.vector_size} weights; record longer or take fewer neurons."
            )


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """All starts of one fit."""

    settings: NeuralStateSpace
    shape: Shape
    contraction: Contraction
    gain: Matrix
    linear: dict[str, Matrix]
    records: Records
    rows: Records
    judge: Records

    def run(self, progress: Progress) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the parameters to take, and what there is to say about them."""
        settings, stop = self.settings, threading.Event()
        load_functions(FUNCTIONS)  # before the threads start: Python 3.11 cannot parse two texts at once
        total = settings.starts * (sum(_WINDOW_STEPS) + settings.iterations + 5) + 2 * settings.iterations
        told = _TrainingProgress(total)
        jobs: list[tuple[Training, np.ndarray, BestMap]] = []
        for number in range(settings.starts):
            rng = np.random.default_rng([settings.seed, number])
            theta, base = random_start(self.linear, self.shape, self.contraction, rng)
            training = Training(self.shape, self.contraction, self.gain, self.rows, settings.decay, base)
            jobs.append((training, theta, BestMap(self.judge, told.see, stop.is_set)))
        steps = (*_WINDOW_STEPS, settings.iterations)

        def start(number: int) -> None:
            training, theta, best = jobs[number]
            train_start(training, theta, best, steps, f"start {number + 1}")

        interrupted = _wait(start, range(settings.starts), told, progress, stop)
        fits = [best.fit for _, _, best in jobs]
        number = int(np.argmax(fits))
        training, theta, best = jobs[number]
        if best.theta is None or not np.isfinite(best.fit):
            raise DataError("no start has a finite error on the hold-out; look for wild values in the recording.")
        theta = best.theta
        if not interrupted:
            theta, interrupted = self._finish(training, best, told, progress, stop)
        judged = "training_fit" if self.judge is self.rows else "hold_out_fit"
        found: dict[str, Any] = {judged: best.fit, "start_fits": fits}
        return theta, found | ({"interrupted": INTERRUPTED} if interrupted else {})

    def _finish(
        self, training: Training, best: BestMap, told: _TrainingProgress, progress: Progress, stop: threading.Event
    ) -> tuple[np.ndarray, bool]:
        """Train the best start on, at last on all rows."""
        steps = self.settings.iterations
        ends: list[np.ndarray] = []

        def go_on(_: int) -> None:
            training.search(_known(best), None, steps, best, "best start")
            everything = replace(training, records=self.records)
            after = BestMap(self.judge, told.see, stop.is_set)
            ends.append(everything.search(_known(best), None, steps, after, "all rows"))

        interrupted = _wait(go_on, range(1), told, progress, stop)
        return (_known(best) if interrupted or not ends else ends[0]), interrupted

    def weights(self, theta: np.ndarray) -> np.ndarray:
        """Return the map's weights."""
        training = Training(self.shape, self.contraction, self.gain, self.records, 0.0, theta)
        return training.weights(theta)


class _TrainingProgress:
    """What the threads say of themselves."""

    def __init__(self, expected: int) -> None:
        self.expected, self.count, self.what = expected, 0, "starts"

    def see(self, what: str) -> None:
        """Take note of one step."""
        self.count += 1
        self.what = what


def _known(best: BestMap) -> np.ndarray:
    if best.theta is None:
        raise DataError("training was interrupted before its first step.")
    return best.theta


def _wait(work: Any, numbers: range, told: _TrainingProgress, progress: Progress, stop: threading.Event) -> bool:
    """Do `work` for all numbers, two at a time; return whether Ctrl-C ended it."""
    interrupted = False
    with ThreadPoolExecutor(2) as pool:
        jobs: list[Future] = [pool.submit(work, number) for number in numbers]
        while not all(job.done() for job in jobs):
            try:
                wait(jobs, timeout=0.1)
                progress(min(told.count / told.expected, 0.99), told.what)
            except KeyboardInterrupt:
                interrupted = True
                stop.set()
            except BaseException:
                stop.set()
                raise
        for job in jobs:
            job.result()
    return interrupted


def _arrays(
    recording: Recording, made: Inputs, trained: Records, weights: dict[str, Matrix], feedback: tuple[int, Matrix]
) -> dict[str, Matrix]:
    """Return what the runtime reads, scales and all."""
    shape = Shape(len(weights["A"]), weights["B"].shape[1], weights["h"].size, len(weights["C"]))
    scales, drive = trained.scales, made.drive
    order, gain = feedback
    seen = recording.outputs[np.isfinite(recording.outputs).all(axis=1)]
    lowest, highest = seen.min(axis=0), seen.max(axis=0)
    wider = _BEYOND * (highest - lowest)
    limits = np.column_stack([lowest - wider, highest + wider])
    B, G = weights["B"] / scales.inputs, weights["G"] / scales.inputs
    standing = sensor_limits(recording)
    limits = np.where(np.isfinite(standing), standing, limits)
    # The map was trained around the inputs' means: about zero its states, and what reads them, are shifted.
    x = np.linalg.solve(np.eye(shape.states) - weights["A"], B @ scales.rest)
    arrays = {
        "history": history_array(int(max(order, drive.drive[:, 1].max(), made.delay + 1)), shape.outputs),
        "drive": drive.drive,
        "load": drive.load,
        "redefinition": made.redefinition,
        "widths": made.widths,
        "delay": np.array([float(made.delay)]),
        **weights,
        "B": B,
        "G": G,
        "h": weights["h"] - weights["F"] @ x - G @ scales.rest,
        "C": weights["C"] * scales.outputs[:, None],
        "c": scales.middle + scales.outputs * (weights["c"] - weights["C"] @ x),
        "range": limits,
        "echo": np.zeros((shape.outputs, 1)),
        "memory": memory_array(_MEMORY, trained.sample_time),
    }
    if not recording.robot.is_neck:
        return {**arrays, "gain": gain / scales.outputs}
    # What is measured beside the outputs are the motors: the errors of one step are those along them.
    records = Records.of(recording, made, scales=scales, logged=True)
    Y, _ = free_run(shape, shape.vector(weights), records, gain)
    free = np.clip(scales.middle + scales.outputs * Y, limits[:, 0], limits[:, 1])
    errors = np.where(records.settled[:, None], scales.middle + scales.outputs * records.outputs - free, np.nan)
    runs = np.split(errors, np.flatnonzero(records.first)[1:])
    echo = np.array([fit_echo([run[:, axis] for run in runs], order, beyond=BEYOND) for axis in range(shape.outputs)])
    return {**arrays, "echo": echo}


def check_nss(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(arrays["delay"], 0, sizes["H"] - 1, "a dead time")
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")
    if np.abs(np.linalg.eigvals(arrays["A"])).max(initial=0.0) >= 1.0:
        raise FileFormatError("its linear part is not stable, so that a free run could diverge.")
    if "payload" in arrays:
        check_payloads(*arrays["payload"])
