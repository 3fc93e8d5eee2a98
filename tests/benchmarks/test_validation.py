"""Cost of judging; run with `pytest tests/benchmarks/test_validation.py --benchmark-only`.

Issue 4: importing, validating and reporting three models on 30,000 samples by 3 inputs in under 20 s on 2 cores.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from softneck.cli._main import run
from softneck.identification import Network, Rls, SetMembership
from softneck.identification.validation._score_tables import fit_intervals
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal, write_recording

ROWS = 30_000
_LAYOUT = """
[time]
column = "t"
sample_time_s = 0.02
[channels]
motor_setpoint_1 = { column = "u1", unit = "rad" }
motor_setpoint_2 = { column = "u2", unit = "rad" }
motor_setpoint_3 = { column = "u3", unit = "rad" }
pitch = { column = "pitch", unit = "deg" }
roll = { column = "roll", unit = "deg" }
"""


def virtual(name: str, seconds: float, seed: int) -> Recording:
    return record(signal(name, duration=seconds, seed=seed), VirtualNeck(NeckParameters.paper()), seed=seed)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A logger's table of 30,000 rows, none of which the three models beside it were trained on."""
    folder = tmp_path_factory.mktemp("validation")
    r = virtual("mixed", 0.02 * ROWS, 5)
    table = np.column_stack([r.time, r.set_points, np.degrees(r.outputs)])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="t,u1,u2,u3,pitch,roll", comments="", fmt="%.9g")
    (folder / "layout.toml").write_text(_LAYOUT)
    training = virtual("eq22", 140.0, 1)
    write_recording(folder / "training.csv", training)
    estimators = {"rls": Rls(), "nlsm": SetMembership(epsilon=0.004, output_weight=10.0), "nn": Network(iterations=5)}
    for name, estimator in estimators.items():
        estimator.fit(training).save(folder / f"{name}.npz")
    return folder


@pytest.mark.benchmark(group="30,000 samples, 3 inputs, 3 models")
def test_import_validate_and_report(
    benchmark: BenchmarkFixture, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def job() -> None:
        data, page = folder / "neck.csv", folder / "page.html"
        steps = (
            ["import", folder / "log.csv", "--layout", folder / "layout.toml", "-o", data, "--force", "--json"],
            ["validate", *(folder / f"{name}.npz" for name in ("rls", "nlsm", "nn")), "--data", data, "--html", page,
             "--force", "--json"],
        )  # fmt: skip
        for step in steps:
            assert run([str(word) for word in step]) == 0

    started, busy = time.perf_counter(), time.process_time()
    benchmark.pedantic(job, rounds=1)
    seconds, busy = time.perf_counter() - started, time.process_time() - busy
    assert '"best_linear"' in capsys.readouterr().out
    benchmark.extra_info |= {"s": round(seconds, 1), "s of processor": round(busy, 1)}
    # The figure, on 2 cores that do nothing else.
    assert seconds < 20.0
    # The time of all cores together: a machine that others use shows no other. It lies within noise of its bound.
    assert busy < 20.0


@pytest.mark.benchmark(group="bootstrap")
def test_a_thousand_resamples_of_30000_rows(benchmark: BenchmarkFixture) -> None:
    rng = np.random.default_rng(0)
    y = np.cumsum(rng.standard_normal((ROWS, 2)), axis=0)
    e = rng.standard_normal((ROWS, 2))
    segment = np.zeros(ROWS, dtype=int)
    intervals = benchmark(fit_intervals, [y] * 4, [y - e] * 4, segment, 10.0)
    assert len(intervals) == 4
