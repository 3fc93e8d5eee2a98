"""The variables of an identified plant, the same for every kind (public face, "FMUs")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from softneck.runtime import Port
from softneck.signals import Recording

_MOTORS = (1, 2, 3)
_ANGLES = ("pitch", "roll")
# What a winch may do [rad], for models that do not say what they were trained on.
_MOST = 6.0
_TRAINED = "set_points_rad"


def _angle(name: str, description: str) -> Port:
    return Port(name=name, unit="rad", description=description, minimum=-np.pi, maximum=np.pi, nominal=0.2)


def _motor(name: str, description: str, *, missing: bool = False) -> Port:
    return Port(name=name, unit="rad", description=description, nominal=1.0, missing=missing)


_INPUTS = (
    *(_motor(f"motor_setpoint_{j}", f"Set-point of motor {j}; positive: the winch pulls") for j in _MOTORS),
    *(
        Port(name=f"{angle}_measured", unit="rad", description=f"Measured {angle}; for use_measurement", missing=True)
        for angle in _ANGLES
    ),
    *(
        _motor(f"motor_position_measured_{j}", f"Measured position of motor {j}; for use_measurement", missing=True)
        for j in _MOTORS
    ),
)
_BOUNDS = tuple(
    _angle(f"{angle}_{side}", f"{side.capitalize()} bound of {angle} by set membership (Eq. 19, 20) or of the ensemble")
    for angle in _ANGLES
    for side in ("lower", "upper")
)
_OUTPUTS = (
    _angle("pitch", "Pitch of the platform"),
    _angle("roll", "Roll of the platform"),
    *(_motor(f"motor_position_{j}", f"Position of motor {j} by the drive model") for j in _MOTORS),
)
PARAMETERS = (
    _angle("pitch_start", "Pitch at the start"),
    _angle("roll_start", "Roll at the start"),
    Port(
        name="use_measurement",
        description="false: free run (paper, Fig. 3b); true: from measured angles and motors (Fig. 3a)",
        boolean=True,
        minimum=0.0,
        maximum=1.0,
    ),
    Port(
        name="noise_std",
        unit="rad",
        description="Standard deviation of the noise on pitch and roll",
        minimum=0.0,
        maximum=0.5,
    ),
    Port(name="noise_seed", description="Seed of that noise", minimum=0.0, maximum=2147483647.0, integer=True),
)


def trained_set_points(*sources: Recording | Mapping[str, Any]) -> dict[str, Any]:
    """Return the finding that says over which set-points a model was trained [rad]; rest is among them.

    Args:
        sources: recordings, and findings of models that are part of it.
    """
    seen: list[np.ndarray] = [np.zeros((1, 3))]
    for source in sources:
        seen.append(source.set_points if isinstance(source, Recording) else np.array(_range(source)))
    rows = np.vstack(seen)
    return {_TRAINED: {"min": np.nanmin(rows, axis=0).tolist(), "max": np.nanmax(rows, axis=0).tolist()}}


def inputs(findings: Mapping[str, Any]) -> tuple[Port, ...]:
    """Return the inputs; the set-points range over what the model was trained on."""
    low, high = _range(findings)
    motors = zip(_INPUTS[:3], low, high, strict=True)
    return (*(replace(port, minimum=float(a), maximum=float(b)) for port, a, b in motors), *_INPUTS[3:])


def _range(findings: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    seen = findings.get(_TRAINED, {"min": [-_MOST] * 3, "max": [_MOST] * 3})
    return seen["min"], seen["max"]


def outputs(kind: str) -> tuple[Port, ...]:
    """Return the outputs of a kind; set membership and ensembles have bounds as well."""
    return (*_OUTPUTS, *_BOUNDS) if kind in ("nlsm", "residual", "ensemble") else _OUTPUTS
