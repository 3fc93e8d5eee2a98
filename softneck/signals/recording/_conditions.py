"""Under what recordings were made: their payload and co-contraction, of which a family or a model knows no other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ._recording import Recording

Conditions = dict[str, list[float]]


def conditions(recording: Recording) -> Conditions:
    """Return least and largest payload [kg] and co-contraction [the motors' SI unit], the mean of the set-points.

    A recording without the channel `payload` had none.
    """
    payload = recording.channels.get("payload", np.zeros(1))
    mean = recording.set_points.mean(axis=1)
    return {"payload_kg": _ends(payload), "cocontraction": _ends(mean)}


def joined(parts: Sequence[Conditions]) -> Conditions:
    """Return the conditions from the least to the largest of all parts."""
    return {name: _ends(np.concatenate([part[name] for part in parts])) for name in parts[0]} if parts else {}


def _ends(values: np.ndarray) -> list[float]:
    return [float(np.nanmin(values)), float(np.nanmax(values))]
