"""softneck design of every linear kind, over one and several files, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from scipy.io import loadmat

from softneck.core import load
from softneck.identification import Rls

from ..data import neck_recording

Call = Callable[..., Any]
SETTINGS = {
    "hinf": "bandwidth=3.0",
    "lqg": "control_weight=0.2",
    "pid": "max_sensitivity=1.8",
    "fopi": "phase_margin_deg=75",
}


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    for i in range(2):
        Rls(max_delay=0.12).fit(neck_recording(1500, seed=i, noise=1e-3)).save(f"m{i}.npz")
    return ["m0.npz", "m1.npz"]


@pytest.mark.parametrize("kind", list(SETTINGS))
def test_it_designs_every_kind(kind: str, models: list[str], call: Call) -> None:
    result = call("design", kind, *models, "-o", "c.npz", "--set", SETTINGS[kind], "--json")
    assert result.code == 0, result.err
    assert json.loads(result.out)["kind"] == kind
    controller = load("c.npz", role="controller")
    # Both models and the forms of small moves.
    assert controller.design["pitch"]["samples"] >= 2
    controller.to_mat("c.mat")
    assert float(loadmat("c.mat")["Ts"][0, 0]) == controller.sample_time


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pi", "m0.npz", "--observer", "m0.npz"), "`--observer` is for mpc and nmpc, and pi does not ask for it"),
        (("mpc", "m0.npz", "--observer", "m0.npz"), "m0.npz: is a model (rls), not an observer"),
        (
            ("lqg", "m0.npz", "--set", "sample_time=0.01"),
            "`sample_time` is the robot's: set `sample_time_s` in robot.toml",
        ),
        (("pi", "m0.npz", "--set", "position_limit=5"), "`[motors] setpoint_min and setpoint_max`"),
        (("hinf", "m0.npz", "--set", "speed=3"), "unknown setting `speed`"),
        (("custom", "m0.npz"), "`controller` must be a control.StateSpace"),
        (("switched", "m0.npz"), "kind `switched` was removed after softneck 0.2.0"),
        (("pid", "m0.npz", "--set", "tuning=placement"), "unknown setting `tuning`"),
    ],
)
def test_it_says_what_to_do(words: tuple[str, ...], message: str, models: list[str], call: Call) -> None:
    result = call("design", *words, "-o", "c.npz")
    assert result.code == 2
    assert message in result.error
    assert not Path("c.npz").exists()
