"""A controller of any kind by its name, as `softneck design KIND` makes it."""

from __future__ import annotations

from typing import Any

from softneck.core import find_kind, resolve
from softneck.core._kinds import make_settings, opened


def design_controller(kind: str, plant: Any, **settings: Any) -> Any:
    """Return the controller of `kind` designed on `plant`; `settings` are those of the kind's settings class.

    Args:
        kind: name in the table of kinds: "pi", "pid", "hinf", "mpc", ...
        plant: an identified linear model, a family, the file of one, or a list whose first entry is the nominal plant.
        **settings: for instance `phase_margin=1.05`; angles in rad.

    Raises:
        SettingsError: an unknown kind or setting, a value out of range, or a plant that does not fit.
        FileFormatError: no such file, or not one of ours.
        CheckFailedError: no controller of this kind meets its settings on that plant.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> model = softneck.identify("rls", recording)
        >>> softneck.design_controller("pi", model).save("pi.npz")
        >>> softneck.load("pi.npz").kind
        'pi'
    """
    made = make_settings(resolve(find_kind(kind, "controller").settings), settings)
    return made.design([opened(one) for one in plant] if isinstance(plant, list | tuple) else opened(plant))
