"""Documentation of an FMU: texts on the model, observer, controller or neck inside it."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from html import escape
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from softneck.core import KINDS, FileFormatError, SettingsError, percent, settings_text
from softneck.design import own_object
from softneck.identification import Model, Validation
from softneck.plant import NeckParameters, VirtualNeck
from softneck.robot import ROBOT_PRESETS, Robot, load_for_robot
from softneck.runtime import Block, Port


@dataclass(frozen=True, slots=True, kw_only=True)
class FmuInfo:
    """Texts of an FMU, and the length of its default experiment.

    Attributes:
        description: one line.
        author: who made the model, "" for none.
        license: SPDX name, "" for none.
        version: of the model, "" for none.
        copyright: one line, "" for none.
        documentation: HTML for the body of `documentation/index.html`: how the model was identified, its scores, its
            limits.
        stop_time: of the default experiment [s].
        robot: name and hash of the robot unless it is the neck; loops refuse parts of different robots.
    """

    description: str = ""
    author: str = ""
    license: str = ""
    version: str = ""
    copyright: str = ""
    documentation: str = ""
    stop_time: float = 10.0
    robot: tuple[str, str] | None = field(default=None, repr=False)  # `repr` is part of the GUID


# Required by the slave's syntax.
MINIMUM_PYTHON = (3, 11)
HOST_NEEDS = (
    f"The host needs Python {'.'.join(map(str, MINIMUM_PYTHON))} or newer with numpy (not softneck). A host that is "
    "not a Python program finds it through LD_PRELOAD=libpython3.x.so and PYTHONPATH; better use an FMU of "
    "`softneck fmu --backend compiled`, which needs no Python."
)
_NUMBA_NOTE = (
    "Where the host has numba too, a runtime that is slow in plain Python is compiled or taken from softneck's cache; "
    "the environment variable SOFTNECK_FMU_NUMBA=0 disables this, =1 enforces it."
)
_PATHS_NOTE = (
    "pythonfmu's binary decodes only %20 in the path it is unpacked to: keep +, #, %, parentheses and "
    "letters beyond ASCII out of it (softneck's own tools do)."
)
_TIMING = {
    "plant": "Inputs are read at the sample instants and held; outputs change one sample later.",
    "other": "Inputs are read at the sample instants; outputs change at once and are held.",
}
_PAGE_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
    "pre{overflow:auto}"
    "table{border-collapse:collapse}td,th{border:1px solid #bbb;padding:.2em .6em;text-align:left}"
)


def documentation_page(name: str, block: Block, info: FmuInfo, host: str = "") -> str:
    """Return the page as one HTML text without any outside resource.

    `name`: of the model. `block`: with its outputs of the next sample. `info`: texts of the FMU. `host`: requirements
    of the host; "" for Python.
    """
    title = escape(info.description or f"{block.kind} ({block.role})")
    timing = _TIMING["plant" if block.role == "plant" else "other"]
    parts = [
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(name)}</title>',
        f"<style>{_PAGE_STYLE}</style></head><body>",
        f"<h1>{escape(name)}</h1><p>{title}</p>",
        info.documentation,
        "<h2>Variables</h2>",
        _table(block),
        f"<h2>Timing</h2><p>Internal sample time {block.sample_time:g} s; any communication step is legal.",
        f"{timing}</p>",
        f"<h2>Host</h2><p>{escape(host or f'{HOST_NEEDS} {_NUMBA_NOTE} {_PATHS_NOTE}')}</p>",
        '<p>Licences: <a href="licenses/">licenses/</a>. '
        f"{escape(' · '.join(text for text in (info.author, info.copyright, info.license) if text))}</p>",
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _table(block: Block) -> str:
    head = "<tr><th>variable</th><th>is</th><th>unit</th><th>start</th><th>range</th><th>meaning</th></tr>"
    rows = [
        _row(port, word)
        for word, ports in (("input", block.inputs), ("output", block.outputs), ("parameter", block.parameters))
        for port in ports
    ]
    return f"<table>{head}{''.join(rows)}</table>"


def _row(port: Port, word: str) -> str:
    low = -math.inf if port.minimum is None else port.minimum
    high = math.inf if port.maximum is None else port.maximum
    span = "" if math.isinf(low) and math.isinf(high) else f"{low:g} to {high:g}"
    start = "" if word == "output" else f"{bool(port.start)}".lower() if port.boolean else f"{port.start:g}"
    unit = "Boolean" if port.boolean else port.unit
    note = " NaN: not measured." if port.missing else ""
    cells = (port.name, f"tunable {word}" if port.tunable else word, unit, start, span, port.description + note)
    return "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"


_HEADINGS = {
    "plant": "How it was identified",
    "observer": "How it was designed",
    "controller": "How it was designed",
    "reference": "The reference",
}

_LIMITS = {
    "plant": (
        "An identified plant is valid within its training data: other payloads, other tendons and slower or faster "
        "motions are extrapolation. In simulation (free run) its errors are not corrected by measurements."
    ),
    "observer": "It assumes the linear plant of its design; far from there its innovation is large.",
    "controller": "It was designed on a linear plant; verify the loop on the virtual neck before using it on hardware.",
}
_KIND_LIMITS = {
    "virtual_neck": (
        "It is a simple model: its parameters are the paper's or yours and were not measured, its friction and its "
        "link are simplified. Results on it must be confirmed on hardware."
    )
}


# Of the default experiment: 10 s of the neck.
_SHOWN_SAMPLES = 500
# Kinds whose array `delay` holds dead times [samples].
_WITH_DEAD_TIME = ("rls", "oe")


class Buildable(Protocol):
    """An object that can be exported as an FMU."""

    def block(self) -> Block:
        """Return the block to export."""
        ...

    def summary(self) -> str:
        """Return a few lines on the object."""
        ...


def buildable(thing: Buildable | Block | str | Path, robot: str | Path | Robot | None = None) -> Any:
    """Return the object with a block: itself, or read from a softneck file, a neck or robot file, or a preset.

    Raises FileFormatError: a file without a block; SettingsError: not a file, a preset or an object with a block.
    """
    thing = own_object(thing)
    if not isinstance(thing, str | Path):
        if isinstance(thing, Block) or (hasattr(thing, "block") and not isinstance(thing, type)):
            return thing
        if isinstance(thing, NeckParameters):
            return VirtualNeck(thing)
        raise SettingsError(f"a model, observer, controller, neck or its file is needed; got a {type(thing).__name__}.")
    name, path = str(thing), Path(thing)
    if path.suffix == ".npz":
        found = load_for_robot(path, robot=robot)
        if not hasattr(found, "block"):
            raise FileFormatError(f"{path}: is not a model, observer or controller.")
        return found
    if path.suffix not in ("", ".toml"):
        raise FileFormatError(
            f"{path}: no FMU can be built from a `{path.suffix}` file; give a model, controller or observer "
            "(.npz), a neck, robot or loop file (.toml), or a preset (paper, lab, rough, trunk)."
        )
    if name in ROBOT_PRESETS:
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
    """Return the block to export and the texts of its FMU: `info`, or those of `fmu_info`."""
    found = buildable(thing)
    if isinstance(found, Block):
        return found, info or FmuInfo()
    # A block alone has no summary.
    return found.block(), info or (fmu_info(found) if hasattr(found, "summary") else FmuInfo())


def fmu_info(
    thing: Buildable, *, scores: str = "", validation: Validation | None = None, stop_time: float | None = None
) -> FmuInfo:
    """Return the texts of an FMU of `thing`: its origin, scores and limits; of a model also its fit on rows held out.

    Args:
        thing: model, observer, controller or neck.
        scores: as plain text.
        validation: of a model on data that it was not trained on; its fits are included.
        stop_time: of the default experiment [s]; 500 samples if not given.
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
        parts += ["<h2>Scores</h2>", _fits(validation)]
    # The summary has the fit on the rows held out.
    elif isinstance(thing, Model) and not scores and not thing.findings.get("hold_out"):
        parts.append("<h2>Scores</h2><p>None were given when this FMU was built (softneck fmu --data).</p>")
    robot: Any = getattr(thing, "robot", None)
    limits = _KIND_LIMITS.get(block.kind, _LIMITS.get(block.role, ""))
    if limits:
        parts.append(f"<h2>Limits of use</h2><p>{limits}</p>")
    return FmuInfo(
        description=_model_line(thing, block) if isinstance(thing, Model) else _without_sources(summary, block),
        author="softneck",
        license="BSD-3-Clause (runtime); the model is its author's",
        documentation="\n".join(parts),
        stop_time=_SHOWN_SAMPLES * block.sample_time if stop_time is None else stop_time,
        robot=(robot.name, robot.hash) if robot is not None and robot.in_header() else None,
    )


