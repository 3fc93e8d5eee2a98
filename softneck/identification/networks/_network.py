"""The paper's NLARX network: two hidden layers of 25 over the regressor of Eq. 21, one network for each axis."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import (
    DataError,
    FileFormatError,
    Matrix,
    Progress,
    SettingsError,
    Vector,
    one_blas_thread,
    require_between,
    require_positive,
    require_whole,
    silent,
)
from softneck.robot import Scaling
from softneck.runtime import load_functions
from softneck.signals import Recording, concatenate

from ..linear._oe import OutputError
from ..models._arrays import check_table
from ..models._directions import make_test_motions
from ..models._drive import LoadedDrive, drive_start, fit_correction, load_in_si
from ..models._fitting import SAME_EXCITATION, ScaledData, training_recording
from ..models._linear_systems import history_array
from ..models._model import Model
from ..models._regressors import eq21_table, regression, regressor_scale, spread_table
from ._nn_training import FUNCTIONS, AxisData, Best, axis_data, random_layers, train_axis

# Weight decays of the starts, from hardly any to strong smoothing; the hold-out decides between them.
_START_DECAYS = (0.03, 0.1, 0.01)
# Time of a step over simulation windows, in steps of one sample ahead.
_WINDOW_COST = 1.5
_HOLD_OUT_SHARE = 0.2
# Neurons of the paper. Of a robot whose time constant is learned, each weight needs 4 rows.
_PAPER_HIDDEN, _MIN_NEURONS, _ROWS_PER_WEIGHT = (25, 25), 4, 4
# A shorter hold-out gives no usable fit.
_MIN_HOLD_OUT_ROWS = 75
# Length of each test motion, as a share of the recording and its limits [s]: in 8 s every tendon moves alone.
_HINT_SHARE, _HINT_LIMITS_S = 1.0 / 9.0, (8.0, 15.0)
INTERRUPTED = "training was interrupted; this is the best network until then"


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Training and hold-out (`judge`) data of all networks of one fit.

    hints: test motions with the outputs of the linear model, None for none; prior: weight of their errors.
    """

    train: Recording
    judge: Recording
    drive: LoadedDrive
    table: Matrix
    hints: Recording | None
    prior: float
    has_time_constant: bool

    def training(self, axis: int) -> tuple[AxisData, Matrix, Matrix]:
        """Return the training data of an axis, with the scales of the recording without hints."""
        own, inputs, output = self.prepare(self.train, axis, None)
        if self.hints is None:
            return own, inputs, output
        weights = np.concatenate([np.ones(len(self.train)), np.full(len(self.hints), self.prior)])
        return self.prepare(concatenate([self.train, self.hints]), axis, (inputs, output), weights)

    def prepare(
        self, recording: Recording, axis: int, scale: tuple | None, weights: Vector | None = None
    ) -> tuple[AxisData, Matrix, Matrix]:
        """Return the data of an axis along logged and simulated motors; without logged ones both are simulated."""
        motors = np.concatenate([self.drive.simulate(run.set_points, drive_start(run)) for run in recording.runs()])
        if not recording.has_motor_positions:
            logged = dict(zip(recording.robot.motor_positions, motors.T, strict=True))
            recording = recording.with_channels(**logged)
        return axis_data(recording, motors, axis, self.table, self.has_time_constant, scale, weights)


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """NLARX network by Levenberg-Marquardt: series-parallel, then refined over growing simulation windows.

    Of the networks of all starts and steps, the one with the best simulation of the hold-out is kept. The hold-out is
    `hold_out`, else the last fifth of each run, which is then not trained on.

    Attributes:
        hidden: neurons of the two layers; None takes (25, 25), or of a robot whose time constant is learned as many as
            its rows determine.
        iterations: series-parallel steps of the best start; each other start takes a third.
        refine: steps over simulation windows of 1, 5 and 25 time constants, in all; 0 is the paper's training.
        starts: random starts for each axis.
        decay: weight of the squared weights, relative to the squared error of scaled outputs; None tries 0.03, 0.1
            and 0.01 in turn over the starts.
        prior: weight of errors against the linear model (`oe`) on test motions, relative to errors against the
            recording. Robots whose time constant is learned have none.
        seed: of the starting weights.
    """

    hidden: tuple[int, int] | None = None
    iterations: int = 20
    refine: int = 15
    starts: int = 5
    decay: float | None = None
    prior: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        if self.hidden is not None:
            object.__setattr__(self, "hidden", tuple(self.hidden))
            if len(self.hidden) != 2:
                raise SettingsError(f"`hidden` must be two numbers of neurons; got {self.hidden}.")
            for neurons in self.hidden:
                require_whole("hidden", neurons, 1, 1000)
        require_whole("iterations", self.iterations, 1, 100_000)
        require_whole("refine", self.refine, 0, 100_000)
        require_whole("starts", self.starts, 1, 100)
        require_whole("seed", self.seed, 0, 2**63)
        require_between("prior", self.prior, 0.0, 1.0)
        if self.decay is not None:
            require_positive("decay", self.decay)

    @one_blas_thread
    def fit(
        self, recordings: Recording | list[Recording], *, hold_out: Recording | None = None, progress: Progress = silent
    ) -> Model:
        """Train a network for each output, two at a time; Ctrl-C keeps the best so far.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            hold_out: another excitation, to choose the network by its simulation.
            progress: called with the part done and the loss and hold-out fit.

        Raises:
            DataError: too short, constant, or fewer rows than weights.
        """
        scaled = ScaledData.of(training_recording(recordings, all_motors=True))
        recording, drive = scaled.data, scaled.drive
        # The paper's lags and training suit a robot with a known time constant. If it is learned, a recording may have
        # few or many rows for it, and the simulation decides.
        table = eq21_table(recording) if scaled.has_time_constant else spread_table(recording)
        sized = self._choose_hidden(recording, table, scaled.has_time_constant)
        if hold_out is None:
            train, judge = recording.split(1.0 - _HOLD_OUT_SHARE)
            if all(len(run) < _MIN_HOLD_OUT_ROWS for run in judge.runs()):
                train, judge = recording, recording
        else:
            train, judge = recording, scaled.scale(hold_out)
        hints = _hints(train, drive) if self.prior > 0.0 and scaled.has_time_constant else None
        axes, interrupted = sized._train(
            _Problem(train, judge, drive, table, hints, self.prior, scaled.has_time_constant), progress
        )
        names = ("W1", "b1", "W2", "b2", "w3", "b3", "input_scale", "output_scale")
        stacked = {name: np.array([axis[name] for axis in axes]) for name in names}
        arrays: dict[str, Matrix] = {
            "history": history_array(int(max(table[:, 2].max(), drive.drive[:, 1].max(), 1)), len(axes)),
            "drive": drive.drive,
            "table": table,
            **stacked,
            "load": drive.load,
            "correction": np.array([axis["correction"] for axis in axes]),
        }
        findings: dict = {"hold_out_fit": [axis["fit"] for axis in axes]}
        if hold_out is None:
            findings["remark"] = SAME_EXCITATION
        if interrupted:
            findings["interrupted"] = INTERRUPTED
        progress(1.0, "done")
        return scaled.model("nn", sized, _in_si, arrays=arrays, findings=findings)

    def _choose_hidden(self, recording: Recording, table: Matrix, has_time_constant: bool) -> Network:
        """Choose the numbers of neurons; raise DataError for fewer rows than weights."""
        rows = min(regression(recording, table, axis)[1].size for axis in range(recording.outputs.shape[1]))
        hidden = self.hidden or _PAPER_HIDDEN
        if self.hidden is None and not has_time_constant:
            sizes = [(n, n) for n in range(_PAPER_HIDDEN[0], _MIN_NEURONS, -1)]
            fitting = (size for size in sizes if _ROWS_PER_WEIGHT * _weight_count(len(table), size) <= rows)
            hidden = next(fitting, (_MIN_NEURONS, _MIN_NEURONS))
        if rows < _weight_count(len(table), hidden):
            raise DataError(
                f"{rows} rows are fewer than the network's {_weight_count(len(table), hidden)} weights. "
                "Record longer or use fewer neurons."
            )
        return replace(self, hidden=hidden)

    def _train(self, problem: _Problem, progress: Progress) -> tuple[list[dict], bool]:
        """Train all axes; return their arrays, and whether Ctrl-C ended the training."""
        # (part done, text) of each axis.
        reports = [(0.0, name) for name in problem.train.robot.outputs.names]
        stop = threading.Event()
        interrupted = False
        # Compile before the threads start: Python 3.11 cannot parse two texts at once.
        load_functions(FUNCTIONS)
        with ThreadPoolExecutor(2) as pool:
            jobs = [pool.submit(self._train_axis, problem, axis, reports, stop) for axis in range(len(reports))]
            while not all(job.done() for job in jobs):
                try:
                    wait(jobs, timeout=0.1)
                    progress(*min(reports))
                except KeyboardInterrupt:
                    interrupted = True
                    stop.set()
                except BaseException:
                    stop.set()
                    raise
            return [job.result() for job in jobs], interrupted

    def _train_axis(
        self, problem: _Problem, axis: int, reports: list[tuple[float, str]], stop: threading.Event
    ) -> dict:
        name = problem.train.robot.outputs.names[axis]
        expected = self.iterations * (1.0 + self.starts / 3.0) + _WINDOW_COST * self.refine

        def report(text: str) -> None:
            # Early stops skip steps, so the part done may jump at the end.
            cost = _WINDOW_COST if text.startswith("windows") else 1.0
            reports[axis] = (min(reports[axis][0] + cost / (expected + self.starts + 4), 0.99), f"{name}: {text}")

        data, inputs, output = problem.training(axis)
        best = Best(problem.prepare(problem.judge, axis, (inputs, output))[0], report, stop.is_set)
        decays = tuple(_START_DECAYS[i % 3] if self.decay is None else self.decay for i in range(self.starts))
        hidden, rng = self.hidden or _PAPER_HIDDEN, np.random.default_rng([self.seed, axis])
        layers = train_axis(
            data, best, hidden=hidden, decays=decays, iterations=self.iterations, refine=self.refine, rng=rng
        )
        correction = fit_correction(best.hold_out.one_step_errors(layers), problem.train.sample_time)
        found = {name: getattr(layers, name) for name in ("W1", "b1", "W2", "b2", "w3", "b3")}
        return {**found, "input_scale": inputs, "output_scale": output, "correction": correction, "fit": best.free}


