"""The drives' core and a whole run in virtual time; the issue's figures: 200 us a cycle, 50 times real time.

Run with `pytest tests/benchmarks/test_drives.py --benchmark-only`. Processor time: other work shall not count.
"""

from __future__ import annotations

from time import process_time

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from softneck.drives.master import Phase, Tilt

from ..drives.bench import Bench, T

CYCLES = 2_000


@pytest.mark.benchmark(timer=process_time, min_rounds=3)
def test_core_per_cycle(benchmark: BenchmarkFixture) -> None:
    """The master's step alone, over frames that were recorded: three drives, controller not counted."""
    bench = Bench().start()
    frames = []
    for _ in range(CYCLES):
        bench.step()
        frames.append((bench.now, list(bench.link._inbox), bench.neck.newest))
    master = bench.master
    shift = [CYCLES * T]

    def steps() -> None:
        for now, inbox, newest in frames:
            tilt = Tilt(newest.pitch, newest.roll) if master.sample_due else None
            master.step(now + shift[0], inbox, tilt)
        # The next round goes on in time.
        shift[0] += CYCLES * T

    benchmark(steps)
    assert master.supervisor.phase is Phase.RUNNING
    assert benchmark.stats is not None
    assert benchmark.stats["median"] / CYCLES < 200e-6


@pytest.mark.benchmark(timer=process_time, min_rounds=3)
def test_virtual_time(benchmark: BenchmarkFixture) -> None:
    """Master, frames, drives, neck and inclinometer for 20 s; without observer and controller."""
    bench = Bench().start()
    bench.link.tap = None
    benchmark(lambda: bench.pass_time(CYCLES * T))
    assert bench.phase is Phase.RUNNING
    assert benchmark.stats is not None
    assert CYCLES * T / benchmark.stats["median"] > 50.0
