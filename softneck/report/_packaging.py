"""Step 4 of the demo: every model and the neck as FMUs, each equal to its Python model in free run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softneck.core import Matrix
from softneck.cosim import simulate_fmu_free_run
from softneck.fmu import build_fmu, fmu_info
from softneck.fmu.describe._describe import Buildable
from softneck.runtime import Block
from softneck.signals import Recording

from ._experiments import Tell

# A free run in another process feeds its rounding back; what is left of it stays far below a micro-degree.
TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class PackagedFmu:
    """An FMU and how far its free run is from the Python model's.

    Attributes:
        path: of the FMU.
        rows: samples compared.
        difference: the largest over all outputs, in their SI units.
    """

    path: Path
    rows: int
    difference: float

    @property
    def equal(self) -> bool:
        """Whether the FMU is the model."""
        return self.difference <= TOLERANCE


def package(
    things: Mapping[str, Buildable], folder: Path, recording: Recording, *, scores: Mapping[str, str], tell: Tell
) -> dict[str, PackagedFmu]:
    """Build an FMU of each plant and compare their free runs over `recording` with Python's."""
    report = tell("build FMUs and compare free runs")
    packaged: dict[str, PackagedFmu] = {}
    for number, (name, thing) in enumerate(things.items()):
        report(number / len(things), name)
        info = fmu_info(thing, scores=scores.get(name, ""), stop_time=30.0)
        path = build_fmu(thing.block(), folder / f"{_camel(name)}.fmu", info=info, force=True)
        table = simulate_fmu_free_run(path, recording)
        difference = float(np.abs(table - python_free_run(thing.block(), recording)).max())
        packaged[name] = PackagedFmu(path, len(recording), difference)
    return packaged


def python_free_run(block: Block, recording: Recording) -> Matrix:
    """Return a plant's outputs (time, n_out) from rest, by a recording's set-points; row 0 is the start."""
    start = block.initial_state()
    inputs = np.tile([port.start for port in block.inputs], (len(recording), 1))
    inputs[:, :3] = recording.set_points
    _, outputs = block.run(start, inputs)
    return np.vstack([start.outputs, outputs[:-1]])


def _camel(name: str) -> str:
    return "".join(word.capitalize() for word in name.split("_"))
