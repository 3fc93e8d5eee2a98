"""Cost of an FMU's step, start and building; run with `pytest tests/benchmarks --benchmark-only`."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import control
import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave
from pytest_benchmark.fixture import BenchmarkFixture
from pythonfmu import FmuBuilder

from softneck.design import PiSettings
from softneck.estimation import KalmanSettings, LinearNeck
from softneck.fmu import build_fmu, unpacked
from softneck.identification import Network, Play, Rls, SetMembership
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block
from softneck.signals import Recording, redefine, signal

TS = 0.02
_TRIVIAL = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real

class Trivial(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.y = 0.0
        self.register_variable(Real("y", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        return True
"""


def _recording(rows: int) -> Recording:
    P = signal("eq22").set_points[:rows]
    drive, y = redefine(P), np.zeros((rows, 2))
    for k in range(rows - 1):
        y[k + 1] = 0.9 * y[k] + 0.01 * drive[k, :2] + 1e-3 * math.sin(k)
    channels = {f"motor_setpoint_{j + 1}": P[:, j] for j in range(3)} | {"pitch": y[:, 0], "roll": y[:, 1]}
    return Recording(np.arange(rows) * TS, TS, channels)


def _linear() -> LinearNeck:
    pole = math.exp(-5.293 * TS)  # Eq. 31
    tf = control.TransferFunction([0.09 * (1.0 - pole)], [1.0, -pole, 0.0, 0.0], TS)
    return LinearNeck(pitch=tf, roll=tf)


# The public bounds are on `rls`, `nn` (25 x 25) and set membership at 7,000 points.
_KINDS: dict[str, Callable[[], Block]] = {
    "rls": lambda: Rls().fit(_recording(1000)).block(),
    "nlsm": lambda: SetMembership().fit(_recording(7000)).block(),
    "play": lambda: Play().fit(_recording(2000)).block(),
    "nn": lambda: Network(iterations=1).fit(_recording(2000)).block(),
    "kalman": lambda: KalmanSettings().design(_linear()).block(),
    "pi": lambda: PiSettings().design(_linear()).block(),
    "neck": lambda: VirtualNeck(NeckParameters.paper()).block(),
}


def _trivial(folder: Path) -> Path:
    script = folder / "softneck_trivial_slave.py"
    script.write_text(_TRIVIAL)
    path = list(sys.path)
    try:
        return Path(FmuBuilder.build_FMU(script, dest=folder / "Trivial.fmu"))
    finally:
        sys.path[:] = path
        sys.modules.pop("softneck_trivial_slave", None)


_LAG = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="Lag" guid="lag"><CoSimulation modelIdentifier="Lag"/>
<ModelVariables><ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable></ModelVariables>
<ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure></fmiModelDescription>
"""


def _in_c(folder: Path) -> Path:
    compiler = shutil.which("cc")
    if compiler is None or sys.platform != "linux":
        pytest.skip("no C compiler here to compare with")
    library = folder / "Lag.so"
    source = Path(__file__).with_name("lag_fmu.c")
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    with zipfile.ZipFile(folder / "Lag.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", _LAG)
        archive.write(library, "binaries/linux64/Lag.so")
    return folder / "Lag.fmu"


@pytest.fixture(scope="module", params=["trivial", "c", *_KINDS])
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("benchmark")
    if request.param in ("trivial", "c"):
        return _trivial(folder) if request.param == "trivial" else _in_c(folder)
    return build_fmu(_KINDS[request.param](), folder / f"{request.param}.fmu")


def _instance(folder: Path) -> FMU2Slave:
    model = fmpy.read_model_description(str(folder))
    assert model.coSimulation is not None
    name = model.coSimulation.modelIdentifier
    fmu = FMU2Slave(guid=model.guid, unzipDirectory=str(folder), modelIdentifier=name, instanceName="benchmark")
    fmu.instantiate()
    return fmu


@pytest.fixture
def fmu(path: Path) -> Iterator[FMU2Slave]:
    with unpacked(path) as folder:
        fmu = _instance(folder)
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        yield fmu
        fmu.freeInstance()


def test_do_step(benchmark: BenchmarkFixture, path: Path, fmu: FMU2Slave) -> None:
    """Time `doStep` alone, along the paper's validation signal: a set is searched where it holds data."""
    variables = fmpy.read_model_description(str(path)).modelVariables
    inputs = [v.valueReference for v in variables if v.causality == "input" and v.name.startswith("motor_setpoint")]
    P = signal("eq22").set_points[7000:10_000]
    samples = iter(range(10**9))
    if not inputs:  # the trivial one, the one in C and the controller
        benchmark(lambda: fmu.doStep(next(samples) * TS, TS))
        return

    def hold() -> tuple[tuple[float], dict[str, float]]:
        k = next(samples)
        fmu.setReal(inputs, P[k % len(P)].tolist())
        return (k * TS,), {}

    benchmark.pedantic(lambda time: fmu.doStep(time, TS), setup=hold, rounds=3000, warmup_rounds=50)
    # Not more samples than were asked for, and none was lost: the FMU's time is the last one it reached.
    assert fmu.getRealStatus(2) == pytest.approx(next(samples) * TS, rel=1e-12)


def test_instantiate(benchmark: BenchmarkFixture, path: Path) -> None:
    with unpacked(path) as folder:

        def start() -> None:
            _instance(folder).freeInstance()

        benchmark(start)


@pytest.mark.parametrize("kind", ["rls", "neck"])
def test_build(benchmark: BenchmarkFixture, kind: str, tmp_path: Path) -> None:
    block = _KINDS[kind]()
    built = benchmark(build_fmu, block, tmp_path / "Built.fmu", force=True)
    assert fmpy.read_model_description(str(built)).modelName == "Built"
