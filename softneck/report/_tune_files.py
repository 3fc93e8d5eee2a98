"""The folder of a tuning: the best controller with what belongs to it, the front as tables, and the page."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from softneck.core import atomic_write, file_hash, write_certificate
from softneck.loop import error_unit
from softneck.plots import write_page
from softneck.verification import nominal_plants, sources_of, write_linear

from ._tune_page import tune_page

if TYPE_CHECKING:
    from softneck.tuning import Candidate, Tuned

BEST, OBSERVER, CERTIFICATE, LOOP = "best.npz", "observer.npz", "best.certificate.json", "loop.toml"
_LOOP_AT, _LOOP_TAUT = 1.0, 3.0


def write_tuned(
    found: Tuned, folder: Path, files: Mapping[str, Path], steps: Mapping[str, Path | str]
) -> dict[str, Any]:
    """Write all files of a tuning and return its JSON values.

    Args:
        found: what came of it.
        folder: where; what an earlier run left there is replaced, and a certificate that no longer holds removed.
        files: role -> path of what was read, for the certificate.
        steps: name -> file, or the preset's name, of the simulation models.
    """
    found.controller.save(folder / BEST, force=True)
    if found.observer is not None:
        found.observer.save(folder / OBSERVER, force=True)
    requirements = folder / "requirements.toml"
    _write(requirements, tomli_w.dumps(_told(found.task.asked.table)))
    read = {"controller": folder / BEST, "requirements": requirements, **files}
    verification = replace(
        found.verification, files={role: (str(path), file_hash(path)) for role, path in read.items()}
    )
    certificate = folder / CERTIFICATE
    if found.holds:  # those of [track] too, which `verify` does not look at
        write_certificate(certificate, {**verification.contents(), "loosened": _loosened(found)}, force=True)
    else:
        certificate.unlink(missing_ok=True)
    _write_loop(found, folder, steps)
    values = tuned_values(found, folder / BEST)
    _write(folder / "pareto.json", json.dumps(values["pareto"], indent=1) + "\n")
    _write(folder / "pareto.csv", _csv(found))
    write_page(folder / "report.html", tune_page(found), force=True)
    return values


def tuned_values(found: Tuned, path: Path) -> dict[str, Any]:
    """Return the JSON values of a tuning."""
    return {
        "best": {"kind": found.best.kind, "file": str(path), "metrics": _metrics(found.best), "holds": found.holds,
                 "settings": dict(found.best.settings)},
        "pareto": [{"kind": item.kind, "settings": dict(item.settings), "metrics": _metrics(item)}
                   for item in found.front],
        "binding": found.binding,
        "requirements": found.task.asked.lines(),
        "loosened": _loosened(found),
        "evaluations": found.evaluations,
        "dropped": dict(found.dropped),
    }  # fmt: skip


def _loosened(found: Tuned) -> dict[str, dict[str, float]]:
    return {metric: asdict(one) for metric, one in found.loosened.items()}


def _metrics(item: Candidate) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in sorted(item.metrics.items())}


def _csv(found: Tuned) -> str:
    """Return the front as a table: kind, settings as JSON, objectives, then all other metrics."""
    names = [*found.objectives, *sorted({n for item in found.front for n in item.metrics} - set(found.objectives))]
    lines = [",".join(["kind", *names, "settings"])]
    for item in found.front:
        settings = json.dumps(dict(item.settings), sort_keys=True).replace('"', '""')
        values = [f"{item.metrics[name]:.6g}" if name in item.metrics else "" for name in names]
        lines.append(",".join([item.kind, *values, f'"{settings}"']))
    return "\n".join(lines) + "\n"


def _write_loop(found: Tuned, folder: Path, steps: Mapping[str, Path | str]) -> None:
    """Write a loop file with the best: over the first simulation model, or over the nominal linear one."""
    task = found.task
    robot = task.robot
    if not steps:
        source = sources_of(task.linear, task.asked.certificate)[0]
        plant = nominal_plants([source])[0]
        facts = {"name": plant.names[0], "numerator": plant.numerator[0].tolist(),
                 "denominator": plant.denominator[0].tolist(), "delay": plant.delay[0].tolist(),
                 "cross": plant.cross[0].tolist(), "sample_time": plant.sample_time, "axis": 0}  # fmt: skip
        write_linear(folder, "loop", facts, controller=folder / BEST, asked=task.asked.certificate,
                     block=found.controller.block(), weights=source.weights, force=True)  # fmt: skip
        return
    name, path = next(iter(steps.items()))
    taut = task.cocontraction is not None
    at = _LOOP_TAUT if taut else _LOOP_AT
    neck = task.asked.certificate.sim
    first, unit = robot.outputs.names[0], error_unit(robot)[0]
    table: dict[str, Any] = {
        "duration_s": at + float(neck["duration_s"]),
        "plant": {_plant_key(path): _relative(path, folder)},
        **({"observer": {"file": OBSERVER}} if found.observed else {}),
        "controller": {"file": BEST},
        "reference": {"kind": "step", f"{first}_{unit}": float(neck["size_deg"]), "at_s": at},
    }  # fmt: skip
    if any(plant.payload and plant.name == name for plant in found.own):
        table["plant"]["parameters"] = {"payload": float(max(neck["payloads_kg"]))}
    if taut and "least_cocontraction" not in found.best.settings:
        table["reference"]["cocontraction"] = task.said_cocontraction
    asked = {b.metric.partition(".")[2]: b.limit for b in task.asked.bounds
             if b.metric.startswith("sim.") and b.bound != "min" and not b.metric.endswith("slack_s")}  # fmt: skip
    known = ("rise_s", "steady_rms_") + (("overshoot_pct", "settling_s") if task.asked.told() else ())
    table["limits"] = {f"{first}.{key}": limit for key, limit in asked.items() if key.startswith(known)}
    words = "" if found.observed else (
        "\n# Without observer.npz: with it in the loop a requirement on the steps breaks, or there is none."
    )  # fmt: skip
    _write(folder / LOOP, f"# The best of `softneck tune` over {name}.{words}\n{tomli_w.dumps(table)}")


def _plant_key(path: Path | str) -> str:
    text = str(path)
    return "fmu" if text.endswith(".fmu") else "model" if text.endswith(".npz") else "neck"


def _relative(path: Path | str, folder: Path) -> str:
    return path if isinstance(path, str) else Path(os.path.relpath(path, folder)).as_posix()


def _told(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table for TOML: what is a number or text in it stays, what is nothing is left out."""
    return {key: dict(value) if isinstance(value, Mapping) else value for key, value in table.items() if value != {}}


def _write(path: Path, text: str) -> None:
    with atomic_write(path, force=True) as temporary:
        temporary.write_text(text, encoding="utf-8")
