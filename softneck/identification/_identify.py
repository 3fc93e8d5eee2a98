"""A model of any kind by its name, as `softneck identify KIND` makes it."""

from __future__ import annotations

from typing import Any

from softneck.core import find_kind, resolve
from softneck.core._kinds import make_settings
from softneck.signals import Recording

from .models._model import Model


def identify(kind: str, recording: Recording, **settings: Any) -> Model:
    """Return the model of `kind` fitted on all of `recording`; `settings` are those of the kind's settings class.

    Args:
        kind: name in the table of kinds: "rls", "oe", "nlsm", "nn", ...
        recording: what to identify from; join several with `softneck.signals.concatenate`.
        **settings: for instance `delay=0.08`; angles in rad.

    Raises:
        SettingsError: an unknown kind or setting, or a value out of range.
        DataError: the recording does not determine the model.
    """
    return make_settings(resolve(find_kind(kind, "model").settings), settings).fit(recording)
