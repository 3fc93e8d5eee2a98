"""A model of any kind by its name, as `softneck identify KIND` makes it."""

from __future__ import annotations

from inspect import signature
from pathlib import Path
from typing import Any

from softneck.core import Progress, find_kind, resolve
from softneck.core._kinds import make_settings
from softneck.core._progress import shown_progress
from softneck.signals import Recording
from softneck.signals.recording._files import opened_recording

from .models._model import Model
from .models._validity import with_tolerance


def identify(
    kind: str,
    recording: Recording | str | Path,
    *,
    tolerance: float | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Model:
    """Return the model of `kind` fitted on all of `recording`; `settings` are those of the kind's settings class.

    Args:
        kind: name in the table of kinds: "rls", "oe", "nlsm", "nn", ...
        recording: what to identify from, or its file; join several with `softneck.signals.concatenate`.
        tolerance: error that `validity` allows, in the unit in which people see the outputs (a neck's 2 deg).
        progress: called with the part done and a word; a bar in a terminal if not given.
        **settings: for instance `delay=0.08`; angles in rad.

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
        >>> model.simulate(recording).channels[:2]
        ('pitch', 'roll')
    """
    estimator = make_settings(resolve(find_kind(kind, "model").settings), settings)
    with shown_progress(f"identify {kind}", progress) as tell:
        # A kind of one's own need not tell how far it is.
        told = {"progress": tell} if "progress" in signature(estimator.fit).parameters else {}
        model = estimator.fit(opened_recording(recording), **told)
    return model if tolerance is None else with_tolerance(model, tolerance)
