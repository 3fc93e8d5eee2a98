"""The files of a project around a loop that is there: its own loop over FMUs, a study and a test."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import tomli_w

from softneck.core import FileFormatError, SettingsError, read_toml, to_si
from softneck.robot import Robot, find_robot

from ._plan import CONTROLLER_FMU, OBSERVER_FMU, PLANT_FMU

# Of the project that `softneck new` makes of the virtual neck.
_SHARED = {"pyproject.toml": "pyproject.toml", ".gitignore": "gitignore"}
_OWN = {"README.md": "README.md", "test_closed_loop.py": "test_closed_loop.py"}
# In [reference], but the sizes of the step, which a study varies.
_NO_SIZES = ("kind", "at_s", "cocontraction", "rise_s")
_PARTS_OF_STEP = (0.4, 0.7, 1.0)
_STUDY_RUNS = 30


def project_of_loop(loop_file: Path, folder: Path) -> dict[str, str]:
    """Return file name -> text of a project around the loop that `softneck tune` wrote.

    Parts of the loop are taken from `fmus/`; the robot in `folder` says how noisy its sensor is.
    """
    robot = find_robot(beside=folder / "loop.toml")
    loop = _over_fmus(_read(loop_file), robot)
    texts = {name: _text("softneck.cli", source) for name, source in _SHARED.items()}
    texts |= {name: _text("softneck.cli.start", source) for name, source in _OWN.items()}
    said = "# The loop that `softneck tune` judged, over FMUs that need no Python.\n"
    return {**texts, "loop.toml": said + tomli_w.dumps(loop), "study.toml": tomli_w.dumps(_study(loop, robot))}


def _text(package: str, name: str) -> str:
    return files(package).joinpath("template", f"{name}.txt").read_text(encoding="utf-8")


def _read(path: Path) -> dict[str, Any]:
    table = read_toml(path)
    if not all(isinstance(table.get(part), dict) for part in ("plant", "controller", "reference")):
        raise FileFormatError(f"{path}: is no loop file: [plant], [controller] and [reference] are needed.")
    if table["reference"].get("kind") != "step":
        raise SettingsError(f"{path}: a project is made around a loop with a step; take the loop.toml of `tune`.")
    return table


def _over_fmus(table: dict[str, Any], robot: Robot) -> dict[str, Any]:
    noise = robot.noise_std
    # The FMU's parameter is in SI. Seeds of runs are drawn by the study.
    parameters = (
        {} if noise is None
        else {"parameters": {"noise_std": noise * to_si(robot.outputs.unit)[0], "noise_seed": 1}}
    )  # fmt: skip
    eyes = {"observer": {"fmu": OBSERVER_FMU}} if "observer" in table else {}
    reference = dict(table["reference"])
    if "pitch_deg" in reference and "roll" in robot.outputs.names and _sizes(table):
        reference.setdefault("roll_deg", 0.0)
    kept = {key: value for key, value in table.items() if key not in ("plant", "observer", "controller", "reference")}
    limits = {"limits": kept.pop("limits")} if kept.get("limits") else {}
    kept.pop("limits", None)
    return {**kept, "plant": {"fmu": PLANT_FMU, **parameters}, **eyes, "controller": {"fmu": CONTROLLER_FMU},
            "reference": reference, **limits}  # fmt: skip


def _sizes(table: dict[str, Any]) -> dict[str, float]:
    """Return which keys of [reference] are sizes of the step, and how large they are."""
    reference = table["reference"].items()
    return {key: float(value) for key, value in reference
            if key not in _NO_SIZES and isinstance(value, int | float) and value}  # fmt: skip


def _study(loop: dict[str, Any], robot: Robot) -> dict[str, Any]:
    from softneck.loop import metric_names

    vary: dict[str, Any] = {
        f"reference.{key}": {"grid": [round(part * size, 6) for part in _PARTS_OF_STEP]}
        for key, size in _sizes(loop).items()
    }
    if {"pitch_deg", "roll_deg"} <= loop["reference"].keys():
        half = 0.5 * float(loop["reference"]["pitch_deg"])
        vary["reference.roll_deg"] = {"uniform": [-half, half]}
    if "parameters" in loop["plant"]:
        vary["plant.parameters.noise_seed"] = {"seed": True}
    first = next((key.partition(".")[0] for key in loop.get("limits", {})), robot.outputs.names[0])
    moves = next(name for name in metric_names(robot) if name.startswith("motors.total_variation_"))
    objectives = [f"{first}.settling_s", moves]
    return {"loop": "loop.toml", "runs": _STUDY_RUNS, "seed": 1, "objectives": objectives, "vary": vary}