def _model_line(model: Model, block: Block) -> str:
    """Return what a model is, in one line: signals with units, method, sample time, dead time, fit."""
    robot = model.robot
    delays = np.ravel(model.arrays["delay"]) if model.kind in _WITH_DEAD_TIME else np.zeros(0)
    # In state space the first is the dead time of all outputs, and a flag stands beside it.
    delays = delays[:1] if "K" in model.arrays else delays
    dead = "/".join(f"{d * model.sample_time:.3g}" for d in sorted(set(delays)))
    fits = model.findings.get("hold_out", {}).get("fit", {})
    said = [
        f"plant: {len(robot.set_points)} motor set-point{'s' * (len(robot.set_points) > 1)} [{robot.motors.unit}] -> "
        f"{', '.join(robot.outputs.names)} [{robot.outputs.display_unit}]",
        _without_sources(KINDS[model.kind].summary, block),
        f"{1e3 * model.sample_time:g} ms",
        f"dead time {dead} s" if dead else "",
        f"simulation fit {'/'.join(map(percent, fits.values()))} % on rows held out" if fits else "",
    ]
    return "; ".join(filter(None, said))


def _without_sources(text: str, block: Block) -> str:
    """Return the first line of a text without the numbers of the paper's equations and sections."""
    line = text.splitlines()[0] if text else block.kind
    return re.sub(r" \((?:Eq\.|section) [^)]*\)", "", line)


def _fits(validation: Validation) -> str:
    rows = []
    for name, scores in (("persistence", validation.persistence), ("this model", validation.fits)):
        for horizon, fit in scores.items():
            cells = "".join(f"<td>{_percent(fit.get(axis))}</td>" for axis in validation.robot.outputs.names)
            ahead = {"inf": "simulation (free run)", "1": "one sample ahead"}.get(horizon, f"{horizon} samples ahead")
            rows.append(f"<tr><td>{name}</td><td>{ahead}</td>{cells}</tr>")
    head = (
        f"<tr><th></th><th></th>{''.join(f'<th>{escape(axis)}</th>' for axis in validation.robot.outputs.names)}</tr>"
    )
    diverged = "" if validation.diverged is None else f" Its simulation diverged at t = {validation.diverged:g} s."
    return (
        f"<p>NRMSE fit in %, on {validation.rows_scored} rows of {escape(validation.data)}; "
        f"{validation.rows_left_out} rows that it was trained on are left out.{diverged}</p>"
        f"<table>{head}{''.join(rows)}</table>"
    )


def _percent(fit: float | None) -> str:
    return "-" if fit is None else f"{fit:.2f}"
