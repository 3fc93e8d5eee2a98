"""Cost of the virtual neck; run with `pytest tests/benchmarks/test_plant.py --benchmark-only`.

Compiled stepping, plain Python, scipy's `solve_ivp` on the same equations, and a batch over all cores.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from scipy.integrate import solve_ivp

from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant._neck import RUNTIME
from softneck.runtime import load_functions, load_runtime
from softneck.signals import signal

TS = 0.02


def eq22_inputs(seconds: float) -> np.ndarray:
    P = signal("eq22", duration=seconds).set_points
    return np.column_stack([P, np.zeros((P.shape[0], 5))])


@pytest.mark.benchmark(group="neck, eq22")
def test_compiled_200_s(benchmark: BenchmarkFixture) -> None:
    block = VirtualNeck(NeckParameters.paper()).block()
    start, U = block.initial_state(), eq22_inputs(200.0)
    block.run(start, U[:2])
    _, Y = benchmark(block.run, start, U)
    assert np.isfinite(Y).all()
    # Issue 3: 200 s at 1 ms in under 0.5 s after warm-up.
    started = time.perf_counter()
    block.run(start, U)
    assert time.perf_counter() - started < 0.5


@pytest.mark.benchmark(group="neck, eq22")
def test_plain_python_2_s(benchmark: BenchmarkFixture) -> None:
    block = VirtualNeck(NeckParameters.paper()).block()
    start, U = block.initial_state(), eq22_inputs(2.0)
    runtime = load_runtime(RUNTIME, compiled=False)
    Y = np.zeros((len(U), len(block.outputs)))

    def run() -> None:
        runtime.run_steps(block.arrays, start.parameters, start.values.copy(), U, Y)

    benchmark.pedantic(run, rounds=3)
    np.testing.assert_allclose(Y[:, :2], block.run(start, U)[1][:, :2], atol=1e-9)


@pytest.mark.benchmark(group="neck, eq22")
def test_solve_ivp_2_s(benchmark: BenchmarkFixture) -> None:
    neck = NeckParameters.paper().replace(drive_latency=0.0)
    block = VirtualNeck(neck).block()
    start, U = block.initial_state(), eq22_inputs(2.0)
    f = load_functions(RUNTIME)
    c = f.neck_constants(start.parameters)
    load = f.neck_load(start.parameters, 0.0, 0.0, 0.0, 0.0, 0.0)
    free = tuple(start.values[19:22].tolist())

    def run() -> np.ndarray:
        x = start.values[:19].copy()
        for u in U:
            command = (float(u[0]), float(u[1]), float(u[2]))
            x = solve_ivp(
                lambda _, x, command=command: f.neck_rates(tuple(x.tolist()), command, free, c, load),
                (0.0, TS), x, rtol=1e-6, atol=1e-9,
            ).y[:, -1]  # fmt: skip
        return x

    x = benchmark.pedantic(run, rounds=2)
    # solve_ivp's tolerance, and ours across the tendons' going slack.
    np.testing.assert_allclose(block.run(start, U)[0].values[:2], x[:2], atol=1e-4)
