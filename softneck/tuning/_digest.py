"""A name for all that a search depends on but its budget: what a log was made of is known by it again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import cloudpickle
import numpy as np

from softneck.design.plants._uncertain import uncertain_plant
from softneck.plant import NeckParameters

from ._task import Task, has_observer


def digest_of(task: Task, kinds: Sequence[str], files: Mapping[str, tuple[str, str]] | None) -> str:
    """Return the digest of a task: of its files where all plants come from some, else of what the plants are.

    Args:
        task: plants, requirements, robot and seed.
        kinds: that are searched.
        files: role -> (path, SHA-256) of what was read; None where plants were made in Python.
    """
    asked = task.asked
    told = {
        "asked": [(b.metric, b.bound, b.limit, b.asked) for b in asked.bounds], "track": dict(asked.track),
        "tables": [dict(getattr(asked.certificate, name)) for name in ("uncertainty", "sampling", "step", "neck")],
        "kinds": list(kinds), "seed": task.seed, "robot": task.robot.hash, "plants": [*task.linear, *task.own],
        "observer": _observer(task, kinds),
        "files": None if files is None else [digest for _, digest in files.values()],
    }  # fmt: skip
    found = hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode())
    for part in _plants(task) if files is None else ():
        found.update(part)
    return found.hexdigest()


def _observer(task: Task, kinds: Sequence[str]) -> str:
    """Return the digest of the observer; "" where no kind has one."""
    if task.observer is None or not any(map(has_observer, kinds)):
        return ""
    return hashlib.sha256(b"".join(_of_block(task.observer.block()))).hexdigest()


def _plants(task: Task) -> Iterator[bytes]:
    """Yield what makes the plants: numbers, and never how an object happens to be laid out."""
    for axis in uncertain_plant(task.plant).axes.values():
        for plant in axis.samples:
            yield np.concatenate([plant.numerator, plant.denominator, [plant.delay, plant.sample_time]]).tobytes()
    for thing in task.linear.values():
        tested = getattr(thing, "findings", {}).get("tested")
        yield json.dumps(tested, sort_keys=True, default=str).encode()
    for thing in task.own.values():
        if isinstance(thing, NeckParameters):
            yield repr(dataclasses.astuple(thing)).encode()
        elif hasattr(thing, "block"):
            yield from _of_block(thing.block())
        elif hasattr(thing, "arrays"):
            yield from _of_block(thing)
        else:
            yield cloudpickle.dumps(thing)  # a function of the user's: its bytes are compared, never read


def _of_block(block: Any) -> Iterator[bytes]:
    yield repr([block.runtime, block.sample_time, [(port.name, port.start) for port in block.parameters]]).encode()
    for array in block.arrays:
        yield np.ascontiguousarray(array).tobytes()
