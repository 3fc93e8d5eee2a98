"""Cost of a compiled FMU's step; run with `pytest tests/benchmarks/test_compiled_fmus.py --benchmark-only -p no:xdist`.

All kinds in one run, fmpy's low-level `doStep` alone, inputs set before each. The last lines are the table of
docs/howto/fmus.md: times of the compiled FMU and of the pythonfmu one of the same model, side by side, and
what of the former is fmpy's own: a `doStep` over no time, in which the FMU has nothing to do.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave
from pytest_benchmark.fixture import BenchmarkFixture
from pythonfmu import FmuBuilder

from softneck.design import FopiSettings, HinfSettings, MpcSettings, PiSettings
from softneck.estimation import KalmanSettings
from softneck.fmu import build_compiled_fmu, build_fmu, unpacked
from softneck.identification import (
    GreyBox,
    Model,
    Network,
    Play,
    Rls,
    SetMembership,
)
from softneck.identification.uncertainty._guarded import Base, Guarded
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import Block
from softneck.signals import Recording, signal

from ..oracles.bake_off import bake_off_neck
from .test_set_membership import model_of, motion

STEPS = 2000
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


def _trivial(folder: Path) -> Path:
    script = folder / "softneck_trivial_slave.py"
    script.write_text(_TRIVIAL)
    path = list(sys.path)
    try:
        return Path(FmuBuilder.build_FMU(script, dest=folder / "Trivial.fmu"))
    finally:
        sys.path[:] = path
        sys.modules.pop("softneck_trivial_slave", None)


@cache
def _training() -> Recording:
    """The paper's training rows on the virtual neck: 7,000 of Eq. 22."""
    return record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=100).rows(0, 7000)


@cache
def _set(rows: int) -> Block:
    return model_of(rows).block()


@cache
def _play() -> Block:
    return Play().fit(_training()).block()


def _guarded(member: Model) -> Block:
    """Five members, here alike, and equations as base: what a step takes is the same."""
    base = Base(GreyBox(evaluations=3).fit(_training()), np.full(2, 0.01), np.array([90.0, 90.0]))
    return Guarded().around(base, [member] * 5, _training()).block()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kind:
    """One row of the table.

    Attributes:
        make: its block.
        wanted: issue 17's bound [us].
        outputs: by which a step's time is divided.
        python: whether the pythonfmu FMU is timed too.
    """

    make: Callable[[], Block]
    wanted: float | None = None
    outputs: int = 1
    python: bool = True


_KINDS = {
    "linear (rls)": _Kind(make=lambda: Rls().fit(_training()).block(), wanted=1.0),
    "play": _Kind(make=_play),
    "nn (25 x 25)": _Kind(make=lambda: Network(iterations=1).fit(_training()).block(), wanted=2.0),
    "set membership, paper": _Kind(make=lambda: SetMembership().fit(_training()).block(), wanted=5.0, outputs=2),
    "set membership, residual": _Kind(
        make=lambda: SetMembership(form="residual").fit(_training()).block(), wanted=5.0, outputs=2
    ),
    "set membership, 7k x 10": _Kind(make=lambda: _set(7_000), wanted=5.0, outputs=2),
    "set membership, 1M x 10": _Kind(make=lambda: _set(1_000_000), wanted=15.0, outputs=2, python=False),
    # What is fitted hardly matters to a step's time: a few rounds do.
    "greybox": _Kind(make=lambda: GreyBox(evaluations=3).fit(_training()).block()),
    "guarded (5 nn, greybox)": _Kind(
        make=lambda: _guarded(Network(starts=1, iterations=1, refine=0, prior=0.0).fit(_training())),
        wanted=10.0,
        python=False,
    ),
    # 20 ms at 500 times real time.
    "virtual neck": _Kind(make=lambda: VirtualNeck(NeckParameters.paper()).block(), wanted=40.0),
    "observer (kalman)": _Kind(make=lambda: KalmanSettings().design(bake_off_neck()).block()),
    "pi": _Kind(make=lambda: PiSettings().design(bake_off_neck()).block()),
    "fopi": _Kind(make=lambda: FopiSettings().design(bake_off_neck()).block()),
    "hinf": _Kind(make=lambda: HinfSettings(bandwidth=4.0).design(bake_off_neck()).block()),
    "mpc, 30 unknowns": _Kind(
        make=lambda: MpcSettings(bandwidth=8.0, lead_limit=12.0).design(bake_off_neck()).block(), wanted=30.0
    ),
}


