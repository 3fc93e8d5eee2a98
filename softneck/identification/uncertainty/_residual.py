"""Kind `residual`: any model, and set membership on what its free run leaves over, with bounds."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    SettingsError,
    Vector,
    find_kind,
    require_positive,
    require_whole,
    silent,
)
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import Recording

from ..models._arrays import COMPOSED, memory_of, prefixed_arrays
from ..models._directions import directions_of, regressor_units
from ..models._fitting import in_display_unit, row_hashes, training_recording
from ..models._model import WARM_UP, Model
from ..models._ports import trained_set_points
from ..models._regressors import lag_table
from ..models._scores import nrmse_fit
from ..models._validity import grounded
from ..set_membership._regressor import gammas, residual_lags, residual_rows, scaled, set_arrays, widened, widening
from ..set_membership._set_membership import noise_levels, usual_finding, usual_widths
from ._ensemble import seeded

# Of the noise: below what the base and the last 0.8 s leave unexplained, gamma and the bounds' width grow a
# hundredfold; the fit hardly feels it.
_SIGMAS = (4.0, 8.0, 16.0, 32.0)
_HOLD_OUT = 0.2
# What a base found that is said of the whole.
_TAKEN = ("remark", "interrupted", "time_constants_s", "directions", "directions_from")
# Fits [points] that are alike.
_ALIKE = 0.5
# A radian of motor tilts the neck by about 0.2 rad: 5 makes the two equal in the norm.
_ANGLE_WEIGHT = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Residual:
    """A base of any kind, and set membership (Algorithm 1) over simulated signals on what its free run leaves over.

    Attributes:
        base: kind, with its default settings.
        epsilon: noise bound [rad, or the SI unit of the outputs]; None takes 4, 8, 16 or 32 standard deviations of
            the noise, whichever gives the narrowest bounds among equal fits.
        angle_weight: weight of the base's outputs in the regressor's norm, motors having 1; of another robot where
            both move as much as a neck's.
        seed: of a base that starts at random.
    """

    base: str = "play"
    epsilon: float | None = None
    angle_weight: float = _ANGLE_WEIGHT
    seed: int = 0

    def __post_init__(self) -> None:
        find_kind(self.base, "model")
        if self.base in COMPOSED:
            raise SettingsError(f"a model of kind `{self.base}` holds others itself and cannot be a base.")
        if self.epsilon is not None:
            require_positive("epsilon", self.epsilon, "rad")
        require_positive("angle_weight", self.angle_weight)
        require_whole("seed", self.seed, 0, 2**62)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify the base, then the set on the residual of its free run over the same rows.

        Raises:
            DataError: what the base raises, or `epsilon` so small that no function fits the residual.
        """
        recording = training_recording(recordings, any_robot=True)
        base = seeded(self.base, self.seed).fit(recording, progress=lambda done, what: progress(0.9 * done, what))
        progress(0.9, "set membership on what it leaves over")
        model = self.on(base, recording)
        progress(1.0, "done")
        return model

    def on(self, base: Model, recording: Recording) -> Model:
        """Return a set over the residual of a base that is there already."""
        noise, given = noise_levels(recording), self.epsilon
        wanted = self._narrowest(base, recording, noise) if given is None else np.full(noise.size, given)
        robot = recording.robot
        arrays, gamma, epsilon, points = self._arrays(base, recording, wanted)
        widest = epsilon if given is not None else np.minimum(_SIGMAS[-1] * noise, epsilon)
        findings = {
            "base": base.kind,
            f"epsilon_{robot.outputs.display_unit}": in_display_unit(robot, epsilon).tolist(),
            "gamma": gamma.tolist(),
            "points": int(arrays["values"].shape[1]),
            usual_finding(robot): in_display_unit(robot, usual_widths(points, gamma, epsilon)).tolist(),
            **widening(widest, epsilon, robot),
            **{key: value for key, value in base.findings.items() if key in _TAKEN},
            **trained_set_points(recording, base.findings),
        }
        model = Model(
            kind="residual",
            sample_time=recording.sample_time,
            arrays=arrays,
            settings={**asdict(self), "base": base.kind},
            findings=findings,
            training_rows=np.unique(np.concatenate([base.training_rows, row_hashes(recording)])),
            robot=robot,
        )
        return grounded(model, recording)

    def _narrowest(self, base: Model, recording: Recording, noise: Vector) -> Vector:
        """Return the epsilon (outputs,) of the narrowest bounds over the last fifth of each run, among equal fits."""
        head, tail = recording.split(1.0 - _HOLD_OUT)
        if len(tail) <= 2 * WARM_UP:
            return _SIGMAS[0] * noise
        found: list[tuple[float, float, Vector]] = []
        lower = noise.size + recording.set_points.shape[1] + 2 * np.arange(noise.size)
        for sigmas in _SIGMAS:
            arrays = self._arrays(base, head, sigmas * noise)[0]
            model = Model(kind="residual", sample_time=head.sample_time, arrays=arrays, robot=recording.robot)
            Y = model.simulate(tail)[WARM_UP:]
            fits = [nrmse_fit(tail.outputs[WARM_UP:, axis], Y[:, axis]) for axis in range(noise.size)]
            known = [fit for fit in fits if np.isfinite(fit)]  # an output that stood still there has none
            fit = sum(known) / len(known) if known else float("-inf")
            found.append((fit, float(np.mean(Y[:, lower + 1] - Y[:, lower])), sigmas * noise))
        best = max(fit for fit, _, _ in found)
        return min((entry for entry in found if entry[0] >= best - _ALIKE), key=lambda entry: entry[1])[2]

    def _arrays(
        self, base: Model, recording: Recording, epsilon: Vector
    ) -> tuple[dict[str, Matrix], Vector, Vector, list[tuple[Matrix, Vector]]]:
        """Return the arrays, gamma, the epsilon taken (outputs,), and scaled regressors and targets of each output."""
        directions = directions_of(recording, [run.set_points for run in recording.runs()])
        lags = residual_lags(recording.sample_time / directions.stretch, recording)
        sizes = recording.set_points.shape[1], recording.outputs.shape[1]
        table = lag_table(lags, (), lags, both_outputs=True, sizes=sizes)
        scale = np.where(table[:, 0] == 3, self.angle_weight, 1.0) * regressor_units(recording, table)
        rows = [residual_rows(recording, base, table, axis) for axis in range(sizes[1])]
        points = [(scaled(X, scale), y) for X, y in rows]
        if self.epsilon is None:
            epsilon, gamma = widened(rows, scale, epsilon)
        else:
            gamma = gammas(rows, scale, [epsilon])[0]
        if gamma.max() > 1e100:
            tried, unit = in_display_unit(recording.robot, epsilon), recording.robot.outputs.display_unit
            raise DataError(
                f"epsilon {tried.round(4).tolist()} {unit} is below the noise: equal regressors have "
                "residuals further apart. Set `epsilon` higher."
            )
        arrays = {
            "history": np.array([float(table[:, 2].max()), *([] if recording.robot.is_neck else sizes[::-1])]),
            "memory": np.array([float(memory_of(base.arrays))]),
            "table": table,
            "scale": scale,
            **set_arrays(points, gamma, epsilon),
            **prefixed_arrays([(base.kind, base.arrays)]),
        }
        return arrays, gamma, epsilon, points
