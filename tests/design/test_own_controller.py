"""A controller of one's own: one text in a loop and in an FMU, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import softneck
from softneck.core import SettingsError
from softneck.design import OwnController

TEXT = """
def state_size(arrays):
    return 2


def initialise(arrays, parameters, state, outputs):
    state[:] = 0.0
    outputs[:] = 0.0


def step(arrays, parameters, state, inputs, outputs):
    for axis in range(2):
        state[axis] += 0.02 * (inputs[axis] - inputs[3 + axis])
    outputs[0] = arrays[0][0] * state[0]
    outputs[1] = -0.5 * outputs[0] + arrays[0][0] * state[1]
    outputs[2] = -0.5 * outputs[0] - arrays[0][0] * state[1]
"""
LOOP: dict[str, Any] = {
    "duration_s": 2.0, "plant": "paper", "reference": {"kind": "step", "pitch_deg": 10.0, "at_s": 0.5},
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_loop_and_fmu_compute_the_same_bits(folder: Path) -> None:
    (folder / "own_integral.py").write_text(TEXT, encoding="utf-8")
    controller = OwnController(step="own_integral", arrays=[np.array([4.0])])
    ours = softneck.simulate({**LOOP, "controller": controller})
    assert float(ours["pitch"][-1]) > 0.01  # it moves
    softneck.build_fmu(controller, "Own.fmu")
    theirs = softneck.simulate({**LOOP, "controller": {"fmu": "Own.fmu"}})
    np.testing.assert_array_equal(ours["pitch"], theirs["pitch"])


def test_what_a_module_lacks_is_said(folder: Path) -> None:
    (folder / "own_half.py").write_text(TEXT.replace("def step", "def stop"), encoding="utf-8")
    with pytest.raises(SettingsError, match="own_half: a controller of one's own needs the function `step`"):
        OwnController(step="own_half")
    with pytest.raises(SettingsError, match="there is no runtime module `own_absent`"):
        OwnController(step="own_absent")