def _inputs(name: str, block: Block) -> np.ndarray:
    """Return what a step is given: the validation rows of Eq. 22, or the references that make limits active."""
    names = [port.name for port in block.inputs]
    u = np.tile([port.start for port in block.inputs], (STEPS, 1))
    if "pitch_reference" in names:
        rng, y = np.random.default_rng(0), np.zeros(2)
        state = block.initial_state()
        for k in range(STEPS):
            if k % 25 == 0:
                u[k:, :2], u[k:, 2] = rng.uniform(-0.55, 0.55, 2), rng.uniform(-2.0, 2.0)
            u[k, names.index("pitch")], u[k, names.index("roll")] = y
            state, out = block.step(state, u[k])
            if k + 1 < STEPS:
                u[k + 1, [names.index(f"motor_position_{j}") for j in (1, 2, 3)]] = out
            bend = np.array([out[0] - 0.5 * (out[1] + out[2]), 0.866 * (out[1] - out[2])])
            y = 0.9 * y + 0.1 * 0.0913 * bend
        return u
    P = motion(STEPS - 3, seed=2) if "x 10" in name else signal("eq22").set_points[7000 : 7000 + STEPS]
    u[:, [names.index(f"motor_setpoint_{j}") for j in (1, 2, 3)]] = P
    return u


class _Run:
    """An instance that is led along `inputs` again and again."""

    def __init__(self, folder: Path, inputs: np.ndarray, period: float) -> None:
        model = fmpy.read_model_description(str(folder))
        assert model.coSimulation is not None
        name = model.coSimulation.modelIdentifier
        self.fmu = FMU2Slave(guid=model.guid, unzipDirectory=str(folder), modelIdentifier=name, instanceName="timed")
        self.fmu.instantiate()
        self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        known = [v for v in model.modelVariables if v.causality == "input"]
        self.reals = [(i, v.valueReference) for i, v in enumerate(known) if v.type == "Real"]
        self.booleans = [(i, v.valueReference) for i, v in enumerate(known) if v.type == "Boolean"]
        self.inputs, self.period, self.k = inputs, period, 0

    def hold(self) -> float:
        """Set the inputs of the next sample and return its time."""
        if len(self.inputs):
            row = self.inputs[self.k % len(self.inputs)]
            self.fmu.setReal([v for _, v in self.reals], [float(row[i]) for i, _ in self.reals])
            if self.booleans:
                self.fmu.setBoolean([v for _, v in self.booleans], [bool(row[i]) for i, _ in self.booleans])
        self.k += 1
        return (self.k - 1) * self.period

    def seconds(self, steps: int) -> float:
        """Return the median of `doStep`."""
        doStep, clock, taken = self.fmu.doStep, time.perf_counter, np.empty(steps)
        for i in range(steps):
            now = self.hold()
            begin = clock()
            doStep(now, self.period)
            taken[i] = clock() - begin
        return float(np.median(taken))

    def seconds_of_nothing(self, steps: int) -> float:
        """Return the median of a `doStep` over no time: what fmpy takes for the call."""
        doStep, clock, taken, now = self.fmu.doStep, time.perf_counter, np.empty(steps), self.k * self.period
        for i in range(steps):
            begin = clock()
            doStep(now, 0.0)
            taken[i] = clock() - begin
        return float(np.median(taken))


