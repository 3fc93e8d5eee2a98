"""softneck family: from recordings to a file that `design` reads."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from softneck.core import load
from softneck.identification import Family, FamilySettings
from softneck.signals import write_recording

from ..data import Truth, neck_recording
from ..identification.uncertainty.test_measured import TWO, measured, played
from .conftest import Call


@pytest.mark.slow
def test_a_family_is_written_described_and_designed_on(call: Call, tmp_path: Path) -> None:
    for number, scale in enumerate((0.9, 1.2)):
        truth = Truth(gain=(0.011 * scale, 0.008 * scale))
        write_recording(tmp_path / f"{number}.csv", neck_recording(900, seed=number, truth=truth))
    said = call("family", "0.csv", "1.csv", "-o", "f.npz", "--html", "f.html", "--json", "--draws", "0")
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


def test_a_recording_that_the_family_lacks_is_found_out_by_test(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What `--test` says, with its exit code; the fit itself stands in by what two recordings show."""
    shown, _ = measured([played(TWO), played(TWO, amplitude=2.0, seed=1)], TWO)
    golden = load(Path(__file__).parents[1] / "golden" / "family.npz", role="family")
    assert isinstance(golden, Family)
    tested = {"confidence": 0.95, "names": ["a", "b"], "why": []}
    family = replace(golden, measured={"pitch": shown}, findings={**golden.findings, "tested": tested})
    monkeypatch.setattr(FamilySettings, "fit", lambda *_, **__: family)
    for name, plant in (("same", TWO), ("late", replace(TWO, delay=0.15))):
        write_recording(tmp_path / f"{name}.csv", played(plant, seed=7))
    passed = call("family", "same.csv", "--test", "same.csv", "-o", "f.npz", "--draws", "0")
    assert passed.code == 0, passed.err
    assert "not invalidated by --test (which does not say that the family explains it)" in passed.out
    failed = call(
        "family", "same.csv", "--test", "same.csv", "--test", "late.csv", "-o", "g.npz", "--json", "--draws", "0"
    )
    assert failed.code == 1
    assert failed.error.count("\n") <= 1
    assert "pitch: late.csv needs " in failed.error
    said = json.loads(failed.out)["test"]
    assert [line.split(" needs ")[0] for line in said["lines"]] == ["pitch: late.csv"]
    assert len(said["needed"]["pitch"]) == 2


@pytest.mark.slow
def test_the_page_of_another_robots_family_is_in_its_units(call: Call) -> None:
    assert call("record", "mixed", "--robot", "antagonist", "--duration", "60", "-o", "a.csv").code == 0
    said = call("family", "a.csv", "-o", "f.npz", "--html", "f.html", "--json", "--draws", "0")
    assert said.code == 0, said
    gain = json.loads(said.out)["axes"]["pitch"]["nominal"]["static_gain"]
    page = Path("f.html").read_text(encoding="utf-8")
    assert "static gain [deg/rad]" in page
    assert f"{math.degrees(gain):.2f}" in page
