"""Continuous plants for kinds of controllers: held at the sample time, exactly, and then as any discrete plant."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from scipy.linalg import expm

from softneck.core import DataError, SettingsError, load
from softneck.design import (
    AdaptiveSettings,
    CustomSettings,
    HinfSettings,
    LqgSettings,
    MpcSettings,
    PidSettings,
    PiSettings,
    makeweight,
    mixsyn,
)  # fmt: skip
from softneck.design.plants._coupled import coupled_plant
from softneck.estimation import LinearNeck

from .test_coupled_plants import within

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

TS = 0.02
ROBOT = within(3, 2)
# The paper's own (Eq. 31), without its dead time.
NECK = control.TransferFunction([math.radians(27.691)], [1.0, 5.293])
# Three inputs, two outputs, each moved by all.
LAGS = control.StateSpace(
    np.diag([-3.0, -5.0, -8.0]), [[3.0, -1.0, 2.0], [1.0, 4.0, -2.0], [2.0, 2.0, 5.0]],
    [[1.0, 0.3, 0.0], [0.0, 0.5, 1.0]], np.zeros((2, 3)),
)  # fmt: skip


def stepped(G: Any, period: float) -> control.StateSpace:
    """Return a system whose inputs are held, by the exponential of [A B; 0 0] (Van Loan 1978)."""
    system: Any = control.ss(G)
    n, m = system.nstates, system.ninputs
    both = expm(period * np.block([[system.A, system.B], [np.zeros((m, n + m))]]))
    return control.StateSpace(both[:n, :n], both[:n, n:], system.C, system.D, period)


def same(ours: Any, theirs: Any) -> None:
    """Hold that two controllers are the same but for rounding, which the solution of a Riccati equation magnifies."""
    for a, b in zip(ours.arrays, theirs.arrays, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    "settings",
    [PiSettings(), PidSettings(), LqgSettings(), HinfSettings(bandwidth=3.0),
     MpcSettings(bandwidth=5.0)],
    ids=lambda settings: type(settings).__name__,
)  # fmt: skip
def test_a_neck_of_ones_own_is_designed_as_what_is_held(settings: Any) -> None:
    found = settings.design(NECK)
    same(found, settings.design(stepped(NECK, TS)))
    assert "the plant is continuous, its inputs held for 20 ms (exact)" in found.summary()
    # A list of samples and a mapping hold theirs.
    same(settings.design({"pitch": [NECK], "roll": [NECK]}), settings.design({"pitch": [stepped(NECK, TS)]} | {
        "roll": [stepped(NECK, TS)]}))  # fmt: skip


@pytest.mark.parametrize(
    "settings",
    [LqgSettings(), MpcSettings(bandwidth=4.0)],
    ids=["lqg", "mpc"],
)
@pytest.mark.parametrize("period", [None, 0.01])
def test_plants_of_any_size_are_reached_in_continuous_time(settings: Any, period: float | None, tmp_path: Path) -> None:
    """The controller's file around the differential equation, looked at ten times between samples; a load half way."""
    controller = settings.design(LAGS, robot=replace(ROBOT, sample_time_s=period))
    same(controller, settings.design(stepped(LAGS, period or TS), robot=ROBOT))
    controller.save(tmp_path / "k.npz")
    block = load(tmp_path / "k.npz").block()
    assert block.sample_time == (period or TS)
    fine, asked = stepped(LAGS, block.sample_time / 10.0), np.array([0.05, 0.1])
    state, x, u, largest = block.initial_state(), np.zeros(3), np.zeros(3), np.zeros(2)
    rows = round(16.0 / block.sample_time)
    for k in range(rows):
        state, u = block.step(state, np.concatenate([asked, [0.0], fine.C @ x, u, [1.0, 1.0]]))
        for _ in range(10):
            x = fine.A @ x + fine.B @ (u + (0.1 if k > rows // 2 else 0.0))
            largest = np.maximum(largest, fine.C @ x) if k < rows // 2 else largest
    # Integral action; modes of half a second after 8 s.
    np.testing.assert_allclose(fine.C @ x, asked, atol=1e-4)
    # 2 % (`mpc`) and 4 % (`lqg`) of one step at a time, and here both are asked for at once.
    assert (largest <= 1.08 * asked).all()


def test_a_controller_of_ones_own_says_how_often_it_runs() -> None:
    """The plant is held at its sample time, and the loop is that of the discrete plant."""
    G = stepped(LAGS, 0.01)
    K: Any = mixsyn(G, makeweight(10.0, 1.0, 0.5), 0.5).controller
    whole: Any = coupled_plant(G)
    mine = control.StateSpace(K.A, K.B, whole.own_redefinition[0][:2] @ K.C, whole.own_redefinition[0][:2] @ K.D, 0.01)
    same(*(CustomSettings(controller=mine).design(plant, robot=ROBOT) for plant in (LAGS, G)))
    with pytest.raises(SettingsError, match=r"runs every 0.01 s, the plant every 0.02 s"):
        CustomSettings(controller=mine).design(stepped(LAGS, TS), robot=ROBOT)


@pytest.mark.parametrize(
    ("settings", "plant", "error", "message"),
    [
        (PiSettings(), control.TransferFunction([1.0, 1.0, 1.0], [1.0, 2.0]), SettingsError, "must be proper"),
        (MpcSettings(), control.TransferFunction([1.0, 1.0], [1.0, 2.0]), DataError, "strictly proper"),
        (LqgSettings(), control.StateSpace(np.eye(3), np.eye(3), np.eye(3)[:2], np.zeros((2, 3))),
         SettingsError, r"not stable \(spectral radius 1.0202\)"),
        (LqgSettings(), control.StateSpace(np.diag([-1.0, -math.inf]), np.eye(2), np.eye(2), 0.0),
         SettingsError, "not finite"),
        (LqgSettings(), control.StateSpace(LAGS.A, LAGS.B, LAGS.C, 0.0, None), SettingsError,
         "its dt is None. Give"),
        (AdaptiveSettings(), LinearNeck(NECK, NECK), SettingsError, "must be discrete; its dt is 0"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_one_line(settings: Any, plant: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        settings.design(plant)
