"""Run with `pytest tests/benchmarks --benchmark-only`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from softneck.signals import guess_layout, import_log, write_recording

ROWS = 200_000


@pytest.mark.parametrize("jitter", [0.0, 0.2], ids=["even", "uneven"])
def test_a_log_of_200_000_rows(benchmark: BenchmarkFixture, tmp_path: Path, jitter: float) -> None:
    rng = np.random.default_rng(0)
    time = 0.02 * (np.arange(ROWS) + rng.uniform(-jitter, jitter, ROWS))
    P = 3.0 * np.sin(np.outer(time, [0.7, 1.1, 1.3]))
    columns = {"time": time, **{f"target{j}": P[:, j - 1] for j in (1, 2, 3)}}
    columns |= {"pitch": 0.1 * P[:, 0] + 0.01 * rng.standard_normal(ROWS), "roll": 0.1 * P[:, 1]}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)

    def run() -> int:
        done = import_log(tmp_path / "log.csv", guess_layout(tmp_path / "log.csv").layout)
        write_recording(tmp_path / "neck.csv", done.recording, force=True)
        return len(done.recording)

    assert abs(benchmark(run) - ROWS) <= 1
