"""The variables of an identified plant, the same for every kind (public face, "FMUs")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from softneck.core import to_si
from softneck.robot import Robot
from softneck.runtime import Port
from softneck.signals import Recording, conditions, merge_conditions

#: What may hang on the platform [kg], as on the virtual neck's.
MOST_PAYLOAD = 5.0
# What a winch may do [rad], for models that do not say what they were trained on.
_MOST = 6.0
_TRAINED = "set_points_rad"


def _output(robot: Robot, name: str, description: str, *, missing: bool = False) -> Port:
    unit, shown = to_si(robot.outputs.unit)[1], robot.outputs.display_unit
    # "": what is usual for the unit, as degrees are.
    port = Port(name=name, unit=unit, description=description, missing=missing,
                display_unit="" if shown == "deg" else shown)  # fmt: skip
    if unit != "rad" or missing:
        return port
    return replace(port, minimum=-np.pi, maximum=np.pi, nominal=0.2)


def _motor(robot: Robot, name: str, description: str, *, missing: bool = False) -> Port:
    unit, shown = to_si(robot.motors.unit)[1], robot.motors.unit
    nominal = 1.0 if unit == "rad" else None
    return Port(name=name, unit=unit, description=description, nominal=nominal, missing=missing,
                display_unit="" if shown == unit else shown)  # fmt: skip


def _platform(robot: Robot, name: str) -> str:
    """Return what an output is of, for people."""
    tendons = robot.tendon_angles is not None
    return f"{name.capitalize()} of the platform" if tendons else f"Output `{name}` of {robot.name}"


def parameters(robot: Robot, arrays: Mapping[str, np.ndarray]) -> tuple[Port, ...]:
    """Return the parameters: the outputs' starts, whether to use measurements, noise, and the payload if it matters."""
    known = payloads(arrays)
    names, largest = robot.outputs.names, 0.5 if to_si(robot.outputs.unit)[1] == "rad" else None
    return (
        *(_output(robot, f"{name}_start", f"{name.capitalize()} at the start") for name in names),
        Port(
            name="use_measurement",
            description="false: free run (paper, Fig. 3b); true: from measured angles and motors (Fig. 3a)",
            boolean=True,
            minimum=0.0,
            maximum=1.0,
        ),
        Port(
            name="noise_std",
            unit=to_si(robot.outputs.unit)[1],
            description=f"Standard deviation of the noise on {' and '.join(names)}",
            minimum=0.0,
            maximum=largest,
        ),
        Port(name="noise_seed", description="Seed of that noise", minimum=0.0, maximum=2147483647.0, integer=True),
        *(() if known is None else (_payload(*known),)),
    )


def payloads(arrays: Mapping[str, np.ndarray]) -> tuple[float, float] | None:
    """Return least and most payload [kg] of a model's recordings, or of its member's; None where it knows but one."""
    found = [array for name, array in arrays.items() if name.rpartition(".")[2] == "payload"]
    return (float(found[0][0]), float(found[0][1])) if found else None


def _payload(least: float, most: float) -> Port:
    seen = f"What hangs on the platform; the recordings had {least:g} to {most:g} kg, beyond which validity is 0"
    return Port(name="payload", unit="kg", description=seen, start=least, minimum=0.0, maximum=MOST_PAYLOAD)


def trained_set_points(*sources: Recording | Mapping[str, Any]) -> dict[str, Any]:
    """Return the findings that say over which set-points a model was trained, in SI (rest is among them), and how.

    Args:
        sources: recordings, and findings of models that are part of it.
    """
    seen: list[np.ndarray] = []
    for source in sources:
        seen.append(source.set_points if isinstance(source, Recording) else np.array(_range(source, 3)))
    rows = np.vstack([np.zeros((1, seen[0].shape[1])), *seen])
    found = {"min": np.nanmin(rows, axis=0).tolist(), "max": np.nanmax(rows, axis=0).tolist()}
    made = [conditions(part) if isinstance(part, Recording) else part.get("conditions", {}) for part in sources]
    return {_TRAINED: found, "conditions": merge_conditions([part for part in made if part])}


def trained_range(findings: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the least and largest set-points (motors,) that a model was trained on, in SI; None where it has none."""
    seen = findings.get(_TRAINED)
    return None if seen is None else (np.array(seen["min"]), np.array(seen["max"]))


def inputs(findings: Mapping[str, Any], robot: Robot) -> tuple[Port, ...]:
    """Return the inputs; the set-points range over what the model was trained on."""
    low, high = _range(findings, len(robot.motors.names))
    pulls = (
        "; positive: the winch pulls"
        if robot.tendon_angles is not None
        else f" ({robot.motors.unit} in the robot's files)"
    )
    return (
        *(
            replace(_motor(robot, name, f"Set-point of motor {j}{pulls}"), minimum=float(a), maximum=float(b))
            for j, (name, a, b) in enumerate(zip(robot.set_points, low, high, strict=True), start=1)
        ),
        *(
            _output(robot, f"{name}_measured", f"Measured {name}; for use_measurement", missing=True)
            for name in robot.outputs.names
        ),
        *(
            _motor(robot, name, f"Measured position of motor {j}; for use_measurement", missing=True)
            for j, name in enumerate(robot.measured_positions, start=1)
        ),
    )  # fmt: skip


def _range(findings: Mapping[str, Any], motors: int) -> tuple[list[float], list[float]]:
    seen = findings.get(_TRAINED, {"min": [-_MOST] * motors, "max": [_MOST] * motors})
    return seen["min"], seen["max"]


#: Kinds with bounds of their outputs, which follow outputs and motors.
BOUNDED = ("nlsm",)


def outputs(kind: str, robot: Robot) -> tuple[Port, ...]:
    """Return the outputs of a kind; set membership has bounds as well, and `validity` is the last."""
    names = robot.outputs.names
    bounds = tuple(
        _output(robot, f"{name}_{side}", f"{side.capitalize()} bound of {name} by set membership (Eq. 19, 20)")
        for name in names
        for side in ("lower", "upper")
    )  # fmt: skip
    return (
        *(_output(robot, name, _platform(robot, name)) for name in names),
        *(
            _motor(robot, name, f"Position of motor {j} by the drive model")
            for j, name in enumerate(robot.motor_positions, start=1)
        ),
        *(bounds if kind in BOUNDED else ()),
        Port(
            name="validity",
            description="Predicted probability that the error stays within the model's tolerance; 0: not known",
            minimum=0.0,
            maximum=1.0,
        ),
    )