def _hints(train: Recording, drive: LoadedDrive) -> Recording | None:
    """Return test motions with the outputs of the linear model of `train`; None where it cannot be fitted.

    They constrain the network where nothing was recorded, where the networks of different starts differ.
    """
    try:
        linear = OutputError(nf=1, nb=1).fit(train)
    except DataError:
        return None
    seconds = float(np.clip(_HINT_SHARE * len(train) * train.sample_time, *_HINT_LIMITS_S))
    # Of a recording that hardly moves, test motions would be too slow.
    most = round(2.0 * seconds / train.sample_time)
    motions, names = [], train.robot.outputs.names
    # `identify auto` compares kinds on motions of another seed.
    for whole in make_test_motions(train, seconds, seed=1):
        motion = whole.rows(0, min(most, len(whole)))
        Y = linear.simulate(motion, warm_up=1)[:, : len(names)]
        motors = drive.simulate(motion.set_points, motion.set_points[0])
        positions = zip(train.robot.motor_positions, motors.T, strict=True) if train.has_motor_positions else ()
        motions.append(motion.with_channels(**dict(zip(names, Y.T, strict=True)), **dict(positions)))
    return concatenate(motions)


def _in_si(arrays: Mapping[str, Matrix], scaling: Scaling) -> dict[str, Matrix]:
    """Convert the arrays of a network to SI; its scaled inputs have no unit."""
    rests, units = regressor_scale(arrays["table"], scaling)
    mean, spread = arrays["input_scale"].transpose(1, 0, 2)
    middle, size = arrays["output_scale"].T
    out = scaling.output_unit
    return {
        **arrays,
        "input_scale": np.stack([rests + units * mean, units * spread], axis=1),
        "output_scale": np.stack([scaling.output_rest + out * middle, out * size], axis=1),
        "load": load_in_si(arrays["load"], scaling),
    }


def _weight_count(inputs: int, hidden: tuple[int, int]) -> int:
    return random_layers(inputs, hidden, np.random.default_rng(0)).vector().size


def check_nn(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    """Check the regressor table and the correction of a network."""
    check_table(arrays["table"], sizes)
    if (arrays["correction"] < 0).any() or (arrays["correction"] >= 1).any():
        raise FileFormatError("memory and gain of its correction must be from 0 to below 1, so that it decays.")
