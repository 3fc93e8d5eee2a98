"""The paper's NLARX network: two hidden layers of 25 over the regressor of Eq. 21, one network for each axis."""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, Progress, SettingsError, require_positive, require_whole, silent
from softneck.runtime import load_functions
from softneck.signals import Recording

from ..models._drive import LoadedDrive, drive_start, fit_loaded_drive
from ..models._error_feedback import fit_correction
from ..models._fitting import SAME_EXCITATION, fitted_model, training_recording
from ..models._model import Model
from ..models._regressors import PAPER_EQ21, regression
from ._levenberg import Layers, random_layers
from ._nn_training import FUNCTIONS, AxisData, Best, axis_data, train_axis

# Of the starts: from hardly any to one that smooths; the hold-out decides between them.
_DECAYS = (0.03, 0.1, 0.01)
_HOLD_OUT = 0.2
# A hold-out shorter than this says nothing [rows].
_LEAST = 75
INTERRUPTED = "training was interrupted; this is the best network until then"


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """NLARX network by Levenberg-Marquardt: series-parallel, then refined over growing windows of free run.

    Several starts, stopped early; of all networks seen on the way that with the best free run on the hold-out is
    kept: on `hold_out`, else on the last fifth of each run, which is then not trained on.

    Attributes:
        hidden: neurons of the two layers.
        iterations: series-parallel steps of the best start; each other start takes a third.
        refine: steps over windows of 0.2, 1 and 5 s of free run, all together; 0 leaves the paper's training.
        starts: random starts for each axis.
        decay: weight of the squared weights beside the squared error of scaled outputs; None tries 0.03, 0.1 and
            0.01 in turn over the starts.
        seed: of the starting weights.
    """

    hidden: tuple[int, int] = (25, 25)
    iterations: int = 30
    refine: int = 24
    starts: int = 3
    decay: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(self.hidden))
        if len(self.hidden) != 2:
            raise SettingsError(f"`hidden` must be two numbers of neurons; got {self.hidden}.")
        for neurons in self.hidden:
            require_whole("hidden", neurons, 1, 1000)
        require_whole("iterations", self.iterations, 1, 100_000)
        require_whole("refine", self.refine, 0, 100_000)
        require_whole("starts", self.starts, 1, 100)
        require_whole("seed", self.seed, 0, 2**63)
        if self.decay is not None:
            require_positive("decay", self.decay)

    def fit(
        self,
        recordings: Recording | list[Recording],
        *,
        hold_out: Recording | None = None,
        progress: Progress = silent,
    ) -> Model:
        """Train both networks, one on each core; Ctrl-C keeps the best so far.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            hold_out: another excitation, on whose free run to choose.
            progress: called with the part done and the loss and hold-out fit.

        Raises:
            DataError: too short, constant, or fewer rows than weights.
        """
        recording = training_recording(recordings)
        self._check_rows(recording)
        drive = fit_loaded_drive(recording)
        train, judge = recording, hold_out
        if judge is None:
            train, judge = recording.split(1.0 - _HOLD_OUT)
            if all(len(run) < _LEAST for run in judge.runs()):
                train, judge = recording, recording
        axes, interrupted = self._train(train, judge, drive, progress)
        names = ("W1", "b1", "W2", "b2", "w3", "b3", "input_scale", "output_scale")
        stacked = {name: np.array([axis[name] for axis in axes]) for name in names}
        arrays: dict[str, Matrix] = {
            "history": np.array([float(max(PAPER_EQ21[:, 2].max(), drive.drive[:, 1].max(), 1))]),
            "drive": drive.drive,
            "table": PAPER_EQ21,
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
        return fitted_model("nn", self, recording, arrays=arrays, findings=findings)

    def _check_rows(self, recording: Recording) -> None:
        rows = min(regression(recording, PAPER_EQ21, axis)[1].size for axis in range(2))
        weights = random_layers(len(PAPER_EQ21), self.hidden, np.random.default_rng(0)).vector().size
        if rows < weights:
            raise DataError(
                f"{rows} rows are fewer than the network's {weights} weights. Record longer or use fewer neurons."
            )

    def _train(
        self, train: Recording, judge: Recording, drive: LoadedDrive, progress: Progress
    ) -> tuple[list[dict], bool]:
        """Return the arrays of both axes, and whether Ctrl-C ended it."""
        from threadpoolctl import threadpool_limits

        told = [(0.0, "pitch"), (0.0, "roll")]
        stop = threading.Event()
        interrupted = False
        # Before the threads start: Python 3.11 cannot parse two texts at once.
        load_functions(FUNCTIONS)
        # One thread each: matrices this small gain nothing from more.
        with threadpool_limits(limits=1), ThreadPoolExecutor(2) as pool:
            jobs = [pool.submit(self._axis, train, judge, drive, axis, told, stop) for axis in range(2)]
            while not all(job.done() for job in jobs):
                try:
                    _report(jobs, told, progress)
                except KeyboardInterrupt:
                    interrupted = True
                    stop.set()
                except BaseException:
                    stop.set()
                    raise
            return [job.result() for job in jobs], interrupted

    def _axis(
        self,
        train: Recording,
        judge: Recording,
        drive: LoadedDrive,
        axis: int,
        told: list[tuple[float, str]],
        stop: threading.Event,
    ) -> dict:
        name = ("pitch", "roll")[axis]
        expected = self.iterations * (1.0 + self.starts / 3.0) + self.refine

        def tell(what: str) -> None:
            # Early stops leave steps out: it may jump at the end, never fall.
            told[axis] = (min(told[axis][0] + 1.0 / (expected + self.starts + 4), 0.99), f"{name}: {what}")

        data, inputs, output = _prepared(train, drive, axis, None)
        best = Best(_prepared(judge, drive, axis, (inputs, output))[0], tell, stop.is_set)
        decays = tuple(_DECAYS[i % 3] if self.decay is None else self.decay for i in range(self.starts))
        layers: Layers = train_axis(
            data, best, hidden=self.hidden, decays=decays, iterations=self.iterations, refine=self.refine,
            rng=np.random.default_rng([self.seed, axis]),
        )  # fmt: skip
        correction = fit_correction(best.hold_out.one_step_errors(layers), train.sample_time)
        found = {name: getattr(layers, name) for name in ("W1", "b1", "W2", "b2", "w3", "b3")}
        return {**found, "input_scale": inputs, "output_scale": output, "correction": correction, "fit": best.free}


def _report(jobs: list[Future], told: list[tuple[float, str]], progress: Progress) -> None:
    wait(jobs, timeout=0.1)
    slower = min(told)
    progress(slower[0], slower[1])


def _prepared(
    recording: Recording, drive: LoadedDrive, axis: int, scale: tuple | None
) -> tuple[AxisData, Matrix, Matrix]:
    """Return the data of an axis along logged motors (simulated ones where none were logged) and simulated ones."""
    motors = np.concatenate([drive.simulate(run.set_points, drive_start(run)) for run in recording.runs()])
    if not recording.has_motor_positions:
        recording = recording.with_channels(**{f"motor_position_{j + 1}": motors[:, j] for j in range(3)})
    return axis_data(recording, motors, axis, scale)
