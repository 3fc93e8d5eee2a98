"""Step 4 of the demo: every model and the neck as FMUs, each equal to its Python model in free run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softneck.core import Matrix, Progress, atomic_write
from softneck.cosim import Result, load_loop, simulate, simulate_fmu_free_run
from softneck.design import LinearController, PiSettings
from softneck.estimation import KalmanObserver, KalmanSettings
from softneck.fmu import build_fmu, fmu_info
from softneck.fmu.describe._describe import Buildable
from softneck.identification import Model
from softneck.loop import default_limits
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


# 15 deg as in the lab's own tests.
_STEPS = {"pitch_step": (15.0, 0.0), "roll_step": (0.0, 15.0), "oblique_step": (10.6, 10.6)}

_LOOP = """# Written by `softneck demo`; run it again with `softneck simulate {name}.toml`.
duration_s = 8.0
sample_time_s = {sample_time:g}

[plant]
fmu = "../fmus/VirtualNeck.fmu"
parameters = {{ noise_seed = 5 }}

[observer]
fmu = "../fmus/Kalman.fmu"

[controller]
fmu = "../fmus/Pi.fmu"

[reference]
kind = "step"
pitch_deg = {pitch}
roll_deg = {roll}
at_s = 1.0

[limits]
{limits}
"""


@dataclass(frozen=True, slots=True, eq=False)
class DemoDesign:
    """The controller and the observer of the demo."""

    controller: LinearController
    observer: KalmanObserver


def design(model: Model, fmus: Path) -> DemoDesign:
    """Design both on an identified linear model and package them as FMUs in folder `fmus`."""
    controller = PiSettings().design(model)
    observer = KalmanSettings(sensor="paper").design(model)
    build_fmu(controller.block(), fmus / "Pi.fmu", info=fmu_info(controller), force=True)
    build_fmu(observer.block(), fmus / "Kalman.fmu", info=fmu_info(observer), force=True)
    return DemoDesign(controller, observer)


def close_loops(folder: Path, *, sample_time: float, tell: Tell) -> dict[str, Result]:
    """Write the loop files to `folder` and simulate each."""
    report = tell("close the loop over FMUs")
    results: dict[str, Result] = {}
    for number, (name, (pitch, roll)) in enumerate(_STEPS.items()):
        path = folder / f"{name}.toml"
        text = _LOOP.format(name=name, sample_time=sample_time, pitch=pitch, roll=roll, limits=_limits(pitch, roll))
        with atomic_write(path, force=True) as temporary:
            temporary.write_text(text, encoding="utf-8")
        results[name] = simulate(load_loop(path), report=_part(report, number, name))
    return results


def _limits(pitch: float, roll: float) -> str:
    stepped = [axis for axis, size in (("pitch", pitch), ("roll", roll)) if size]
    lines = [f'"{axis}.{metric}" = {limit}' for axis in stepped for metric, limit in default_limits.LOOP.items()]
    # An axis without a step shall stay where it is.
    lines += [f'"{axis}.rms_error_deg" = 1.0' for axis, size in (("pitch", pitch), ("roll", roll)) if not size]
    return "\n".join(lines)


def _part(report: Progress, number: int, name: str) -> Callable[[float], None]:
    return lambda done: report((number + done) / len(_STEPS), name)


def limits_of(results: Mapping[str, Result]) -> list[tuple[str, dict]]:
    """Return all limits of all loops, each with its loop's name."""
    return [(name, row) for name, result in results.items() for row in result.limits]
