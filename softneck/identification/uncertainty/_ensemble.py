"""The median of several models, with their spread as bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from softneck.core import KINDS, Progress, SettingsError, find_kind, require_whole, resolve, silent
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import Recording
from softneck.signals.recording._recording import require_same_robot

from ..models._arrays import COMPOSED, memory_of, prefixed_arrays
from ..models._fitting import one_recording, row_hashes
from ..models._model import Model
from ..models._ports import trained_set_points
from ..models._validity import grounded, joined


@dataclass(frozen=True, slots=True, kw_only=True)
class Ensemble:
    """Median of the free runs of several kinds; `pitch_lower` and `pitch_upper` are the least and the largest.

    Attributes:
        members: kinds, each with its default settings; one named twice is trained with another seed. For a robot
            without tendons `nss` stands for `greybox`, which bends by them.
        seed: of the first member that starts at random; the next have the next seeds.
    """

    members: tuple[str, ...] = ("play", "greybox", "nn")
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "members", tuple(self.members))
        require_whole("seed", self.seed, 0, 2**62)
        if len(self.members) < 2:
            raise SettingsError(f"an ensemble needs at least two members; got {', '.join(self.members) or 'none'}.")
        for kind in self.members:
            find_kind(kind, "model")
            if kind in COMPOSED:
                raise SettingsError(f"a model of kind `{kind}` holds others itself and cannot be a member.")

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify every member on the same recordings.

        Raises:
            DataError: what any member raises.
        """
        recording = one_recording(recordings)
        models = []
        known = {} if recording.robot.directions.kind == "tendons" else {"greybox": "nss"}
        members = tuple(known.get(kind, kind) for kind in self.members)
        for number, kind in enumerate(members):
            part = _part(progress, number, len(members), kind)
            models.append(seeded(kind, self.seed + number).fit(recording, progress=part))
        progress(1.0, "done")
        ensemble = grounded(combine(models), recording)
        return replace(ensemble, settings=asdict(replace(self, members=members)), training_rows=row_hashes(recording))


def combine(models: Sequence[Model]) -> Model:
    """Return the ensemble of models that are there already.

    Raises:
        SettingsError: fewer than two, of different sample times, or one that holds others itself.
        DataError: models of two robots.
    """
    if len(models) < 2:
        raise SettingsError(f"an ensemble needs at least two models; got {len(models)}.")
    if not np.allclose([model.sample_time for model in models], models[0].sample_time, rtol=1e-6):
        raise SettingsError("the models of an ensemble must have one sample time.")
    robot = models[0].robot
    for model in models:
        require_same_robot(model.robot, robot, "the members of an ensemble")
    memory = max(memory_of(model.arrays) for model in models)
    arrays = {
        "history": np.array([1.0] if robot.is_neck else [1.0, len(robot.outputs.names), len(robot.motors.names)]),
        "memory": np.array([float(memory)]),
        **prefixed_arrays([(model.kind, model.arrays) for model in models]),
    }
    ensemble = Model(
        kind="ensemble",
        sample_time=models[0].sample_time,
        arrays=arrays,
        settings={"members": [model.kind for model in models]},
        findings={
            "members": ", ".join(model.kind for model in models),
            **trained_set_points(*(model.findings for model in models)),
        },
        training_rows=np.unique(np.concatenate([model.training_rows for model in models])),
        robot=robot,
    )
    return joined(ensemble, models)


def seeded(kind: str, seed: int):
    """Return the default settings of a kind, with `seed` where it has one."""
    settings = resolve(KINDS[kind].settings)()
    return replace(settings, seed=seed) if hasattr(settings, "seed") else settings


def _part(progress: Progress, number: int, count: int, kind: str) -> Progress:
    return lambda done, what: progress((number + done) / count, f"{kind}: {what}")
