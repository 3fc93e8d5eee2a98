"""The virtual neck fitted to recordings, or to what a grey box answers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import DataError, Progress, load
from softneck.core._progress import shown_progress
from softneck.plant._calibration import Calibration
from softneck.plant._calibration import calibrate as calibrated
from softneck.signals import Recording, signal
from softneck.signals.recording._files import RecordingLike, opened_recording
from softneck.signals.recording._recording import conditions

from .models._model import Model

# What a model of the equations is asked to play [s].
_PLAYED = 60.0


def calibrate(
    sources: RecordingLike | Model | Sequence[RecordingLike | Model],
    *,
    payloads: Sequence[float] | None = None,
    evaluations: int = 30,
    progress: Progress | None = None,
) -> Calibration:
    """Return the virtual neck whose free run is nearest to recordings, by least squares.

    Payload and geometry that the robot file gives stay as they are. The last 30 % of each run are not fitted to: they
    judge. `save` writes the neck file.

    Args:
        sources: recordings, as `identify` takes them, or models of kind `greybox`, or their files.
        payloads: of each in turn [kg]; what their column `payload` says, else 0, if not given.
        evaluations: steps of the search.
        progress: called with the part done and a word; a bar in a terminal if not given.

    Raises:
        DataError: no recording, not of a neck, payloads that are not one for each, a model of another kind.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=10.0), neck, seed=1)
        >>> softneck.calibrate(recording, evaluations=1).worst > 85.0
        True
    """
    listed: Sequence[Any] = sources if isinstance(sources, list | tuple) else [sources]
    parts = [_recording(source) for source in listed]
    given = [max(conditions(part)["payload_kg"]) for part in parts] if payloads is None else list(payloads)
    radius = parts[0].robot.winch_radius_m if parts else None
    known = {} if radius is None else {"winch_radius": radius}
    with shown_progress("calibrate", progress) as tell:
        return calibrated(parts, given, known=known, evaluations=evaluations, progress=tell)


def _recording(source: Any) -> Recording:
    if isinstance(source, Model):
        return _played(source, "the model")
    if isinstance(source, str | Path) and Path(source).suffix == ".npz":
        return _played(load(source, role="model"), source)
    return opened_recording(source)


def _played(model: Model, source: str | Path) -> Recording:
    """Return what a model answers to Eq. 22."""
    if model.kind != "greybox":
        raise DataError(f"{source}: is of kind {model.kind}; a neck is calibrated to recordings or to a `greybox`.")
    model.robot.require_neck("a calibrated neck")
    played = signal("eq22", duration=_PLAYED)
    if abs(model.sample_time - played.sample_time) > 1e-9:
        raise DataError(f"{source}: is at {model.sample_time:g} s; Eq. 22 is played at {played.sample_time:g} s.")
    block = model.block()
    names = [port.name for port in block.inputs]
    inputs = block.checked_inputs(np.tile([port.start for port in block.inputs], (len(played.time) - 1, 1)))
    for j in (1, 2, 3):
        inputs[:, names.index(f"motor_setpoint_{j}")] = played.set_points[:-1, j - 1]
    start = block.initial_state()
    outputs = [port.name for port in block.outputs]
    rows = [outputs.index(axis) for axis in ("pitch", "roll")]
    Y = np.vstack([start.outputs[rows], block.run(start, inputs)[1][:, rows]])
    channels = {f"motor_setpoint_{j}": played.set_points[:, j - 1] for j in (1, 2, 3)}
    return Recording(played.time, played.sample_time, {**channels, "pitch": Y[:, 0], "roll": Y[:, 1]})
