"""Kind `residual`: any model, and set membership on what its free run leaves over, with bounds."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from softneck.core import (
    DataError,
    Progress,
    SettingsError,
    find_kind,
    require_positive,
    require_whole,
    silent,
)
from softneck.signals import Recording, concatenate

from ._checks import check_training
from ._composed import COMPOSED, memory_of, prefixed_arrays
from ._ensemble import seeded
from ._gamma import least_gammas
from ._model import Model
from ._residual import ANGLE_WEIGHT, residual_points, residual_table
from ._rows import row_hashes
from ._set_membership import _set_arrays, noise_level

# Hardly felt in free run (docs, "Set membership").
_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Residual:
    """A base of any kind, and set membership (Algorithm 1) over simulated signals on what its free run leaves over.

    Attributes:
        base: kind, with its default settings.
        epsilon: noise bound [rad]; None takes four standard deviations of the noise.
        angle_weight: weight of the base's angles in the regressor's norm, motors having 1.
        seed: of a base that starts at random.
    """

    base: str = "play"
    epsilon: float | None = None
    angle_weight: float = ANGLE_WEIGHT
    seed: int = 0

    def __post_init__(self) -> None:
        find_kind(self.base, "model")
        if self.base in COMPOSED:
            raise SettingsError(f"a model of kind `{self.base}` holds others itself and cannot be a base.")
        if self.epsilon is not None:
            require_positive("epsilon", self.epsilon, "rad")
        require_positive("angle_weight", self.angle_weight)
        require_whole("seed", self.seed, 0, 2**62)

    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify the base, then the set on the residual of its free run over the same rows.

        Raises:
            DataError: what the base raises, or `epsilon` so small that no function fits the residual.
        """
        recording = concatenate(recordings if isinstance(recordings, list) else [recordings])
        check_training(recording)
        base = seeded(self.base, self.seed).fit(recording, progress=lambda done, what: progress(0.9 * done, what))
        progress(0.9, "set membership on what it leaves over")
        model = self.on(base, recording)
        progress(1.0, "done")
        return model

    def on(self, base: Model, recording: Recording) -> Model:
        """Return a set over the residual of a base that is there already."""
        noise = np.array([noise_level(recording, axis) for axis in range(2)])
        epsilon = _SIGMAS * noise if self.epsilon is None else np.full(2, self.epsilon)
        table = residual_table(recording.sample_time)
        scale = np.where(table[:, 0] == 3, self.angle_weight, 1.0)
        points = [residual_points(recording, base, table, scale, axis) for axis in range(2)]
        gamma = np.array([least_gammas(*points[i], epsilon[i : i + 1])[0][0] for i in range(2)])
        if gamma.max() > 1e100:
            raise DataError(
                f"epsilon {np.degrees(epsilon).round(4).tolist()} deg is below the noise: equal regressors have "
                "residuals further apart. Set `epsilon` higher."
            )
        arrays = {
            "history": np.array([float(table[:, 2].max())]),
            "memory": np.array([float(memory_of(base.arrays))]),
            "table": table,
            "scale": scale,
            **_set_arrays(points, gamma, epsilon),
            **prefixed_arrays([(base.kind, base.arrays)]),
        }
        findings = {
            "base": base.kind,
            "epsilon_deg": np.degrees(epsilon).tolist(),
            "gamma": gamma.tolist(),
            "points": int(points[0][1].size),
            **{key: value for key, value in base.findings.items() if key in ("remark", "interrupted")},
        }
        return Model(
            kind="residual",
            sample_time=recording.sample_time,
            arrays=arrays,
            settings={**asdict(self), "base": base.kind},
            findings=findings,
            training_rows=np.unique(np.concatenate([base.training_rows, row_hashes(recording)])),
        )
