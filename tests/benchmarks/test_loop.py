"""Own overhead of a loop's step, over C FMUs that cost next to nothing, beside other routes in the same run.

Run with `pytest tests/benchmarks/test_loop.py --benchmark-only`; figures are for 5,000 steps: 15 us a step are 75 ms.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from time import process_time
from typing import Any

import fmpy
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from softneck.core import Vector
from softneck.cosim import FmuPart, simulate, write_ssp
from softneck.fmu import unpacked
from softneck.loop import Loop
from softneck.runtime import Port

from ..cosim._foreign import NAMES, build_foreign
from ..references import StepReference

STEPS, TS = 5_000, 0.02
# Processor time: other work on the machine shall not count.
pytestmark = pytest.mark.benchmark(timer=process_time)


class PController:
    """Motor 1 = pitch error, motor 2 = roll error."""

    role, sample_time = "controller", TS
    inputs = tuple(Port(name=name, unit="rad") for name in ("pitch_reference", "roll_reference", "pitch", "roll"))
    outputs = tuple(Port(name=f"motor_setpoint_{j}", unit="rad") for j in (1, 2, 3))

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:  # noqa: ARG002
        return np.zeros(3)

    def advance(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002
        return np.array([inputs[0] - inputs[2], inputs[1] - inputs[3], 0.0])

    def close(self) -> None: ...


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_foreign(tmp_path_factory.mktemp("foreign"), 2)


def three(foreign: Path) -> Loop:
    """Three of the C FMUs in the places of plant, observer and controller."""
    observer = {"u1": "pitch_measured", "u2": "roll_measured", "u3": "motor_setpoint_3"}
    controller = {"u1": "pitch_reference", "u2": "pitch", "u3": "roll"}
    return Loop(
        plant=FmuPart(foreign, role="plant", sample_time=TS, names=NAMES),
        observer=FmuPart(
            foreign, role="observer", sample_time=TS, names={**observer, "alpha": "pitch", "beta": "roll"}
        ),
        controller=FmuPart(
            foreign, role="controller", sample_time=TS,
            names={**controller, "alpha": "motor_setpoint_1", "beta": "motor_setpoint_2"},
        ),
        connections={
            "plant.motor_setpoint_3": "controller.motor_setpoint_2",
            "observer.motor_setpoint_3": "controller.motor_setpoint_2",
        },
        # Gains so small that the loop of three plants is stable.
        plant_parameters={"k": 0.1}, observer_parameters={"k": 0.1}, controller_parameters={"k": 0.1},
        reference=StepReference(pitch=0.1), duration=STEPS * TS, order="jacobi",
    )  # fmt: skip


def test_plant_fmu_and_python_controller(benchmark: BenchmarkFixture, foreign: Path) -> None:
    plant = FmuPart(foreign, role="plant", sample_time=TS, names=NAMES)
    loop = Loop(plant=plant, controller=PController(), reference=StepReference(pitch=0.1), duration=STEPS * TS)
    result = benchmark(simulate, loop, keep=True)
    loop.close()
    assert result.signals.time.size == STEPS


def test_three_fmus(benchmark: BenchmarkFixture, foreign: Path) -> None:
    loop = three(foreign)
    result = benchmark(simulate, loop, keep=True)
    loop.close()
    assert np.isfinite(result["pitch"]).all()


def test_fmpys_step_finished_route(benchmark: BenchmarkFixture, foreign: Path) -> None:
    with unpacked(foreign) as folder:
        model: Any = fmpy.read_model_description(str(folder))
        fmu: Any = fmpy.instantiate_fmu(str(folder), model, "CoSimulation")
        references, angles = [0, 1, 2], [3, 4]

        def control(_time: float, _recorder: object) -> bool:
            pitch, roll = fmu.getReal(angles)
            fmu.setReal(references, [0.1 - np.radians(pitch), -np.radians(roll), 0.0])
            return True

        def run() -> Any:
            fmu.reset()
            return fmpy.simulate_fmu(
                str(folder), model_description=model, fmu_instance=fmu, stop_time=STEPS * TS, step_size=TS,
                output_interval=TS, step_finished=control, output=["alpha", "beta"], terminate=False,
            )  # fmt: skip

        result = benchmark(run)
        assert len(result) >= STEPS
        fmu.freeInstance()


@pytest.mark.parametrize("master", ["libcosim", "ecos"])
def test_three_fmus_in_another_master(benchmark: BenchmarkFixture, master: str, foreign: Path, tmp_path: Path) -> None:
    """The child's own figure is in `extra_info`: the time of the process says nothing."""
    if importlib.util.find_spec({"libcosim": "libcosimpy", "ecos": "ecospy"}[master]) is None:
        pytest.skip(f"{master} is not installed")
    path = write_ssp(three(foreign), tmp_path / "Three.ssp")
    script = Path(__file__).with_name("step_ssp.py")
    command = [sys.executable, str(script), master, str(path), str(STEPS)]
    done = benchmark.pedantic(subprocess.run, (command,), {"capture_output": True, "text": True, "check": False})
    benchmark.extra_info["us_per_step"] = float(done.stdout.partition("us_per_step")[2].split()[0])
    assert benchmark.extra_info["us_per_step"] > 0.0


def test_memory_over_10_000_runs(benchmark: BenchmarkFixture, foreign: Path) -> None:
    """Runs of ten rows with the instance kept; grows by less than 1 MB between the 1,000th and the last."""
    plant = FmuPart(foreign, role="plant", sample_time=TS, names=NAMES)
    loop = Loop(plant=plant, controller=PController(), reference=StepReference(pitch=0.1), duration=10 * TS)

    def runs(number: int) -> float:
        for _ in range(number):
            simulate(loop, keep=True)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    before = runs(1_000)
    after = benchmark.pedantic(runs, (9_000,), rounds=1)
    loop.close()
    assert after - before < 1.0
