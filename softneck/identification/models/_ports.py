"""The variables of an identified plant, the same for every kind (public face, "FMUs")."""

from __future__ import annotations

import numpy as np

from softneck.runtime import Port

_MOTORS = (1, 2, 3)
_ANGLES = ("pitch", "roll")


def _angle(name: str, description: str) -> Port:
    return Port(name=name, unit="rad", description=description, minimum=-np.pi, maximum=np.pi, nominal=0.2)


def _motor(name: str, description: str, *, missing: bool = False) -> Port:
    return Port(name=name, unit="rad", description=description, nominal=1.0, missing=missing)


INPUTS = (
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


def outputs(kind: str) -> tuple[Port, ...]:
    """Return the outputs of a kind; set membership and ensembles have bounds as well."""
    return (*_OUTPUTS, *_BOUNDS) if kind in ("nlsm", "residual", "ensemble") else _OUTPUTS
