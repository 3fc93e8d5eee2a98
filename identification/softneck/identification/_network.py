"""The paper's NLARX network: two hidden layers of 25 over the regressor of Eq. 21, one network for each axis."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from softneck.core import DataError, Matrix, Progress, SettingsError, require_positive, require_whole, silent
from softneck.signals import Recording, concatenate

from ._checks import check_training
from ._drive import fit_drive
from ._levenberg import random_layers, train
from ._model import Model
from ._regressors import PAPER_EQ21, history_length, motor_signals, regression
from ._rows import row_hashes


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """NLARX network trained series-parallel (on measured outputs) by Levenberg-Marquardt.

    Attributes:
        hidden: neurons of the two layers.
        iterations: at most so many steps of Levenberg-Marquardt for each axis.
        decay: weight of the squared weights beside the squared error of scaled outputs.
        seed: of the starting weights.
    """

    hidden: tuple[int, int] = (25, 25)
    iterations: int = 40
    # Of 0.001, 0.1 and 1 the best free run on validation; 0.001 cannot run free on the lab's recording at all.
    decay: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(self.hidden))
        if len(self.hidden) != 2:
            raise SettingsError(f"`hidden` must be two numbers of neurons; got {self.hidden}.")
        for neurons in self.hidden:
            require_whole("hidden", neurons, 1, 1000)
        require_whole("iterations", self.iterations, 1, 100_000)
        require_whole("seed", self.seed, 0, 2**63)
        require_positive("decay", self.decay)

    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Train both networks.

        Raises:
            DataError: too short, constant, or fewer rows than weights.
        """
        recording = concatenate(recordings if isinstance(recordings, list) else [recordings])
        check_training(recording)
        drive = fit_drive(recording)
        recording = motor_signals(recording, drive)
        rng = np.random.default_rng(self.seed)
        axes = []
        for axis, name in enumerate(("pitch", "roll")):
            part = _part(progress, axis, name)
            axes.append(self._fit_axis(recording, axis, rng, part))
        progress(1.0, "done")
        names = ("W1", "b1", "W2", "b2", "w3", "b3", "input_scale", "output_scale")
        stacked = {name: np.array(values) for name, values in zip(names, zip(*axes, strict=True), strict=True)}
        arrays: dict[str, Matrix] = {
            "history": np.array([float(history_length(PAPER_EQ21, drive))]),
            "drive": drive.array,
            "table": PAPER_EQ21,
            **stacked,
        }
        return Model(
            kind="nn",
            sample_time=recording.sample_time,
            arrays=arrays,
            settings=asdict(self),
            training_rows=row_hashes(recording),
        )

    def _fit_axis(self, recording: Recording, axis: int, rng: np.random.Generator, progress: Progress) -> tuple:
        X, y = regression(recording, PAPER_EQ21, axis)
        start = random_layers(X.shape[1], self.hidden, rng)
        if y.size < start.vector().size:
            raise DataError(
                f"{y.size} rows are fewer than the network's {start.vector().size} weights. "
                "Record longer or use fewer neurons."
            )
        input_scale = np.array([X.mean(axis=0), np.maximum(X.std(axis=0), 1e-9)])
        output_scale = np.array([y.mean(), max(float(y.std()), 1e-9)])
        Z = (X - input_scale[0]) / input_scale[1]
        target = (y - output_scale[0]) / output_scale[1]
        # One thread: matrices this small gain nothing from more, and lose much where another process takes a core.
        with threadpool_limits(limits=1):
            net, _ = train(start, Z, target, iterations=self.iterations, decay=self.decay, progress=progress)
        return net.W1, net.b1, net.W2, net.b2, net.w3, net.b3, input_scale, output_scale


def _part(progress: Progress, axis: int, name: str) -> Progress:
    return lambda done, what: progress((axis + done) / 2, f"{name}: {what}")
