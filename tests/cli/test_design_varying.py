"""softneck design adaptive: files in, file out, FMU, and one clear line where it cannot be."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from softneck.core import load
from softneck.fmu import build_fmu, fmu_info
from softneck.identification import Rls

from ..data import neck_recording
from .conftest import Call


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for i, name in enumerate(("low", "high")):
        Rls(max_delay=0.12).fit(neck_recording(600, seed=i + 1)).save(tmp_path / f"{name}.npz")
    return tmp_path


def test_one_model_makes_an_adaptive_controller_and_its_fmu(call: Call, files: Path) -> None:
    said = call("design", "adaptive", "low.npz", "-o", "a.npz", "--set", "phase_margin_deg=55")
    assert said.code == 0, said.err
    assert "starts from" in said.out
    made = load(files / "a.npz")
    assert made.design["settings"]["phase_margin"] == pytest.approx(math.radians(55))
    path = build_fmu(made.block(), files / "A.fmu", info=fmu_info(made))
    assert path is None or Path(files / "A.fmu").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("adaptive", "low.npz", "high.npz"), "one model or a family; got 2 models"),
        (("adaptive", "low.npz", "--set", "gain_range=2"), "`gain_range` must be between 0 and 0.9"),
    ],
)
def test_what_cannot_be_designed_is_one_line(call: Call, files: Path, arguments: tuple[str, ...], message: str) -> None:
    said = call("design", *arguments, "-o", "c.npz", "--json")
    assert said.code == 2
    assert message in said.err
    assert len(said.err.strip().splitlines()) == 1
    assert not (files / "c.npz").exists()
