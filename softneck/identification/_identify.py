"""A model of any kind by its name, and a family, as `softneck identify KIND` and `softneck family` make them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import (
    DataError,
    Progress,
    SettingsError,
    file_hash,
    find_kind,
    load,
    make_settings,
    require_positive,
    resolve,
    shown_progress,
)
from softneck.plant import Calibration
from softneck.plant import calibrate as calibrated
from softneck.robot import Robot
from softneck.signals import (
    Recording,
    RecordingLike,
    concatenate,
    conditions,
    open_recording,
    recording_names,
    signal,
    why_at_rest,
)

from .models._fitting import check_training, payload_of
from .models._model import Model
from .models._validity import with_tolerance
from .selection._auto import Choice, choose
from .uncertainty._family import Family
from .uncertainty._family_fit import FamilySettings
from .validation._score_tables import INFINITE
from .validation._validation import Validation, validate

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
    return open_recording(source)


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
    motors = model.robot.set_points
    inputs[:, [names.index(name) for name in motors]] = played.set_points[:-1]
    start = block.initial_state()
    outputs = [port.name for port in block.outputs]
    rows = [outputs.index(axis) for axis in ("pitch", "roll")]
    Y = np.vstack([start.outputs[rows], block.run(start, inputs)[1][:, rows]])
    channels = dict(zip((*motors, "pitch", "roll"), (*played.set_points.T, *Y.T), strict=True))
    return Recording(played.time, played.sample_time, channels, robot=model.robot)


# A hold-out of a second or less says nothing.
_LEAST_HELD_OUT = 75


def identify(
    kind: str,
    recording: RecordingLike,
    *,
    train: float = 0.7,
    robot: Robot | str | Path | None = None,
    tolerance: float | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Model:
    """Return the model of `kind` fitted on the first part of each run, judged on the rest.

    It does what `softneck identify KIND` does; `summary()` and `findings["hold_out"]` tell the fit on the rest.

    Args:
        kind: name in the table of kinds: "rls", "oe", "nlsm", "nn", ...; "auto" compares all of them and returns the
            best, with the reason in `findings["chosen"]` (`choose` returns the whole ranking). Of several recordings
            it holds the last one out as a whole; its only setting is `seed`.
        recording: what to identify from, or its file; a DataFrame; an array of a `robot`; or a list of several.
        train: part of each run, from its start, to train on; 1 holds nothing out.
        robot: whose recording it is; None: `robot.toml` beside a file or above it, else what the recording says.
        tolerance: error that `validity` allows, in the unit in which people see the outputs (a neck's 2 deg).
        progress: called with the part done and a word; a bar in a terminal if not given.
        **settings: those of the kind's settings class, for instance `delay=0.08`; angles in rad.

    Raises:
        SettingsError: an unknown kind or setting, or a value out of range.
        FileFormatError: no such file, or no recording.
        DataError: the recording does not determine the model.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> model = softneck.identify("rls", recording)
        >>> model.findings["hold_out"]["rows"], model.findings["hold_out"]["fit"]["pitch"] > 50.0
        (275, True)
    """
    if isinstance(kind, str) and kind == "auto":
        return _best_kind(recording, train=train, robot=robot, tolerance=tolerance, progress=progress, **settings)
    estimator = make_settings(resolve(find_kind(kind, "model").settings), settings)
    whole = open_recording(recording, robot)
    with shown_progress(f"identify {kind}", progress) as tell:
        return fit_and_validate(estimator, whole, train=train, tolerance=tolerance, progress=tell)[0]


def fit_and_validate(
    estimator: Any, whole: Recording, *, train: float, tolerance: float | None, progress: Progress
) -> tuple[Model, Validation | None]:
    """Return what `estimator` makes of the first part of each run, and how it does on the rest; None: nothing is."""
    if isinstance(train, bool) or not isinstance(train, int | float) or not 0.0 < train <= 1.0:
        raise SettingsError(f"`train`: the part to train on must be in (0, 1]; got {train!r}.")
    if tolerance is not None:
        require_positive("tolerance", tolerance)
    # All of it to train on leaves nothing to hold out.
    head, tail = (whole, None) if train == 1.0 else whole.split(train)
    # A kind of one's own need not tell how far it is.
    told = {"progress": progress} if "progress" in signature(estimator.fit).parameters else {}
    model: Model = estimator.fit(head, **told)
    model = model if tolerance is None else with_tolerance(model, tolerance)
    if tail is None or all(len(run) < _LEAST_HELD_OUT for run in tail.runs()):
        return model, None
    held_out = validate(model, tail, horizons=(1, INFINITE))
    return with_fit(model, held_out), held_out


def _best_kind(
    recording: RecordingLike, *, train: float, robot: Robot | str | Path | None, tolerance: float | None,
    progress: Progress | None, seed: int = 0, **others: Any
) -> Model:  # fmt: skip
    """Return the model of the kind that `auto` chooses; its only setting is `seed`."""
    if others:
        raise SettingsError(f"`auto` has no setting {next(iter(others))!r}; use seed.")
    listed: Sequence[Any] = recording if isinstance(recording, list | tuple) else [recording]
    with shown_progress("identify auto", progress) as tell:
        parts = [open_recording(part, robot) for part in listed]
        if not parts:
            raise DataError("`auto` needs at least one recording; got an empty list.")
        choice = choose_kind(parts, name=recording_names(listed)[-1], train=train, seed=seed, progress=tell)
    model = choice.chosen.model
    if model is None:
        raise DataError("the kind chosen by `auto` has no model.")
    model = model if tolerance is None else with_tolerance(model, tolerance)
    return with_fit(replace(model, findings={**model.findings, "chosen": choice.why}), choice.chosen.judged)


def choose_kind(parts: Sequence[Recording], *, name: str, train: float, seed: int, progress: Progress) -> Choice:
    """Return what `auto` chooses from recordings; the last of several, called `name`, is held out as a whole.

    Raises:
        SettingsError: nothing would be held out.
        DataError: what is held out stands still, or no kind could be identified.
    """
    head, tail, other = _split_for_choice(parts, train)
    check_training(head)
    still = why_at_rest(tail, concatenate(parts))
    if still is not None:
        raise DataError(f"{name}: {still}. Record motion to the end, or hold out other rows by `train`.")
    return choose(head, tail, other_excitation=other, seed=seed, progress=progress)


def _split_for_choice(parts: Sequence[Recording], train: float) -> tuple[Recording, Recording, bool]:
    """Return what to train on, what to hold out, and whether that is another experiment."""
    if len(parts) > 1 and not _is_other_payload(parts[-1], parts[:-1]):
        return concatenate(parts[:-1]), parts[-1], True
    if not 0.0 < train < 1.0:
        raise SettingsError(f"`train`: `auto` has to hold rows out; give a part below 1, got {train:g}.")
    # The end of each run: a model cannot know a payload that was held out whole.
    head, tail = concatenate(parts).split(train)
    return head, tail, False


def _is_other_payload(one: Recording, others: Sequence[Recording]) -> bool:
    """Return whether a recording has a payload beyond those of the others."""
    known = [payload_of(run) for part in others for run in part.runs()]
    return any(not min(known) <= payload_of(run) <= max(known) for run in one.runs())


def with_fit(model: Model, held_out: Validation | None) -> Model:
    """Return the model with what it was worth on the rows held out, which `softneck design` asks for."""
    if held_out is None:
        return model
    said = {
        "fit": held_out.fits[INFINITE],
        "one_step": held_out.fits.get("1", {}),
        "persistence": held_out.persistence.get("1", {}),
        "diverged": held_out.diverged,
        "rows": held_out.rows_scored,
    }
    return replace(model, findings={**model.findings, "hold_out": said})


def family(
    recordings: RecordingLike,
    *,
    robot: Robot | str | Path | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Family:
    """Return the uncertain linear plant of one or several recordings, tested against them, as `softneck family` does.

    Args:
        recordings: as `identify` takes them; of a list each is a recording of its own, of its payload for instance.
        robot: whose they are, as of `identify`.
        progress: called with the part done and a word; a bar in a terminal if not given.
        **settings: those of `FamilySettings`.

    Raises:
        SettingsError: an unknown setting, or a value out of range.
        FileFormatError: no such file, or no recording.
        DataError: too short, other sample times, or too few local models that say enough.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> found = softneck.family(softneck.record(signal("eq22", duration=60.0), neck, seed=1))
        >>> list(found.axes)
        ['pitch', 'roll']
    """
    chosen: FamilySettings = make_settings(FamilySettings, settings)
    listed: Sequence[Any] = recordings if isinstance(recordings, list | tuple) else [recordings]
    parts = [open_recording(part, robot) for part in listed]
    files = [part for part in listed if isinstance(part, str | Path)]
    with shown_progress("family", progress) as tell:
        found = chosen.fit(parts, names=recording_names(listed), progress=tell)
    found.findings["files"] = {str(source): file_hash(source) for source in files}
    return found
