"""What a requirements file of `softneck tune` says besides: a reserve of limits, and loops that tuning alone closes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from softneck.core import SettingsError

#: Metrics of the loops of [track], which `softneck tune` alone closes.
TRACK_METRICS = ("track.circle_rms_deg", "track.ahead_rms_deg", "track.variation_rad_s")


def for_verify(own: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a file asks of `verify`: its limits less their reserve, and nothing of the loops of [track]."""
    found = {name: table for name, table in own.items() if name not in ("track", "reserve")}
    require = found.get("require", {})
    if isinstance(require, Mapping):
        kept, _ = kept_back(require, own.get("reserve", {}))
        found["require"] = {metric: entry for metric, entry in kept.items() if metric not in TRACK_METRICS}
    return found


def left_to_tune(own: Mapping[str, Any]) -> list[str]:
    """Return what of a file's requirements `verify` does not look at."""
    return [metric for metric in TRACK_METRICS if own.get("require", {}).get(metric)]


def kept_back(require: Mapping[str, Any], reserve: Any) -> tuple[dict[str, Any], dict[str, float]]:
    """Return the requirements less their reserve, and the reserve of those that are asked."""
    if not isinstance(reserve, Mapping):
        raise SettingsError("`reserve` must be a table: [reserve].")
    if not isinstance(require, Mapping):
        raise SettingsError("`require` must be a table: [require].")
    less, kept = dict(require), {}
    for metric, value in reserve.items():
        if not metric.startswith(("neck.", "track.")):
            raise SettingsError(f"[reserve] is of loops over plants that step, `neck.*` and `track.*`; got `{metric}`.")
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise SettingsError(f"the reserve of `{metric}` must be a number from 0 on; got {value!r}.")
        if metric not in require:
            raise SettingsError(
                f"[reserve] keeps back of `{metric}`, of which [require] asks nothing; state its limit there."
            )
        entry = require[metric]
        limit = entry.get("max") if isinstance(entry, Mapping) else None
        if isinstance(limit, bool) or not isinstance(limit, int | float) or limit < 0.0 or value == 0.0:
            continue  # dropped, or refused by what reads the limit
        if limit - value <= 0.0:
            raise SettingsError(
                f"`{metric}` <= {limit:g} leaves nothing beside its reserve of {value:g}; ask for more, or state "
                f"another one ([reserve])."
            )
        less[metric] = {**entry, "max": round(limit - value, 9)}
        kept[metric] = float(value)
    return less, kept
