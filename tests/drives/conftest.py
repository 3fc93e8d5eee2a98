"""A controller, an observer and a loop file for the drives."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from softneck.core import write_certificate
from softneck.cosim import load_loop, simulate
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings
from softneck.identification import Rls
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import signal

from .certified import write_verified

LOOP = """duration_s = {duration}
sample_time_s = 0.02
[plant]
python = "{module}:make"
[observer]
file = "kalman.npz"
[controller]
file = "pi.npz"
[reference]
{reference}
[limits]
"pitch.rms_error_deg" = {limit}
"""
STEP = 'kind = "step"\npitch_deg = 15.0\nat_s = 1.0'
NECK = """from softneck.plant import NeckParameters, VirtualNeck


def make():
    # Next to no noise: what is compared is loops, not draws; none at all would look frozen.
    return VirtualNeck(NeckParameters.paper().replace(noise_std=1e-6)).block(noise_seed=3)
"""


@dataclass(frozen=True)
class Project:
    """Files of a small project."""

    folder: Path

    @property
    def module(self) -> str:
        """Of the plant; of its own in each folder, as Python knows one module of a name."""
        return f"neck_for_{self.folder.name}"

    @property
    def controller(self) -> Path:
        return self.folder / "pi.npz"

    @property
    def loop(self) -> Path:
        return self.folder / "loop.toml"

    @property
    def certificate(self) -> Path:
        return self.folder / "loop.certificate.json"

    def write_loop(self, name: str, reference: str, duration: float, limit: float = 30.0) -> Path:
        path = self.folder / name
        text = LOOP.format(module=self.module, duration=duration, reference=reference, limit=limit)
        path.write_text(text, encoding="utf-8")
        return path


@pytest.fixture(scope="session")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    folder = tmp_path_factory.mktemp("drives")
    paper = VirtualNeck(NeckParameters.paper())
    model = Rls(delay=0.08).fit([record(signal("eq22", duration=40.0), paper, seed=1)])
    PiSettings().design(model).save(folder / "pi.npz")
    KalmanSettings().design(model).save(folder / "kalman.npz")
    made = Project(folder)
    (folder / f"{made.module}.py").write_text(NECK, encoding="utf-8")
    made.write_loop("loop.toml", STEP, 4.0)
    write_verified(made.controller)
    result = simulate(load_loop(made.loop))
    write_certificate(made.certificate, result.certificate())
    assert json.loads(made.certificate.read_text())["holds"]
    return made
