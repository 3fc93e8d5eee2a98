"""Identify a model by its kind, a family and a calibrated neck, as the commands of these names do."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import (
    KINDS,
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
from softneck.plant import Calibration, has_own_tendons
from softneck.plant import calibrate as calibrate_neck
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
from .models._left_out import folds
from .models._model import Model
from .models._validity import with_tolerance
from .selection._auto import Choice, KindTrial, best_others, choose, settings_of
from .selection._examination import AGAIN, NOT_FITTED, Examination, examine, shortened
from .structured._greybox import as_found
from .uncertainty._draws import make_draws
from .uncertainty._family import Family
from .uncertainty._family_fit import FamilySettings
from .validation._score_tables import INFINITE
from .validation._validation import Validation, validate

# Length of the Eq. 22 excitation that a `greybox` is simulated on for a calibration [s].
_EXCITATION_S = 60.0
# A hold-out of a second or less gives no usable fit.
_MIN_HELD_OUT_ROWS = 75


def calibrate(
    sources: RecordingLike | Model | Sequence[RecordingLike | Model],
    *,
    payloads: Sequence[float] | None = None,
    evaluations: int = 30,
    progress: Progress | None = None,
) -> Calibration:
    """Fit the parameters of the virtual neck to recordings by least squares of the simulation error.

    Payload and geometry stay as the robot file gives them. The last 30 % of each run are held out to judge the fit.
    `save` writes the neck file.

    Args:
        sources: recordings, as `identify` takes them, or models of kind `greybox`, or their files.
        payloads: of each in turn [kg]; by default that of its column `payload`, else 0.
        evaluations: steps of the search.
        progress: called with the part done and a word; by default a bar in a terminal.

    Raises:
        DataError: no recording, not one payload for each, or a model of another kind.
        SettingsError: a robot other than a neck.

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
        return calibrate_neck(parts, given, known=known, evaluations=evaluations, progress=tell)


def _recording(source: Any) -> Recording:
    if isinstance(source, Model):
        return _simulate_eq22(source, "the model")
    if isinstance(source, str | Path) and Path(source).suffix == ".npz":
        return _simulate_eq22(load(source, role="model"), source)
    return open_recording(source)


