"""An output that leaves its declared range is reported once and not valid; `limit_outputs` holds it there."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from softneck.core import load
from softneck.fmu import build_compiled_fmu, build_fmu

from ..data import ROOT
from .test_native_errors import pytestmark as pytestmark

TS = 0.02


@pytest.fixture(scope="module", params=[build_fmu, build_compiled_fmu], ids=["python", "compiled"])
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("range") / "Rls.fmu"
    build: Callable[..., Any] = request.param
    build(load(ROOT / "tests" / "golden" / "rls.npz").block(), target)
    return target


@pytest.mark.parametrize("limited", [0.0, 1.0])
def test_an_output_beyond_its_range_is_reported_once_and_not_valid(path: Path, limited: float, running: Any) -> None:
    with running(path) as fmu:
        fmu.begin(limit_outputs=limited)
        fmu.set(motor_setpoint_1=1000.0)
        fmu.fmu.doStep(0.0, 40 * TS)
        pitch, validity = fmu.get("pitch", "validity")
        assert pitch == math.pi if limited else pitch > 80.0
        assert validity == 0.0
        said = [text for status, text in fmu.log if status == 1 and "output" in text]
        assert len(said) == 1
        assert said[0].endswith("is outside -3.14159 to 3.14159 rad: the model is not valid there.")


def test_a_seed_is_an_integer_of_both_backends(path: Path, running: Any) -> None:
    with running(path) as fmu:
        assert "noise_seed" in fmu.integers
        fmu.begin(noise_seed=7.0)
        assert fmu.get("noise_seed") == [7.0]
