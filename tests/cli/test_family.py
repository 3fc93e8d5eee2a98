"""softneck family: from recordings to a file that `design` reads."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softneck.core import load
from softneck.signals import write_recording

from ..data import Truth, neck_recording
from .conftest import Call


@pytest.mark.slow
def test_a_family_is_written_described_and_designed_on(call: Call, tmp_path: Path) -> None:
    for number, scale in enumerate((0.9, 1.2)):
        truth = Truth(gain=(0.011 * scale, 0.008 * scale))
        write_recording(tmp_path / f"{number}.csv", neck_recording(900, seed=number, truth=truth))
    said = call("family", "0.csv", "1.csv", "-o", "f.npz", "--html", "f.html", "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    for axis in ("pitch", "roll"):
        found = facts["axes"][axis]
        assert found["covered"] <= 1.0 + 1e-9
        for key, value in found["nominal"].items():
            assert found["box"]["low"][key] - 0.01 <= value <= found["box"]["high"][key] + 0.01
    assert "the weight over its samples" in (tmp_path / "f.html").read_text(encoding="utf-8")
    assert load(tmp_path / "f.npz", role="family").summary() == facts["summary"]
    assert "kind: family" in call("info", "f.npz").out
    assert call("design", "pi", "f.npz", "-o", "pi.npz").code == 0
    again = call("family", "0.csv", "-o", "f.npz")
    assert (again.code, "exists" in again.error) == (2, True)
    refused = call("validate", "f.npz", "--data", "0.csv")
    assert "f.npz: is a family (family), not a model" in refused.error
