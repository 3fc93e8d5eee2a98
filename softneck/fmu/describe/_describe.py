"""What an FMU tells people about the model, observer, controller or neck inside it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any, Protocol

from softneck.core import FileFormatError, SettingsError, to_si
from softneck.core._budget import settings_text
from softneck.design.linear._own import own_controller
from softneck.identification import Validation
from softneck.plant import NeckParameters, VirtualNeck
from softneck.robot import Robot
from softneck.robot._file import PRESETS
from softneck.robot._opened import opened
from softneck.runtime import Block

from ._documentation import FmuInfo
from ._figures import line_chart

# Of a free run, in the picture [s].
_SHOWN = 30.0
_HEADINGS = {
    "plant": "How it was identified",
    "observer": "How it was designed",
    "controller": "How it was designed",
    "reference": "What it gives",
}

_LIMITS = {
    "plant": (
        "An identified plant is good where its training data were: other payloads, other tendons and slower or wilder "
        "motions than those recorded are guesses. In free run an error stays; nothing pulls it back."
    ),
    "observer": "It assumes the linear plant it was designed on; far from there its innovation says so.",
    "controller": "It was designed on a linear plant; verify the loop on the virtual neck before it moves hardware.",
}
_KIND_LIMITS = {
    "virtual_neck": (
        "It stands in for a neck that was never weighed: its parameters are the paper's or yours, its friction and its "
        "link are simple. What holds on it has yet to hold on hardware."
    ),
}


class Buildable(Protocol):
    """Anything an FMU is made of."""

    def block(self) -> Block:
        """Return the block that steps."""
        ...

    def summary(self) -> str:
        """Return a few lines for people."""
        ...


def buildable(thing: Buildable | Block | str | Path, robot: str | Path | Robot | None = None) -> Any:
    """Return what has a block, or what its file or preset stands for: a softneck file, a neck or a robot.

    Raises:
        FileFormatError: a file of which nothing is stepped.
        SettingsError: no file, no preset and nothing with a block.
    """
    thing = own_controller(thing)
    if not isinstance(thing, str | Path):
        if isinstance(thing, Block) or (hasattr(thing, "block") and not isinstance(thing, type)):
            return thing
        if isinstance(thing, NeckParameters):
            return VirtualNeck(thing)
        raise SettingsError(f"a model, observer, controller, neck or its file is needed; got a {type(thing).__name__}.")
    name, path = str(thing), Path(thing)
    if path.suffix == ".npz":
        found = opened(path, robot=robot)
        if not hasattr(found, "block"):
            raise FileFormatError(f"{path}: is not a model, observer or controller: nothing in it can be stepped.")
        return found
    if path.suffix not in ("", ".toml"):
        raise FileFormatError(
            f"{path}: no FMU can be built from a `{path.suffix}` file; give a model, controller or observer "
            "(.npz), a neck, robot or loop file (.toml), or a preset (paper, lab, rough, trunk)."
        )
    if name in PRESETS:
        return VirtualNeck.of(Robot.preset(name))
    if has_keys(path, {"motors", "outputs", "directions", "extends"}):
        return VirtualNeck.of(Robot.read(path))
    return VirtualNeck(NeckParameters.preset(name))


def has_keys(path: Path, keys: set[str]) -> bool:
    """Return whether a TOML file has one of these keys."""
    if path.suffix != ".toml" or not path.is_file():
        return False
    try:
        return not keys.isdisjoint(tomllib.loads(settings_text(path)))
    except (ValueError, RecursionError):
        return False


def block_and_info(thing: Buildable | Block | str | Path, info: FmuInfo | None) -> tuple[Block, FmuInfo]:
    """Return what is packaged, and what its FMU says of it where nobody says otherwise."""
    found = buildable(thing)
    if isinstance(found, Block):
        return found, info or FmuInfo()
    # A block alone has no summary, and says nothing.
    return found.block(), info or (fmu_info(found) if hasattr(found, "summary") else FmuInfo())


def fmu_info(
    thing: Buildable, *, scores: str = "", validation: Validation | None = None, stop_time: float = 10.0
) -> FmuInfo:
    """Return the texts of an FMU of `thing`: how it was made, its scores, its plot and what it is not good for.

    Args:
        thing: model, observer, controller or neck.
        scores: what was scored, as plain text.
        validation: of a model on data it was not trained on; its fits and its free run are shown.
        stop_time: of the default experiment [s].
    """
    block = thing.block()
    summary = thing.summary()
    parts = [f"<h2>{_HEADINGS[block.role]}</h2><pre>{escape(summary)}</pre>"]
    asked: Any = getattr(thing, "settings", None) or {}
    settings: dict[str, Any] = dict(asked) if isinstance(asked, Mapping) else asdict(asked)
    if settings:
        rows = "".join(f"<tr><td>{escape(str(k))}</td><td>{escape(str(v))}</td></tr>" for k, v in settings.items())
        parts.append(f"<h2>Settings</h2><table>{rows}</table>")
    if scores:
        parts.append(f"<h2>Scores</h2><pre>{escape(scores)}</pre>")
    if validation is not None:
        parts += ["<h2>Scores</h2>", _fits(validation), _free_run(validation)]
    elif hasattr(thing, "training_rows") and not scores:
        parts.append("<h2>Scores</h2><p>None were given when this FMU was built (softneck fmu --data).</p>")
    robot: Any = getattr(thing, "robot", None)
    limits = _KIND_LIMITS.get(block.kind, _LIMITS.get(block.role, ""))
    if limits:
        parts.append(f"<h2>What it is not good for</h2><p>{limits}</p>")
    return FmuInfo(
        description=summary.splitlines()[0] if summary else block.kind,
        author="softneck",
        license="BSD-3-Clause (runtime); the model is its author's",
        documentation="\n".join(parts),
        stop_time=stop_time,
        robot=None if robot is None or robot.is_neck else (robot.name, robot.hash),
    )


def _fits(validation: Validation) -> str:
    rows = []
    for name, scores in (("persistence", validation.persistence), ("this model", validation.fits)):
        for horizon, fit in scores.items():
            cells = "".join(f"<td>{_percent(fit.get(axis))}</td>" for axis in validation.robot.outputs.names)
            ahead = {"inf": "free run", "1": "one sample ahead"}.get(horizon, f"{horizon} samples ahead")
            rows.append(f"<tr><td>{name}</td><td>{ahead}</td>{cells}</tr>")
    head = (
        f"<tr><th></th><th></th>{''.join(f'<th>{escape(axis)}</th>' for axis in validation.robot.outputs.names)}</tr>"
    )
    diverged = "" if validation.diverged is None else f" Its free run diverged at t = {validation.diverged:g} s."
    return (
        f"<p>NRMSE fit in %, on {validation.rows_scored} rows of {escape(validation.data)}; "
        f"{validation.rows_left_out} rows that it was trained on are left out.{diverged}</p>"
        f"<table>{head}{''.join(rows)}</table>"
    )


def _percent(fit: float | None) -> str:
    return "-" if fit is None else f"{fit:.2f}"


def _free_run(validation: Validation) -> str:
    """Return each output over the first stretch, at most half a minute of it."""
    stretch = validation.run == validation.run[0]
    time = validation.time[stretch]
    keep = time < time[0] + _SHOWN
    figures, outputs = [], validation.robot.outputs
    scale = to_si(outputs.display_unit)[0]
    for column, axis in enumerate(outputs.names):
        curves = {
            "measured": validation.measured[stretch, column][keep] / scale,
            "free run": validation.free_run[stretch, column][keep] / scale,
        }
        figures.append(f"<figure>{line_chart(time[keep], curves, title=axis, unit=outputs.display_unit)}</figure>")
    return "".join(figures)
