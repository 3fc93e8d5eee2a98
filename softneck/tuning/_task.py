"""The task of a search, and the log of its judgements on disk."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np

from softneck.core import (
    KINDS,
    MOST_JSON,
    FileFormatError,
    OutputFileError,
    Vector,
    atomic_write,
    require_header,
    resolve,
    settings_text,
    to_si,
)
from softneck.design import uncertain_plant
from softneck.identification import Model
from softneck.robot import Robot
from softneck.verification import Requirement

from ._requirements import TuneRequirements

#: Margins by experiment.
MARGINS = ("axes.gain_margin", "axes.delay_margin_ms")


def has_observer(kind: str) -> bool:
    """Return whether a kind is designed for an observer in its loop."""
    return hasattr(resolve(KINDS[kind].settings), "over")


def _closer(item: Requirement, kept: float) -> Requirement:
    """Return a requirement whose limit is closer, unless nothing could meet it."""
    if item.bound == "min":
        return replace(item, limit=item.limit + kept)
    return replace(item, limit=item.limit - kept) if item.limit > kept else item


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Task:
    """Data that a worker needs to judge a candidate.

    Attributes:
        digest: of the fields below; workers cache by it.
        linear: name -> linear model or family.
        own: name -> simulation model.
        asked: the requirements.
        robot: of the controller.
        cocontraction: in the loops [SI unit of the motors]; None: by the controller's own rule.
        seed: of the noise.
        observer: in the loops of `mpc` and `nmpc`; None for none.
        drawn: names of those in `own` that are draws of a family; certificates have others.
        hardest: family -> numbers of its draws on which a start does worst, those of every loop of the search.
    """

    digest: str
    linear: Mapping[str, Any]
    own: Mapping[str, Any]
    asked: TuneRequirements
    robot: Robot
    cocontraction: float | None = None
    seed: int
    observer: Any = None
    drawn: tuple[str, ...] = ()
    hardest: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def bounds(self) -> tuple[Requirement, ...]:
        """Requirements of the search: where draws decide, of linear ones those stated, the margins and the load."""
        linear, kept = ("axes.", "mimo.", "robust.", "stability.", "step."), (*MARGINS, "step.load_rms_")
        return tuple(
            item for item in self.asked.bounds
            if not self.drawn or item.asked or item.metric.startswith(kept) or not item.metric.startswith(linear)
        )  # fmt: skip

    @property
    def aims(self) -> tuple[Requirement, ...]:
        """Requirements of the search: closer by what it keeps for draws that it does not see."""
        return self._closer(1.0)

    @property
    def final_aims(self) -> tuple[Requirement, ...]:
        """Requirements of final candidates, which are judged on as many draws as a certificate: half as much closer."""
        return self._closer(0.5)

    def _closer(self, part: float) -> tuple[Requirement, ...]:
        return tuple(_closer(item, part * self.asked.kept.get(item.metric, 0.0)) for item in self.bounds)

    @property
    def said_cocontraction(self) -> float | None:
        """Co-contraction in the unit of the robot's motors, as in settings and loop files."""
        factor = to_si(self.robot.motors.unit)[0]
        return None if self.cocontraction is None else float(f"{self.cocontraction / factor:.4g}")

    @property
    def tested(self) -> bool:
        """Whether a family that was tested against its recordings decides by its weight, and not by draws."""
        return not self.drawn and any(getattr(thing, "measured", {}) for thing in self.linear.values())

    @property
    def models(self) -> list[Model]:
        """Nonlinear models among the simulation models."""
        return [thing for thing in self.own.values() if isinstance(thing, Model)]

    @property
    def plant(self) -> Any:
        """Linear plants of the design; the first of several is the nominal plant."""
        sources = list(self.linear.values())
        return sources[0] if len(sources) == 1 else sources


@dataclass(frozen=True, slots=True)
class Judgement:
    """Result of a candidate at one level.

    `metrics`: name -> value; inf where a level is never reached. `error`: why there are no metrics, or "". `curves`:
    name -> values of its step and circle for a page, at the times of `curve_times`; empty for most levels.
    """

    metrics: Mapping[str, float]
    error: str = ""
    curves: Mapping[str, list[float]] = field(default_factory=dict)


FILE = "evaluations.json"
_LOG_FORMAT = 1
# Samples of a curve, denser at the start of a step, and angles of a circle.
_CURVE_SAMPLES, _CIRCLE_SAMPLES = 80, 49


def curve_times(task: Task) -> Vector:
    """Return the times after a step [s] at which curves are kept, denser at the start; shape (n,)."""
    certificate = task.asked.certificate
    duration = float((certificate.sim if task.own else certificate.step)["duration_s"])
    return duration * np.linspace(0.0, 1.0, _CURVE_SAMPLES) ** 2


def circle_angles() -> Vector:
    """Return the angles [rad] at which the radius of a circle is kept; shape (n,)."""
    return np.linspace(-math.pi, math.pi, _CIRCLE_SAMPLES)


@dataclass(frozen=True, slots=True)
class Job:
    """One candidate at one of the `LEVELS`; `settings` is a JSON text with sorted keys."""

    kind: str
    settings: str
    level: str

    @classmethod
    def of(cls, kind: str, settings: Mapping[str, Any], level: str) -> Job:
        """Return the job of a candidate."""
        return cls(kind, json.dumps(dict(settings), sort_keys=True), level)


