"""Toy parts and their FMUs for loops."""

from __future__ import annotations

import math
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import load
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings
from softneck.fmu import build_fmu
from softneck.identification import Rls
from softneck.plant import NeckParameters, VirtualNeck
from softneck.signals import Recording, redefine, signal

_TOYS = str(Path(__file__).parents[1] / "fmu" / "toys")
if _TOYS not in sys.path:
    sys.path.append(_TOYS)  # where the bundler finds the toy runtimes

TS = 0.02
LOOP = """
duration_s = 4.0
sample_time_s = 0.02
[plant]
fmu = "Neck.fmu"
parameters = { payload = 0.5, pitch_start = 0.01 }
[controller]
fmu = "Pi.fmu"
[reference]
kind = "step"
pitch_deg = 15.0
at_s = 1.0
[limits]
"pitch.overshoot_pct" = 5.0
"pitch.settling_s" = 1.0
"""


@pytest.fixture(scope="session")
def toys() -> Any:
    return import_module("toy_blocks")


@pytest.fixture(scope="session")
def fmus(toys: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of Lag.fmu, Gain.fmu, Neck.fmu and Pi.fmu."""
    folder = tmp_path_factory.mktemp("fmus")
    for name, block in (("Lag", toys.lag()), ("Gain", toys.controller()), ("Neck", toys.neck()), ("Pi", toys.pi())):
        build_fmu(block, folder / f"{name}.fmu")
    return folder


@pytest.fixture
def loop_file(fmus: Path, tmp_path: Path) -> Path:
    """A loop file beside its two FMUs."""
    for name in ("Neck.fmu", "Pi.fmu"):
        (tmp_path / name).write_bytes((fmus / name).read_bytes())
    path = tmp_path / "loop.toml"
    path.write_text(LOOP)
    return path


@pytest.fixture
def recording() -> Recording:
    """Two runs of random set-points."""
    P = np.random.default_rng(5).uniform(-2.0, 2.0, (90, 3))
    time = np.concatenate([np.arange(50), np.arange(40)]) * 0.02
    channels = {f"motor_setpoint_{j + 1}": P[:, j] for j in range(3)}
    channels |= {"pitch": np.zeros(90), "roll": np.zeros(90)}
    return Recording(time, 0.02, channels, np.repeat([0, 1], [50, 40]))


@pytest.fixture(autouse=True)
def own_temporary_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unpack FMUs where no test of another process does, so that leftovers can be counted."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("unpacked")))


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files and FMUs of an RLS model, its Kalman filter and PI controller, and the virtual neck's FMU."""
    place = tmp_path_factory.mktemp("line")
    P = signal("eq22").set_points[:800]
    drive, y = redefine(P), np.zeros((800, 2))
    for k in range(799):
        y[k + 1] = 0.9 * y[k] + 0.01 * drive[k, :2] + 1e-3 * math.sin(k)
    channels = {f"motor_setpoint_{j + 1}": P[:, j] for j in range(3)} | {"pitch": y[:, 0], "roll": y[:, 1]}
    model = Rls().fit(Recording(np.arange(800) * TS, TS, channels))
    model.save(place / "rls.npz")
    KalmanSettings().design(model).save(place / "kalman.npz")
    PiSettings().design(model).save(place / "pi.npz")
    for name in ("rls", "kalman", "pi"):
        build_fmu(load(place / f"{name}.npz").block(), place / f"{name}.fmu")
    build_fmu(VirtualNeck(NeckParameters.paper()).block(), place / "VirtualNeck.fmu")
    return place
