"""The main job end to end, as short as its models allow."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from softneck.core import OutputFileError, SettingsError, load, silent
from softneck.identification import INFINITE, validate
from softneck.report import DemoSettings, run_demo
from softneck.report._demo import Demo, fit_rows
from softneck.signals import read_recording

from ..browser import own_text

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    settings = DemoSettings(out=tmp_path_factory.mktemp("demo"), duration=40.0, iterations=2, compare_rows=100)
    return run_demo(settings, tell=lambda _: silent)


def test_every_fmu_runs_free_as_its_python_model_does(demo: Demo) -> None:
    assert set(demo.packaged) == {"rls", "nlsm", "nlsm_residual", "nn", "virtual_neck"}
    for name, item in demo.packaged.items():
        # The public promise; the same text runs in both, so that only the order of BLAS sums may differ.
        assert item.difference <= 1e-9, name


def test_the_table_has_every_model_on_every_unseen_recording(demo: Demo) -> None:
    rows = fit_rows(demo.judged)
    tests, models = ("validation", "steps", "sine", "rotation"), ("rls", "nlsm", "nlsm_residual", "nn")
    assert [row[0] for row in rows] == [f"{m} on {d}" for m in models for d in tests]


def test_a_user_finds_the_same_scores_in_the_files(demo: Demo) -> None:
    out = demo.settings.out
    model = load(out / "models" / "rls.npz")
    recording = read_recording(out / "recordings" / "rotation.csv")
    again = validate(model, recording, horizons=(1, INFINITE))
    told = demo.judged["rls", "rotation"].free
    # Degrees in the file and back cost the last digit of an angle.
    assert again.fits[INFINITE]["pitch"] == pytest.approx(told.fits[INFINITE]["pitch"], abs=1e-9)
    assert again.rows_left_out == 0
    trained = read_recording(out / "recordings" / "identification.csv")
    assert model.training_rows.size == len(trained)


def test_the_report_and_the_summary_agree_and_stand_alone(demo: Demo) -> None:
    out = demo.settings.out
    html = own_text((out / "report.html").read_text(encoding="utf-8"))
    assert not re.search(r"(src|href)=\"(?!data:|#)", html)
    assert "shorter than the paper" in html
    summary = json.loads((out / "results" / "summary.json").read_text(encoding="utf-8"))
    assert summary["shortened"] is True
    assert {entry["model"] for entry in summary["models"]} == {"rls", "nlsm", "nlsm_residual", "nn"}
    assert summary["holds"] == demo.holds


def test_loops_were_closed_against_the_neck_and_can_be_run_again(demo: Demo) -> None:
    from softneck.cosim import load_loop, simulate

    for name, result in demo.loops.items():
        again = simulate(load_loop(demo.settings.out / "loops" / f"{name}.toml"))
        assert (again["pitch"] == result["pitch"]).all(), name  # same seeds, same bits
        assert "tension_1" in result.signals.signals, name  # the plant is the virtual neck, no identified model


def test_a_demo_too_short_for_its_network_is_refused() -> None:
    with pytest.raises(SettingsError, match="at least 40 s"):
        DemoSettings(out=Path("nowhere"), duration=10.0)


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "taken"
    target.write_text("mine", encoding="utf-8")
    with pytest.raises(OutputFileError, match="name a folder"):
        run_demo(DemoSettings(out=target), tell=lambda _: silent)
    assert target.read_text(encoding="utf-8") == "mine"
