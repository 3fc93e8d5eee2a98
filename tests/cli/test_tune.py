"""`softneck tune`: what its folder holds, what it says, and what it refuses before it searches."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import softneck
from softneck.cli._main import run
from softneck.cli._tune import way_on
from softneck.core import read_certificate
from softneck.estimation import KalmanSettings

from ..data import ROOT

MODEL, GREYBOX = (ROOT / "tests" / "golden" / name for name in ("oe.npz", "greybox.npz"))
QUICK = """version = 1
[sampling]
plants = 30
search_generations = 0
[step]
duration_s = 3.0
[require]
"stability.searched_radius" = false
"robust.mu" = false
"axes.disk_margin" = false
"mimo.disk_margin" = false
"axes.gain_margin" = { min = 1.2 }
"axes.phase_margin_deg" = { min = 10.0 }
"axes.sensitivity" = { max = 6.0 }
"step.overshoot_pct" = { max = 60.0 }
"step.load_rms_deg" = { max = 9.0 }
"step.settling_s" = { max = 3.0 }
"step.steady_rms_deg" = { max = 2.0 }
"step.rise_s" = { max = %s }
"""


@pytest.fixture
def call(tmp_path: Path) -> list[str]:
    (tmp_path / "wanted.toml").write_text(QUICK % 1.5)
    return ["tune", str(MODEL), "--requirements", str(tmp_path / "wanted.toml"), "--kinds", "pi", "--workers", "0",
            "--budget", "2", "-o", str(tmp_path / "out")]  # fmt: skip


@pytest.mark.slow
def test_the_folder_holds_what_belongs_to_the_best(
    tmp_path: Path, call: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    # Another one than `tune` would make: what it is given goes with the controller.
    eyes = tmp_path / "eyes.npz"
    KalmanSettings(order="jacobi").design(softneck.load(MODEL)).save(eyes)
    call += ["--observer", str(eyes)]
    assert run([*call, "--json"]) == 0
    values, folder = json.loads(capsys.readouterr().out), tmp_path / "out"
    assert softneck.load(folder / "observer.npz").order == "jacobi"
    assert set(values) >= {"best", "pareto", "binding", "evaluations"}
    assert values["best"].keys() >= {"kind", "file", "metrics", "holds"}
    assert (values["best"]["kind"], values["best"]["holds"], values["binding"]) == ("pi", True, None)
    assert values["evaluations"] == 2
    assert all(row.keys() >= {"kind", "settings", "metrics"} for row in values["pareto"])
    assert {path.name for path in folder.iterdir()} >= {
        "best.npz", "observer.npz", "best.certificate.json", "loop.toml", "pareto.csv", "report.html", "tuner.html"
    }  # fmt: skip
    assert len((folder / "pareto.csv").read_text().splitlines()) == 1 + len(values["pareto"])
    # What the certificate says `verify` says too, with the requirements that are left there.
    asked = ["--requirements", str(folder / "requirements.toml")]
    assert run(["verify", str(folder / "best.npz"), str(MODEL), *asked, "--json", "-o", str(tmp_path / "c.json")]) == 0
    again, mine = json.loads(capsys.readouterr().out), read_certificate(folder / "best.certificate.json").contents
    assert [(r["metric"], r["value"], r["holds"]) for r in again["requirements"]] == [
        (r["metric"], r["value"], r["holds"]) for r in mine["requirements"]
    ]
    assert run(["simulate", str(folder / "loop.toml"), "--json"]) == 0
    # The same command again judges nothing anew and finds the same.
    capsys.readouterr()
    assert run([*call, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == values


@pytest.mark.slow
def test_what_does_not_hold_is_said_and_leaves_no_certificate(
    tmp_path: Path, call: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "best.certificate.json").write_text("of an earlier search")
    (tmp_path / "wanted.toml").write_text(QUICK % 0.25)
    assert run(call) == 1
    said = capsys.readouterr()
    assert "step.rise_s fails" in said.err
    assert "requirements: " in said.err
    assert "fails" in said.out
    assert not (folder / "best.certificate.json").exists()
    assert (folder / "best.npz").exists()


LOOPED = """
"sim.overshoot_pct" = { max = 60.0 }
"sim.rise_s" = { max = 2.5 }
"sim.settling_s" = { max = 4.0 }
"sim.steady_rms_deg" = { max = 4.0 }
"sim.slack_s" = false
"sim.limit_violation_s" = false
"track.circle_rms_deg" = { max = 30.0 }
"track.ahead_rms_deg" = { max = %s }
"""


@pytest.fixture
def looped(tmp_path: Path) -> list[str]:
    (tmp_path / "wanted.toml").write_text(QUICK % 1.5 + LOOPED % 30.0)
    return ["tune", str(MODEL), str(GREYBOX), "--kinds", "pi", "--workers", "0", "-o", str(tmp_path / "out")]


@pytest.mark.slow
def test_a_budget_too_small_is_said_and_its_search_goes_on_with_what_it_wrote(
    tmp_path: Path, looped: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    assert run([*looped, "--budget", "1", "--requirements", str(tmp_path / "wanted.toml")]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "The budget of 1 ended before all loops were simulated: sim.overshoot_pct, " in said
    assert "larger --budget" in said
    assert (folder / "best.npz").exists()
    # `verify`, without noise and circle, would hold.
    assert not (folder / "best.certificate.json").exists()
    # The file that was written asks for the same: another search would be refused here.
    wanted = ["--requirements", str(folder / "requirements.toml")]
    assert run([*looped, "--budget", "3", *wanted, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["evaluations"] == 3
    assert any("less a reserve of" in line for line in values["requirements"])
    assert json.loads((folder / "best.certificate.json").read_text())["holds"]
    check = ["verify", str(folder / "best.npz"), str(MODEL), str(GREYBOX), *wanted, "--json"]
    assert run([*check, "-o", str(tmp_path / "c.json")]) == 0
    told = capsys.readouterr()
    limits = {row["metric"]: row["limit"] for row in json.loads(told.out)["requirements"]}
    assert limits["sim.overshoot_pct"] == 60.0 - 1.6  # less the reserve of the defaults, once
    assert "track.ahead_rms_deg, track.circle_rms_deg not looked at" in told.err


@pytest.mark.slow
def test_no_certificate_where_the_loops_of_tuning_alone_do_not_hold(
    tmp_path: Path, looped: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    # A circle that closely followed no neck keeps: `verify` does not look at it.
    (tmp_path / "wanted.toml").write_text(QUICK % 1.5 + LOOPED % 0.001)
    assert run([*looped, "--budget", "3", "--requirements", str(tmp_path / "wanted.toml")]) == 1
    assert "track.ahead_rms_deg fails" in capsys.readouterr().err
    assert not (tmp_path / "out" / "best.certificate.json").exists()


@pytest.mark.parametrize("binding", ["sim.rise_s", "axes.gain_margin", None])
def test_draws_that_decide_little_ask_for_a_recording(binding: str | None) -> None:
    way = way_on(binding, unheard=False, doubt="they cover 79 % of middle motions, not 95 %")
    assert "79 % of middle motions" in way
    assert "record longer" in way
    assert "oosen" not in way
    assert "budget" not in way


def test_nobody_is_told_to_loosen_a_margin() -> None:
    assert "Loosen it" in way_on("sim.rise_s", unheard=False)
    for margin in ("axes.gain_margin", "mimo.disk_margin", "robust.mu", "stability.radius"):
        assert "slower rise" in way_on(margin, unheard=False)
        assert "oosen" not in way_on(margin, unheard=False)
    assert "Record" in way_on("axes.gain_margin", unheard=True)
    # More recordings do not give a kind its linear form.
    assert "kinds with a linear form" in way_on("axes.gain_margin", unheard=True, blind=True)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (["--requirements", "{folder}/fast.toml"], "within the motors' slew and range"),
        (["--kinds", ""], "unknown kind of controller ``"),
        (["--kinds", "pie"], "unknown kind of controller `pie`"),
        (["--requirements", "{folder}/none.toml"], "no such file"),
        (["-o", "{folder}/wanted.toml"], "is a file; name a folder"),
        (["--budget", "0"], "0 is not in the range"),
        (["--observer", str(MODEL)], "is a model (oe), not"),
    ],
)
def test_bad_input_is_said_before_anything_is_searched(
    tmp_path: Path, call: list[str], capsys: pytest.CaptureFixture[str], change: list[str], match: str
) -> None:
    (tmp_path / "fast.toml").write_text(QUICK % 0.05)
    assert run([*call, *(text.format(folder=tmp_path) for text in change)]) == 2
    assert match in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_default_requirements_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["tune", "--print-requirements"]) == 0
    assert '"sim.rise_s" = { max = 0.49 }' in capsys.readouterr().out
