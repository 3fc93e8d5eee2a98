"""Continuous plants as a controller sees them: its set-points held from one sample to the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from softneck.core import SettingsError

# Of the paper's loop [s].
USUAL_PERIOD = 0.02


def discrete(plant: Any, period: float) -> tuple[float | None, Any]:
    """Return the plant with each continuous `control` system of it made discrete by a zero-order hold, and its period.

    At the samples both agree, as set-points are held in between. A plant that is discrete stays as it is, with None.

    Raises:
        SettingsError: a system that has no state space.
    """
    return (period, _sampled(plant, period)) if _any_continuous(plant) else (None, plant)


def held_line(design: Mapping[str, Any]) -> list[str]:
    """Return a line on a continuous plant, none for another."""
    # Files before 0.3 have it among the settings.
    period = design.get("held_s", design.get("settings", {}).get("sample_time"))
    return [] if period is None else [f"  the plant is continuous, its inputs held for {1e3 * period:g} ms (exact)"]


def _any_continuous(plant: Any) -> bool:
    if isinstance(plant, Mapping | list | tuple):
        return any(_any_continuous(item) for item in (plant.values() if isinstance(plant, Mapping) else plant))
    return _is_continuous(plant)


def _is_continuous(plant: Any) -> bool:
    import control

    return isinstance(plant, control.StateSpace | control.TransferFunction) and control.isctime(plant, strict=True)


def _sampled(plant: Any, period: float) -> Any:
    import control

    if isinstance(plant, Mapping):
        return {name: _sampled(item, period) for name, item in plant.items()}
    if isinstance(plant, Sequence):
        return [_sampled(item, period) for item in plant]
    if not _is_continuous(plant):
        return plant
    try:
        system: Any = control.ss(plant)
    except (ValueError, control.ControlMIMONotImplemented) as error:
        raise SettingsError(
            "the continuous plant has no state space: each of its transfer functions must be proper, and several "
            "outputs need a control.StateSpace."
        ) from error
    if not all(np.isfinite(part).all() for part in (system.A, system.B, system.C, system.D)):
        raise SettingsError("the plant has entries that are not finite.")
    return system.sample(period, method="zoh")
