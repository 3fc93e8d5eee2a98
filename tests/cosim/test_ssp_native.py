"""A whole loop without Python: neck, observer, controller and reference as compiled FMUs in other masters."""

from __future__ import annotations

import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from softneck.cosim import load_loop, simulate, write_ssp
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings
from softneck.fmu.native import build_compiled_fmu
from softneck.plant import NeckParameters, VirtualNeck

from ..fmu.every_kind import _linear
from .test_ssp import LOOP, PACKAGES, run_in

pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)


@pytest.mark.parametrize("master", list(PACKAGES))
def test_other_masters_compute_our_jacobi_loop_without_python(master: str, tmp_path: Path) -> None:
    linear = _linear()
    build_compiled_fmu(VirtualNeck(NeckParameters.paper()).block(), tmp_path / "VirtualNeck.fmu")
    build_compiled_fmu(KalmanSettings().design(linear).block(), tmp_path / "kalman.fmu")
    PiSettings().design(linear).save(tmp_path / "pi.npz")
    (tmp_path / "loop.toml").write_text(LOOP)
    setup = load_loop(tmp_path / "loop.toml")
    archive = write_ssp(setup, tmp_path / "Loop.ssp", compiled=True)
    with zipfile.ZipFile(archive) as members:
        for name in members.namelist():
            if name.endswith(".fmu"):
                (tmp_path / "part.fmu").write_bytes(members.read(name))
                with zipfile.ZipFile(tmp_path / "part.fmu") as part:
                    assert "resources/model.bin" in part.namelist()
                    assert not any(file.endswith(".py") for file in part.namelist())
    ours = simulate(setup)
    signals = {
        ("plant", "pitch"): "pitch", ("plant", "tension_1"): "tension_1", ("observer", "pitch"): "pitch_estimate",
        ("controller", "motor_setpoint_1"): "motor_setpoint_1", ("reference", "pitch_reference"): "pitch_reference",
    }  # fmt: skip
    theirs = run_in(master, archive, list(signals), 100, tmp_path)
    for (part, name), column in zip(signals, theirs.T, strict=True):
        # The limit; the controller runs in Python in ours, all else in the same library.
        expected = ours[signals[part, name]]
        np.testing.assert_allclose(column[1:], expected[1:], rtol=0, atol=1e-12, err_msg=f"{part}.{name}")
    assert np.abs(ours["pitch"]).max() > 0.02  # the loop does move