def _simulate_eq22(model: Model, source: str | Path) -> Recording:
    """Simulate a `greybox` model on the excitation of Eq. 22."""
    if model.kind != "greybox":
        raise DataError(f"{source}: is of kind {model.kind}; a neck is calibrated to recordings or to a `greybox`.")
    robot, excitation = model.robot, signal("eq22", duration=_EXCITATION_S)
    if not has_own_tendons(robot):
        raise SettingsError(
            f"a calibrated neck has tendons at 0, 120, 240 deg and two outputs; not robot {robot.label()}."
        )
    if abs(model.sample_time - excitation.sample_time) > 1e-9:
        raise DataError(
            f"{source}: its sample time is {model.sample_time:g} s; calibration needs {excitation.sample_time:g} s."
        )
    block = model.block()
    names = [port.name for port in block.inputs]
    inputs = block.checked_inputs(np.tile([port.start for port in block.inputs], (len(excitation.time) - 1, 1)))
    inputs[:, [names.index(name) for name in robot.set_points]] = excitation.set_points[:-1]
    start = block.initial_state()
    outputs = [port.name for port in block.outputs]
    rows = [outputs.index(axis) for axis in robot.outputs.names]
    Y = np.vstack([start.outputs[rows], block.run(start, inputs)[1][:, rows]])
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*excitation.set_points.T, *Y.T), strict=True))
    return Recording(excitation.time, excitation.sample_time, channels, robot=robot)


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
    """Fit a model of `kind` to the first part of each run and validate it on the rest.

    The command `softneck identify KIND` does the same. `findings["examination"]` and the first line of `summary()` give
    the fit to be expected on other motions, and the worst on what was left out: the rest, and parts of the first part
    that the kind is trained again without.

    Args:
        kind: name in the table of kinds: "rls", "oe", "nlsm", "nn", ...; "auto" compares all of them and returns the
            best, with the reason in `findings["chosen"]` (`choose` returns the whole ranking). It holds out the last
            of several recordings as a whole, and then trains the best on all; its only setting is `seed`.
        recording: a recording, its file, a DataFrame, an array of a `robot`, or a list of several.
        train: part of each run, from its start, to train on; 1 holds nothing out.
        robot: of the recording; None takes `robot.toml` beside a file or above it, else that of the recording.
        tolerance: error that `validity` allows, in the display unit of the outputs (of a neck 2 deg).
        progress: called with the part done and a word; by default a bar in a terminal.
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
    """Fit a model to the first part of each run and validate it on the rest; None where too little is held out."""
    if isinstance(train, bool) or not isinstance(train, int | float) or not 0.0 < train <= 1.0:
        raise SettingsError(f"`train`: the part to train on must be in (0, 1]; got {train!r}.")
    if tolerance is not None:
        require_positive("tolerance", tolerance)
    head, tail = (whole, None) if train == 1.0 else whole.split(train)
    # A user's own kind may not report progress.
    examined = tail is not None and any(isinstance(estimator, resolve(KINDS[kind].settings)) for kind in AGAIN)
    half = 0.5 if examined else 1.0  # trainings without a part take about as long as that of all rows
    fitting = lambda done, text: progress(half * done, text)  # noqa: E731
    reported = {"progress": fitting} if "progress" in signature(estimator.fit).parameters else {}
    model: Model = estimator.fit(head, **reported)
    model = model if tolerance is None else with_tolerance(model, tolerance)
    if tail is None or all(len(run) < _MIN_HELD_OUT_ROWS for run in tail.runs()):
        return model, None
    examination = None
    if why_at_rest(tail, whole) is None:
        examining = lambda done, text: progress(half + (1.0 - half) * done, text)  # noqa: E731
        left_out = folds(head, tail, other_excitation=False) if model.kind in AGAIN else []
        found = as_found(estimator, model) if model.kind == "greybox" else estimator
        short = lambda fold: shortened(found, model.kind).fit(fold.train)  # noqa: E731
        examination, model = examine(short, model, head, tail, left_out, examining)
    held_out = validate(model, tail, horizons=(1, INFINITE))
    return with_fit(model, held_out, examination), held_out


def _best_kind(
    recording: RecordingLike, *, train: float, robot: Robot | str | Path | None, tolerance: float | None,
    progress: Progress | None, seed: int = 0, **others: Any
) -> Model:  # fmt: skip
    """Fit the model of the kind that `auto` chooses."""
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
    model = replace(model, findings={**model.findings, "chosen": choice.why})
    return with_fit(model, choice.chosen.judged, choice.chosen.examination)


def choose_kind(parts: Sequence[Recording], *, name: str, train: float, seed: int, progress: Progress) -> Choice:
    """Compare all kinds by `auto`; the last of several recordings, called `name`, is held out as a whole meanwhile."""
    head, tail, other = _split_for_choice(parts, train)
    check_training(head)
    still = why_at_rest(tail, concatenate(parts))
    if still is not None:
        raise DataError(f"{name}: {still}. Record motion to the end, or hold out other rows by `train`.")
    part = 0.7 if other else 1.0
    choice = choose(
        head, tail, other_excitation=other, seed=seed, progress=lambda done, text: progress(part * done, text)
    )
    if not other:
        return choice
    late = lambda done, text: progress(part + (1.0 - part) * done, text)  # noqa: E731
    return _trained_on_all(choice, concatenate(parts), train, seed, late)


# Settings of a guarded model that a choice has found.
_OF_GUARDED = ("of", "base", "members")


def _trained_on_all(choice: Choice, whole: Recording, train: float, seed: int, progress: Progress) -> Choice:
    """Return the choice with its models trained on all recordings, as by `identify KIND`.

    These are the chosen model and the best of the other sort, linear or not. What decided had been held out from them.
    """
    wanted, again = [choice.chosen, *best_others(choice.ranking, choice.chosen).values()], dict[str, KindTrial]()
    for number, one in enumerate(wanted):
        made_of = one.model.settings if one.kind == "guarded" and one.model is not None else {}
        settings = settings_of(one.kind, seed, {name: made_of[name] for name in _OF_GUARDED if name in made_of})
        part = lambda done, text, n=number: progress((n + done) / len(wanted), text)  # noqa: E731
        with suppress(*NOT_FITTED):  # the model without the last recording stands
            model, judged = fit_and_validate(settings, whole, train=train, tolerance=None, progress=part)
            again[one.kind] = replace(one, model=model, judged=judged, examination=None)
    ranking = tuple(again.get(one.kind, one) for one in choice.ranking)
    if choice.chosen.kind not in again:
        return replace(choice, ranking=ranking)
    why = f"{choice.why} Then it is trained on all recordings, of each run its first {100.0 * train:.3g} %."
    return replace(choice, ranking=ranking, chosen=again[choice.chosen.kind], why=why)


def _split_for_choice(parts: Sequence[Recording], train: float) -> tuple[Recording, Recording, bool]:
    """Return the training recording, the hold-out, and whether the hold-out is another experiment."""
    known = [payload_of(run) for part in parts[:-1] for run in part.runs()]
    if known and all(min(known) <= payload_of(run) <= max(known) for run in parts[-1].runs()):
        return concatenate(parts[:-1]), parts[-1], True
    if not 0.0 < train < 1.0:
        raise SettingsError(f"`train`: `auto` has to hold rows out; give a part below 1, got {train:g}.")
    # Hold out the end of each run: a model cannot predict with a payload that it was not trained on.
    head, tail = concatenate(parts).split(train)
    return head, tail, False


def with_fit(model: Model, held_out: Validation | None, examination: Examination | None = None) -> Model:
    """Return the model with its examination, and its fit on the rows held out, which `softneck design` requires."""
    if held_out is None:
        return model
    examined = {} if examination is None else {"examination": examination.findings(model.kind, model.robot)}
    scores = {
        "fit": held_out.fits[INFINITE],
        "one_step": held_out.fits.get("1", {}),
        "persistence": held_out.persistence.get("1", {}),
        "diverged": held_out.diverged,
        "rows": held_out.rows_scored,
    }
    return replace(model, findings={**model.findings, **examined, "hold_out": scores})


def family(
    recordings: RecordingLike,
    *,
    robot: Robot | str | Path | None = None,
    draws: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    **settings: Any,
) -> Family:
    """Fit an uncertain linear plant to recordings and test it against them, as `softneck family` does.

    Args:
        recordings: as for `identify`; each of a list may have a payload of its own.
        robot: as for `identify`.
        draws: nonlinear models for each certificate (`softneck.identification.make_draws`); the command makes 59.
        seed: of the draws.
        progress: called with the part done and a word; by default a bar in a terminal.
        **settings: those of `FamilySettings`.

    Raises:
        SettingsError: an unknown setting, or a value out of range.
        FileFormatError: no such file, or no recording.
        DataError: too short, unequal sample times, or too few local models with enough information.

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
        part = 0.5 if draws else 1.0
        found = chosen.fit(parts, names=recording_names(listed), progress=lambda done, text: tell(part * done, text))
        if draws:
            late = lambda done, text: tell(part + part * done, text)  # noqa: E731
            try:
                found = replace(found, draws=make_draws(parts, count=draws, seed=seed, progress=late))
            except DataError as error:  # the linear plant stands by itself
                found.findings["caution"] = f"no draws were made: {error}"
    found.findings["files"] = {str(source): file_hash(source) for source in files}
    return found
