"""Write the worst plants as loop files for `softneck simulate`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import ArrayLike

from softneck.core import Matrix, SettingsError, Vector, to_si, write_text
from softneck.loop import error_unit
from softneck.robot import Robot
from softneck.runtime import Block, Port
from softneck.signals import Recording, write_recording

from ._plants import mixing_matrix
from ._requirements import Requirements
from ._steps import middle_motors, middle_of

_PLANT_RUNTIME = "softneck.verification._linear_plant_runtime"

_PLANT_TEMPLATE = '''"""The plant `{name}`, written by `softneck verify`: its own delay and that of the loop's order."""

from softneck.verification import linear_plant


def plant():
    """Return it as a block: y(z) = z^-delay numerator/denominator u(z) of {axes}."""
    return linear_plant(
        numerator={numerator},
        denominator={denominator},
        delay={delay},
        cross={cross},
        sample_time={sample_time!r},{more}
    )
'''


def linear_plant(
    *,
    numerator: ArrayLike,
    denominator: ArrayLike,
    delay: Sequence[int],
    cross: ArrayLike = (),
    sample_time: float = 0.02,
    robot: Mapping[str, Any] | None = None,
    directions: ArrayLike | None = None,
    inputs: ArrayLike = (),
    outputs: ArrayLike = (),
) -> Block:
    """Return linear axes as a plant block, with measurement noise and a load on each input.

    Args:
        numerator: (outputs, q), highest power of z first; the first of each is 0.
        denominator: (outputs, q), monic.
        delay: additional samples of each axis.
        cross: (outputs (outputs - 1),) gains of the other axes' inputs over the axis's own, axis by axis; default zero.
        sample_time: [s].
        robot: tables of a robot other than the neck.
        directions: (outputs, motors) weights of its motors in each axis's input.
        inputs, outputs: (outputs,) operating point; default zero.

    Raises:
        SettingsError: wrong shapes, direct feedthrough, a negative delay.
    """
    above, below = (np.atleast_2d(np.asarray(item, dtype=np.float64)) for item in (numerator, denominator))
    whose = Robot.preset() if robot is None else Robot.from_dict(robot)
    names = whose.outputs.names
    m = len(names)
    if above.shape != below.shape or above.shape[0] != m:
        raise SettingsError(
            f"`numerator` and `denominator` must have one shape ({m}, q); got {above.shape}, {below.shape}."
        )
    if np.any(above[:, 0] != 0.0) or np.any(below[:, 0] != 1.0):
        raise SettingsError("`numerator` must begin with 0 and `denominator` with 1: the input acts one sample later.")
    if min(delay) < 0:
        raise SettingsError(f"`delay` must not be negative; got {list(delay)}.")
    T = whose.redefinition(None if directions is None else np.asarray(directions, dtype=np.float64))[0]
    unit, motor = to_si(whose.outputs.unit)[1], to_si(whose.motors.unit)[1]
    motors = [
        Port(name=name, unit=motor, description=f"set-point of motor {j}") for j, name in enumerate(whose.set_points, 1)
    ]
    before, around = (
        np.asarray(item, dtype=np.float64) if np.size(item) else np.zeros(m) for item in (inputs, outputs)
    )
    loads = [
        Port(name=f"load_{axis}", unit=motor, start=-before[i], description=f"added to the input of {axis}")
        for i, axis in enumerate(names)
    ]
    angles = [Port(name=name, unit=unit) for name in (*names, *(f"{axis}_measured" for axis in names))]
    positions = [Port(name=name, unit=motor) for name in whose.motor_positions]
    most = 0.2 if unit == "rad" else None
    noise = Port(name="noise_std", unit=unit, description="noise of the measured angles", minimum=0.0, maximum=most)
    mixed = mixing_matrix(np.asarray(cross, float) if np.size(cross) else np.zeros(m * (m - 1)), m)
    return Block(
        kind="linear_plant",
        role="plant",
        runtime=_PLANT_RUNTIME,
        sample_time=sample_time,
        arrays=(above, below, np.asarray(delay, dtype=np.float64), mixed, T, around),
        inputs=(*motors, *loads),
        outputs=(*angles, *positions),
        parameters=(noise, Port(name="noise_seed", description="seed of that noise", minimum=0.0)),
    )


def write_linear(
    folder: Path, name: str, worst: Mapping[str, Any], *, controller: Path, asked: Requirements,
    block: Block, weights: Matrix, force: bool
) -> Path:  # fmt: skip
    """Write `name.toml` and its plant; return the loop file.

    As in the step test, motors are first moved to their operating point. `worst` has name, numerator, denominator,
    delay, cross, sample_time and axis (its number) of the plant, `weights` (outputs, motors) those of the axes' inputs.
    """
    robot, step = asked.robot, asked.step
    around, names = middle_of(robot), robot.outputs.names
    inputs = " and ".join(f"{axis} (from {name})" for axis, name in zip(names, robot.input_names, strict=True))
    before = robot.redefinition(weights)[0] @ middle_motors(robot, block)
    more = f"\n        robot={robot.as_dict()!r}," if robot.in_header() else ""
    own = robot.weights()
    if own is None or not np.array_equal(own, weights):
        more += f"\n        directions={np.asarray(weights).tolist()!r},"
    if before.any() or around.any():
        more += f"\n        inputs={before[:-1].tolist()!r},\n        outputs={around.tolist()!r},"
    named = {**worst, "name": str(worst["name"]).replace("\\", "/").replace('"', "'")}
    text = _PLANT_TEMPLATE.format(**named, axes=inputs, more=more)
    # Python imports a module name once, so each plant has its own.
    module = f"plant_{hashlib.sha256(text.encode()).hexdigest()[:10]}"
    write_text(folder / f"{module}.py", text, force=True)
    Ts, duration = float(worst["sample_time"]), float(step["duration_s"])
    stepped = around + asked.scale.si(float(step["size_deg"])) * (np.arange(around.size) == worst["axis"])
    if before.any():
        rows = 2 * round(duration / Ts)  # as long as in the step test
        duration += rows * Ts
        levels = np.vstack([np.tile([*around, before[-1]], (rows, 1)), [*stepped, before[-1]]])
        _write_reference(folder / f"{name}_reference.csv", robot, levels, Ts, force=force)
        wanted: dict[str, Any] = {"kind": "recording", "file": f"{name}_reference.csv"}
    else:
        wanted = _step(robot, asked.scale.shown(stepped), 0.0)
    loop = {"duration_s": duration, "sample_time_s": Ts, "order": "sequential"}
    plant = {"python": f"{module}:plant", "parameters": {"noise_std": asked.scale.si(step["noise_deg"])}}
    files = {"controller": controller}
    return _write_loop(folder, name, f"{worst['name']}, with a step", {**loop, "plant": plant}, files, wanted, force)


def write_neck(
    folder: Path, name: str, worst: Mapping[str, Any], controller: Path, observer: Path | None, *, force: bool,
    robot: Robot,
) -> Path:  # fmt: skip
    """Write `name.toml`, a loop over the virtual neck; `worst` are the certificate's facts on the run."""
    ends = [worst[f"{axis}_{error_unit(robot)[0]}"] for axis in robot.outputs.names]
    values = {**worst["parameters"], "payload": worst["payload_kg"], "noise_seed": worst["seed"]}
    plant = {"neck": "paper", "parameters": {key: float(value) for key, value in values.items()}}
    loop = {key: worst[key] for key in ("duration_s", "sample_time_s", "order")}
    files = ({} if observer is None else {"observer": observer}) | {"controller": controller}
    wanted = _step(robot, ends, worst["at_s"])
    return _write_loop(folder, name, worst["name"], {**loop, "plant": plant}, files, wanted, force)


def _step(robot: Robot, levels: Iterable[float], at: float) -> dict[str, Any]:
    """Return the keys of a step from zero to levels in the display unit."""
    keys = [f"{axis}_{error_unit(robot)[0]}" for axis in robot.outputs.names]
    return {"kind": "step", **dict(zip(keys, map(float, levels), strict=True)), "at_s": at}


def _write_reference(path: Path, robot: Robot, levels: Matrix, sample_time: float, *, force: bool) -> None:
    """Write levels (rows, outputs + 1) of outputs and co-contraction as a recording."""
    time = np.arange(len(levels)) * sample_time
    channels: dict[str, Vector] = dict.fromkeys(robot.set_points, np.zeros(len(levels)))
    channels["cocontraction_reference"] = levels[:, -1]
    for axis, name in enumerate(robot.outputs.names):
        channels |= dict.fromkeys((name, f"{name}_reference"), levels[:, axis])
    write_recording(path, Recording(time, sample_time, channels, robot=robot), force=force)


def _write_loop(
    folder: Path, name: str, plant: str, table: Mapping[str, Any], files: Mapping[str, Path], wanted: Mapping[str, Any],
    force: bool,
) -> Path:  # fmt: skip
    """Write `name.toml`: a loop's `table`, the files of its parts and its reference; `plant` names the plant."""
    start = folder.resolve()
    parts = {role: {"file": Path(os.path.relpath(file.resolve(), start)).as_posix()} for role, file in files.items()}
    title = f"{name} on {plant}".replace("\n", " ")
    head = f"# Written by `softneck verify`: {title}.\n# Run it with `softneck simulate {name}.toml`.\n"
    path = folder / f"{name}.toml"
    write_text(path, head + tomli_w.dumps({**table, **parts, "reference": wanted}), force=force)
    return path
