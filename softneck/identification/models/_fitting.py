"""What every estimator begins and ends with: one recording to train on, and a model that knows its rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from softneck.core import Matrix
from softneck.signals import Recording, concatenate

from ._checks import check_training
from ._model import Model
from ._ports import trained_set_points
from ._rows import row_hashes

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# Kinds that take any robot.
ANY_ROBOT = ("rls", "oe", "srivc", "subspace", "play")
SAME_EXCITATION = "chosen on rows of the excitation it was trained on; a hold-out of another one chooses better"


def one_recording(recordings: Recording | list[Recording]) -> Recording:
    """Return all runs as one recording; they are never joined."""
    return concatenate(recordings if isinstance(recordings, list) else [recordings])


def training_recording(recordings: Recording | list[Recording], *, any_robot: bool = False) -> Recording:
    """Return all runs as one recording to identify from.

    Args:
        recordings: of one robot and sample time.
        any_robot: whether the kind takes other robots than the neck.

    Raises:
        DataError: too short, without excitation, with an output that never moves, or of a robot that the kind cannot
            take.
    """
    recording = one_recording(recordings)
    if not any_robot and not recording.robot.is_neck:
        raise DataError(
            f"this kind of model is for necks only so far, and the recording is of robot {recording.robot.label()}; "
            f"identify {', '.join(ANY_ROBOT)}."
        )
    check_training(recording)
    return recording


def fitted_model(
    kind: str,
    settings: DataclassInstance,
    recording: Recording,
    *,
    arrays: Mapping[str, Matrix],
    findings: Mapping[str, Any],
) -> Model:
    """Return what `settings` made of `recording`."""
    return Model(
        kind=kind,
        sample_time=recording.sample_time,
        arrays=arrays,
        settings=asdict(settings),
        findings={**findings, **trained_set_points(recording)},
        training_rows=row_hashes(recording),
        robot=recording.robot,
    )
