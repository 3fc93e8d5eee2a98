"""The quality report of 30,000 rows takes well under 1 s. Run with `pytest tests/benchmarks --benchmark-only`."""

from __future__ import annotations

from pytest_benchmark.fixture import BenchmarkFixture

from softneck.signals import assess_quality

from ..data import neck_recording


def test_quality_of_30000_rows(benchmark: BenchmarkFixture) -> None:
    neck = neck_recording(30_000)
    found = benchmark(lambda: assess_quality(neck).as_dict())
    assert found["severity"] in ("ok", "note")