class Log:
    """Judgements of a search, in the order of the requests.

    `folder`: of the search; None: nothing is written. `found`: job -> judgement.
    """

    def __init__(self, folder: Path | None, digest: str, *, force: bool = False) -> None:
        """Start a log, or continue that of the same search; without `force` another one raises OutputFileError."""
        self.folder, self._digest = folder, digest
        self.found: dict[Job, Judgement] = {}
        if folder is None or not (folder / FILE).is_file():
            return
        content = _read(folder / FILE)
        if content.get("digest") == digest:
            for row in content["evaluations"]:
                if row["error"] or "curves" not in row:
                    continue  # try it again: a later softneck may succeed, and earlier ones kept no curves
                self.found[Job(row["kind"], row["settings"], row["level"])] = Judgement(
                    {name: math.inf if value is None else float(value) for name, value in row["metrics"].items()},
                    curves={name: [float(value) for value in values] for name, values in row["curves"].items()},
                )
        elif not force:
            raise OutputFileError(
                f"{folder}: holds a search over other plants, requirements, kinds or seed; choose another folder, or "
                "--force replaces it."
            )

    def write(self) -> None:
        """Replace the file as a whole."""
        if self.folder is None:
            return
        rows = [
            {"kind": job.kind, "settings": job.settings, "level": job.level, "error": item.error,
             "metrics": {name: value if math.isfinite(value) else None for name, value in item.metrics.items()},
             "curves": dict(item.curves)}
            for job, item in self.found.items()
        ]  # fmt: skip
        told = json.dumps({"format": _LOG_FORMAT, "digest": self._digest})
        text = told[:-1] + ', "evaluations": [\n' + ",\n".join(map(json.dumps, rows)) + "\n]}"
        with atomic_write(self.folder / FILE, force=True) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")


_ROW = {"kind": str, "settings": str, "level": str, "error": str, "metrics": {str: (float, None)},
        "curves": {str: [float]}}  # fmt: skip
_CURVES = {"low", "high", "value", "reference"}


def _check_row(row: Any, where: str) -> None:
    """Raise an error where an evaluation lacks a key, or has a value or a curve of another shape."""
    require_header(row, _ROW, where)
    if absent := _ROW.keys() - {"curves"} - row.keys():
        raise ValueError(f"{where} has no {min(absent)}")
    curves = row.get("curves", {})
    if curves and not curves.keys() >= _CURVES:
        raise ValueError(f"{where}.curves has no {min(_CURVES - curves.keys())}")
    for name, values in curves.items():
        wanted = 1 if name == "reference" else _CIRCLE_SAMPLES if name.startswith("circle") else _CURVE_SAMPLES
        if len(values) != wanted:
            raise ValueError(f"{where}.curves.{name} has {len(values)} values instead of {wanted}")


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(settings_text(path, MOST_JSON))
        if content["format"] != _LOG_FORMAT or not isinstance(content["evaluations"], list):
            raise ValueError("another format")
        for number, row in enumerate(content["evaluations"]):
            _check_row(row, f"evaluations[{number}]")
    except (OSError, ValueError, KeyError, TypeError, RecursionError, FileFormatError) as error:
        raise FileFormatError(
            f"{path}: is no log of a search that this softneck reads ({error}); remove it to search anew."
        ) from error
    return content


def digest_of(task: Task, kinds: Sequence[str], files: Mapping[str, tuple[str, str]] | None) -> str:
    """Return the digest of a task, from its files, or from its plants where `files` is None.

    `files` is role -> (path, SHA-256).
    """
    asked = task.asked
    told = {
        "asked": [(b.metric, b.bound, b.limit, b.asked) for b in asked.bounds], "track": dict(asked.track),
        "tables": [dict(getattr(asked.certificate, name)) for name in ("uncertainty", "sampling", "step", "sim")],
        "kinds": list(kinds), "seed": task.seed, "robot": task.robot.as_dict(), "plants": [*task.linear, *task.own],
        "observer": _observer(task, kinds),
        "files": None if files is None else [digest for _, digest in files.values()],
    }  # fmt: skip
    found = hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode())
    for part in _plants(task) if files is None else ():
        found.update(part)
    return found.hexdigest()


def _observer(task: Task, kinds: Sequence[str]) -> str:
    """Return the digest of the observer, or "" where no kind has one."""
    if task.observer is None or not any(map(has_observer, kinds)):
        return ""
    return hashlib.sha256(b"".join(_of_block(task.observer.block()))).hexdigest()


def _plants(task: Task) -> Iterator[bytes]:
    """Yield the numbers of the plants, independent of how objects store them."""
    for axis in uncertain_plant(task.plant).axes.values():
        for plant in axis.samples:
            yield np.concatenate([plant.numerator, plant.denominator, [plant.delay, plant.sample_time]]).tobytes()
    for thing in task.linear.values():
        findings = getattr(thing, "findings", {})
        yield json.dumps([findings.get("tested"), findings.get("directions")], sort_keys=True, default=str).encode()
    for thing in task.own.values():
        if hasattr(thing, "block"):
            yield from _of_block(thing.block())
        elif hasattr(thing, "arrays"):
            yield from _of_block(thing)
        else:
            yield cloudpickle.dumps(thing)  # a user's function: its bytes are compared, never loaded


def _of_block(block: Any) -> Iterator[bytes]:
    yield repr([block.runtime, block.sample_time, [(port.name, port.start) for port in block.parameters]]).encode()
    for array in block.arrays:
        yield np.ascontiguousarray(array).tobytes()
