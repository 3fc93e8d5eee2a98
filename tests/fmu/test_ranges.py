"""An output that leaves its declared range is reported once and not valid; `limit_outputs` holds it there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.runtime import Block

from ..cosim.test_validity import trained
from .test_native_errors import pytestmark as pytestmark

TS = 0.02
# [rad], reached at set-point 0.4 rad: within what the model was trained on, so that it is valid there.
HIGH = 0.02


@cache
def line() -> Block:
    block = trained().block()
    outputs = [replace(port, maximum=HIGH) if port.name == "pitch" else port for port in block.outputs]
    return replace(block, outputs=tuple(outputs))


@pytest.fixture(scope="module", params=[build_fmu, build_compiled_fmu], ids=["python", "compiled"])
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("range") / "Line.fmu"
    build: Callable[..., Any] = request.param
    build(line(), target)
    return target


@pytest.mark.parametrize("limited", [0.0, 1.0])
def test_an_output_beyond_its_range_is_reported_once_and_not_valid(path: Path, limited: float, running: Any) -> None:
    with running(path) as fmu:
        fmu.begin(limit_outputs=limited)
        seen = []
        for k, set_point in enumerate((0.3, 0.6, 0.3, 0.6)):
            fmu.set(motor_setpoint_1=set_point)
            fmu.fmu.doStep(50 * k * TS, 50 * TS)
            seen.append(fmu.get("pitch", "validity"))
        inside, beyond = seen[0], seen[1]
        assert inside[0] == pytest.approx(0.015, abs=1e-12)
        assert inside[1] > 0.5
        # The model itself is valid at 0.6 rad too; it is the declared range that ends.
        assert beyond == [HIGH if limited else pytest.approx(0.03, abs=1e-12), 0.0]
        assert seen[2:] == seen[:2]
        said = [text for status, text in fmu.log if status == 1 and "output" in text]
        assert len(said) == 1
        assert said[0].endswith("output pitch = 0.03 is outside -3.14159 to 0.02 rad: the model is not valid there.")


@pytest.mark.parametrize("build", [build_fmu, build_compiled_fmu])
@pytest.mark.parametrize(("role", "reports"), [("plant", 1), ("controller", 0)])
def test_what_a_controller_shows_before_its_first_step_is_no_decision(
    build: Callable[..., Any], role: str, reports: int, tmp_path: Path, running: Any
) -> None:
    """Chambers that are never below 0.3 kPa: set-points rest at zero before, and nothing is said of it."""
    outputs = [replace(port, minimum=0.01) if port.name == "pitch" else port for port in line().outputs]
    build(replace(line(), role=role, outputs=tuple(outputs)), tmp_path / "Part.fmu")
    with running(tmp_path / "Part.fmu") as fmu:
        fmu.begin()
        assert len([text for _, text in fmu.log if "output pitch = 0 is outside" in text]) == reports


def test_a_seed_is_an_integer_of_both_backends(path: Path, running: Any) -> None:
    with running(path) as fmu:
        assert "noise_seed" in fmu.integers
        fmu.begin(noise_seed=7.0)
        assert fmu.get("noise_seed") == [7.0]