@pytest.fixture(scope="module")
def trivial(tmp_path_factory: pytest.TempPathFactory) -> Iterator[_Run]:
    with unpacked(_trivial(tmp_path_factory.mktemp("trivial"))) as folder:
        run = _Run(folder, np.zeros((0, 0)), 0.02)
        yield run
        run.fmu.freeInstance()


@pytest.fixture(scope="module")
def table(request: pytest.FixtureRequest) -> Iterator[list[str]]:
    lines: list[str] = []
    yield lines
    head = "| step of | compiled [us] | of it fmpy [us] | wanted [us] | pythonfmu [us] | times faster | trivial [us] |"
    capture = request.config.pluginmanager.get_plugin("capturemanager")
    if lines and capture is not None:
        with capture.global_and_fixture_disabled():
            print("\n" + "\n".join([head, "|---|---|---|---|---|---|---|", *lines]))


def test_empty(benchmark: BenchmarkFixture, table: list[str], tmp_path: Path) -> None:
    """The cheapest thing that fmpy can call: what every other row has in it."""
    block = _KINDS["linear (rls)"].make()
    build_compiled_fmu(block, tmp_path / "Compiled.fmu")
    with unpacked(tmp_path / "Compiled.fmu") as folder:
        run = _Run(folder, np.zeros((0, 0)), block.sample_time)
        benchmark.pedantic(lambda: run.fmu.doStep(0.0, 0.0), rounds=STEPS)
        table.append(f"| empty | {1e6 * run.seconds_of_nothing(STEPS):.2f} | | | | | |")
        run.fmu.freeInstance()


@pytest.mark.parametrize("name", list(_KINDS))
def test_do_step(
    benchmark: BenchmarkFixture, name: str, trivial: _Run, table: list[str], tmp_path: Path
) -> None:  # fmt: skip
    kind = _KINDS[name]
    block = kind.make()
    u = _inputs(name, block)
    build_compiled_fmu(block, tmp_path / "Compiled.fmu")
    with ExitStack() as stack:
        run = _Run(stack.enter_context(unpacked(tmp_path / "Compiled.fmu")), u, block.sample_time)
        stack.callback(run.fmu.freeInstance)
        run.seconds(300)
        benchmark.pedantic(lambda now: run.fmu.doStep(now, run.period), setup=lambda: ((run.hold(),), {}), rounds=STEPS)
        compiled = 1e6 * run.seconds(STEPS) / kind.outputs
        empty = 1e6 * run.seconds_of_nothing(STEPS) / kind.outputs
        python = float("nan")
        if kind.python:
            build_fmu(block, tmp_path / "Python.fmu")
            other = _Run(stack.enter_context(unpacked(tmp_path / "Python.fmu")), u, block.sample_time)
            stack.callback(other.fmu.freeInstance)
            other.seconds(50)
            python = 1e6 * other.seconds(500) / kind.outputs
    plain = 1e6 * trivial.seconds(STEPS)
    wanted = "" if kind.wanted is None else f"{kind.wanted:g}"
    unit = " (each output)" if kind.outputs > 1 else ""
    benchmark.extra_info |= {"compiled us": compiled, "wanted us": wanted, "pythonfmu us": python, "trivial us": plain}
    benchmark.extra_info["fmpy us"] = empty
    ratio = python / compiled
    table.append(
        f"| {name}{unit} | {compiled:.2f} | {empty:.2f} | {wanted} | {python:.1f} | {ratio:.1f} | {plain:.2f} |"
    )


@pytest.mark.parametrize("name", ["linear (rls)", "set membership, paper", "virtual neck"])
def test_export(benchmark: BenchmarkFixture, name: str, tmp_path: Path) -> None:
    block = _KINDS[name].make()
    build_compiled_fmu(block, tmp_path / "Once.fmu")  # the library of a source checkout is made once
    benchmark(lambda: build_compiled_fmu(block, tmp_path / "Built.fmu", force=True))
