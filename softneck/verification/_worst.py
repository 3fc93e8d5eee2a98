"""The worst plants as files that `softneck simulate` runs."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import SettingsError, atomic_write
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block, Port
from softneck.signals import TENDON_ANGLES, redefinition_matrix

_RUNTIME = "softneck.verification._linear_plant_runtime"

_PLANT = '''"""The plant `{name}`, written by `softneck verify`: its own delay and that of the loop's order."""

from softneck.verification import linear_plant


def plant():
    """Return it as a block: y(z) = z^-delay numerator/denominator u(z) of pitch (from theta_i) and roll (phi_i)."""
    return linear_plant(
        numerator={numerator},
        denominator={denominator},
        delay={delay},
        cross={cross},
        sample_time={sample_time!r},
    )
'''
_LOOP = """# Written by `softneck verify`: {title}.
# Run it with `softneck simulate {name}`.
duration_s = {duration:g}
sample_time_s = {sample_time!r}
order = "{order}"

[plant]
{plant}
parameters = {{ {parameters} }}
{observer}
[controller]
file = {controller}

[reference]
kind = "step"
pitch_deg = {pitch!r}
roll_deg = {roll!r}
at_s = {at:g}
"""


def linear_plant(
    *,
    numerator: ArrayLike,
    denominator: ArrayLike,
    delay: Sequence[int],
    cross: Sequence[float] = (0.0, 0.0),
    sample_time: float = 0.02,
) -> Block:
    """Return two linear axes as a plant for loops, with noise on the measured angles and a load on each input.

    Args:
        numerator: (2, q) of pitch and roll, highest power of z first; the first of each is 0.
        denominator: (2, q) monic.
        delay: samples besides, of each axis.
        cross: phi_i into pitch as a part of theta_i's effect, and theta_i into roll.
        sample_time: [s].

    Raises:
        SettingsError: shapes that do not fit, a direct way from input to angle, a negative delay.
    """
    above, below = (np.atleast_2d(np.asarray(item, dtype=np.float64)) for item in (numerator, denominator))
    if above.shape != below.shape or above.shape[0] != 2:
        raise SettingsError(
            f"`numerator` and `denominator` must have one shape (2, q); got {above.shape}, {below.shape}."
        )
    if np.any(above[:, 0] != 0.0) or np.any(below[:, 0] != 1.0):
        raise SettingsError("`numerator` must begin with 0 and `denominator` with 1: the input acts one sample later.")
    if min(delay) < 0:
        raise SettingsError(f"`delay` must not be negative; got {list(delay)}.")
    motors = [Port(name=f"motor_setpoint_{j}", unit="rad", description=f"set-point of motor {j}") for j in (1, 2, 3)]
    loads = [
        Port(name=f"load_{axis}", unit="rad", description=f"added to the input of {axis}") for axis in ("pitch", "roll")
    ]
    angles = [Port(name=name, unit="rad") for name in ("pitch", "roll", "pitch_measured", "roll_measured")]
    positions = [Port(name=f"motor_position_{j}", unit="rad") for j in (1, 2, 3)]
    return Block(
        kind="linear_plant", role="plant", runtime=_RUNTIME, sample_time=sample_time,
        arrays=(
            above, below, np.asarray(delay, dtype=np.float64), np.asarray(cross, dtype=np.float64),
            redefinition_matrix(np.asarray(TENDON_ANGLES)),
        ),
        inputs=(*motors, *loads), outputs=(*angles, *positions),
        parameters=(
            Port(name="noise_std", unit="rad", description="noise of the measured angles", minimum=0.0, maximum=0.2),
            Port(name="noise_seed", description="seed of that noise", minimum=0.0),
        ),
    )  # fmt: skip


def virtual_neck() -> Block:
    """Return the virtual neck `paper` as a plant at 20 ms; loop files that earlier versions wrote name it."""
    return VirtualNeck(NeckParameters.paper()).block()


def write_linear(
    folder: Path, name: str, worst: Mapping[str, Any], *, controller: Path, step: Mapping[str, Any], force: bool
) -> Path:
    """Write `name.toml` and the plant beside it; return the loop file.

    Args:
        folder: where.
        name: of the loop file.
        worst: name, numerator, denominator, delay, cross, sample_time and axis (0 pitch, 1 roll) of the plant.
        controller: its file.
        step: the table [step] of the requirements.
        force: replace what stands there.
    """
    text = _PLANT.format(**{**worst, "name": str(worst["name"]).replace("\\", "/").replace('"', "'")})
    # Modules of one name are imported once: another plant needs another name.
    module = f"plant_{hashlib.sha256(text.encode()).hexdigest()[:10]}"
    _write(folder / f"{module}.py", text, force=True)
    size = float(step["size_deg"])
    angles = (size, 0.0) if worst["axis"] == 0 else (0.0, size)
    noise = f"noise_std = {math.radians(step['noise_deg'])!r}"
    text = _loop(
        folder, f"{name}.toml", title=f"{name} on {worst['name']}, with a step", plant=f'python = "{module}:plant"',
        parameters=noise, controller=controller, observer=None, angles=angles, at=0.0,
        duration=float(step["duration_s"]), sample_time=float(worst["sample_time"]), order="sequential",
    )  # fmt: skip
    _write(folder / f"{name}.toml", text, force=force)
    return folder / f"{name}.toml"


def write_neck(
    folder: Path, name: str, worst: Mapping[str, Any], *, controller: Path, observer: Path | None, force: bool
) -> Path:
    """Write `name.toml`, a loop over the virtual neck; `worst` is what the certificate says of that run."""
    values = {**worst["parameters"], "payload": worst["payload_kg"], "noise_seed": float(worst["seed"])}
    text = _loop(
        folder, f"{name}.toml", title=f"{name} on {worst['name']}", plant='neck = "paper"',
        parameters=", ".join(f"{key} = {float(value)!r}" for key, value in values.items()), controller=controller,
        observer=observer, angles=(worst["pitch_deg"], worst["roll_deg"]), at=worst["at_s"],
        duration=worst["duration_s"], sample_time=worst["sample_time_s"], order=worst["order"],
    )  # fmt: skip
    _write(folder / f"{name}.toml", text, force=force)
    return folder / f"{name}.toml"


def _loop(
    folder: Path, name: str, *, title: str, controller: Path, observer: Path | None, angles: tuple[float, float],
    **values: Any,
) -> str:  # fmt: skip
    seen = "" if observer is None else f"\n[observer]\nfile = {_quoted(observer, folder)}\n"
    return _LOOP.format(
        name=name, title=title.replace("\n", " "), controller=_quoted(controller, folder), observer=seen,
        pitch=float(angles[0]), roll=float(angles[1]), **values,
    )  # fmt: skip


def _quoted(path: Path, folder: Path) -> str:
    """Return the path from `folder` as a TOML text."""
    relative = Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    return '"' + relative.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _write(path: Path, text: str, *, force: bool) -> None:
    with atomic_write(path, force=force) as temporary:
        temporary.write_text(text, encoding="utf-8")
