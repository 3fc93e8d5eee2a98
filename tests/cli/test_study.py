"""softneck study and softneck report as users call them."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from softneck.cosim import read_runs

from ..browser import own_text, shown
from .conftest import Call

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow

PARTS = Path(__file__).parents[1] / "cosim" / "study_parts.py"
LOOP = """
duration_s = 1.0
[plant]
python = "study_parts:Lag"
[controller]
python = "study_parts:Gain"
[reference]
kind = "step"
pitch_deg = 10.0
[limits]
"pitch.rms_error_deg" = 7.0
"""
STUDY = """
loop = "loop.toml"
runs = 12
[vary]
"plant.parameters.pole" = { uniform = [0.85, 0.95] }
"controller.parameters.gain" = { choices = [2.0, 6.0] }
order = ["sequential", "jacobi"]
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    # Loaded from another test's folder it would be Python of elsewhere.
    monkeypatch.delitem(sys.modules, "study_parts", raising=False)
    shutil.copy(PARTS, tmp_path)
    (tmp_path / "loop.toml").write_text(LOOP)
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


def test_a_study_leaves_runs_report_and_worst_cases(call: Call, project: Path) -> None:
    said = call("study", "study.toml", "-o", "out", "--workers", "0", "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert (facts["runs"], facts["failed"], len(facts["worst"])) == (12, 0, 3)
    assert (project / "out" / "report.html").is_file()
    runs = read_runs(project / "out").set_index("run")
    for path in facts["worst"]:
        # They lie in out/worst, the Python that they name in the folder of the study.
        again = call("simulate", path, "--json", "--force", "--trust")
        number = int(Path(path).stem.removeprefix("run_"))
        metrics = json.loads(again.out)["metrics"]
        # JSON carries every bit of a float.
        assert metrics["pitch"]["iae"] == runs.loc[number, "pitch.iae"]
        assert again.code == (0 if runs.loc[number, "holds"] is True or bool(runs.loc[number, "holds"]) else 1)


def test_a_study_s_table_names_what_varied(call: Call, project: Path) -> None:
    said = call("study", "study.toml", "-o", "out", "--workers", "0")
    assert said.code == 0
    assert "plant.pole" in said.out
    assert "12 runs, 0 failed" in said.err
    before = (project / "out" / "runs.csv").read_bytes()
    assert call("study", "study.toml", "-o", "out", "--workers", "0").code == 0
    assert (project / "out" / "runs.csv").read_bytes() == before  # the seconds too: no run was done again
    assert call("study", "study.toml", "-o", "out", "--workers", "0", "--force").code == 0


def test_a_file_where_the_folder_should_be_is_refused_before_the_runs(call: Call, project: Path) -> None:
    said = call("study", "study.toml", "-o", "loop.toml", "--workers", "0")
    assert (said.code, said.error) == (2, "softneck: loop.toml: is a file; name a folder.")
    assert not (project / "build").exists()


def test_info_knows_a_study(call: Call, project: Path) -> None:
    facts = json.loads(call("info", "study.toml", "--json").out)
    assert (facts["type"], facts["runs"]) == ("study", 12)
    assert facts["varies"] == "plant.parameters.pole, controller.parameters.gain, order"


def test_a_study_of_failures_alone_fails(call: Call, project: Path) -> None:
    (project / "study.toml").write_text('loop = "loop.toml"\n[vary]\n"plant.parameters.fails" = [1.0, 2.0]\n')
    said = call("study", "study.toml", "-o", "out", "--workers", "0", "--json")
    assert said.code == 1
    assert "every run failed; the first said: the lag was told to fail" in said.err
    assert read_runs(project / "out")["error"].tolist() == ["the lag was told to fail"] * 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('loop = "loop.toml"\nruns = 5\n', "study.toml: the study varies nothing"),
        ('runs = 5\n[vary]\norder = ["jacobi"]\n', "study.toml: `loop` is missing"),
        ('loop = "none.toml"\n[vary]\norder = ["jacobi"]\n', "there is no loop file"),
        (STUDY.replace("runs = 12", "runs = 0"), "`runs` must be a whole number between 1 and 1000000; got 0"),
        (STUDY.replace("[0.85, 0.95]", "[0.95, 0.85]"), "`plant.parameters.pole`: the uniform range from 0.95 to 0.85"),
        (STUDY.replace("parameters.pole", "parameters.mass"), "no key `plant.parameters.mass`"),
        ("loop = ", "is not valid TOML"),
    ],
)
def test_bad_studies_are_one_line(text: str, message: str, call: Call, project: Path) -> None:
    (project / "study.toml").write_text(text)
    said = call("study", "study.toml", "-o", "out", "--workers", "0")
    assert said.code == 2
    assert message in said.error
    assert not (project / "out").exists()


def test_another_study_s_folder_stays_as_it_is(call: Call, project: Path) -> None:
    assert call("study", "study.toml", "-o", "out", "--workers", "0").code == 0
    before = {path: path.read_bytes() for path in (project / "out").rglob("*") if path.is_file()}
    (project / "study.toml").write_text(STUDY.replace("runs = 12", "runs = 14"))
    said = call("study", "study.toml", "-o", "out", "--workers", "0")
    assert said.code == 2
    assert "holds another study (other runs)" in said.error
    assert {path: path.read_bytes() for path in (project / "out").rglob("*") if path.is_file()} == before


@pytest.fixture
def whole(call: Call, project: Path, recording: Path, rls_file: Path) -> Path:
    """A project with something of everything, and a file that cannot be read."""
    (project / "data").mkdir()
    shutil.copy(recording, project / "data" / "neck.csv")
    shutil.copy(rls_file, project / "rls.npz")
    for arguments in (("design", "pi", "rls.npz", "-o", "pi.npz"), ("observer", "rls.npz", "-o", "kalman.npz"),
                      ("fmu", "pi.npz", "-o", "Pi.fmu"), ("study", "study.toml", "-o", "build/study", "--workers", "0"),
                      ("simulate", "loop.toml", "-o", "build/run.csv", "--certificate", "loop.json")):  # fmt: skip
        said = call(*arguments)
        assert said.code in (0, 1), said.err
    (project / "broken.npz").write_bytes(b"no archive")
    plain = LOOP.replace('python = "study_parts:Lag"', 'neck = "paper"')
    (project / "plain.toml").write_text(plain.replace('python = "study_parts:Gain"', 'file = "pi.npz"'))
    return project


def test_a_project_on_one_page(call: Call, whole: Path, browser: Browser) -> None:
    """All is there; it asks for nothing, complains of nothing, fits a phone, and its links lead somewhere."""
    said = call("report", ".", "-o", "report.html", "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    names = ("models", "observers", "controllers", "certificates", "fmus", "loops", "studies")
    assert [facts[name] for name in names] == [1] * 7
    assert facts["recordings"] == 2
    # The loop whose parts are Python of the project is not run.
    assert set(facts["problems"]) == {"broken.npz", "loop.toml"}
    page = whole / "report.html"
    text = own_text(page.read_text(encoding="utf-8"))
    for title in ("Data", "Models", "Observers and controllers", "Verification", "FMUs", "Loops", "Problems"):
        assert f"<h2>{title}</h2>" in text
    with shown(browser, page) as view:
        assert view.complaints == []
        assert [url for url in view.requests if not url.startswith(("file:", "data:", "blob:"))] == []
        inside = "[...document.querySelectorAll('nav a')]"
        dead = f"{inside}.filter(a => !document.querySelector(a.getAttribute('href'))).length"
        assert view.page.evaluate("document.querySelectorAll('nav a').length") >= 10
        assert view.page.evaluate(dead) == 0
        charts = view.page.evaluate("document.querySelectorAll('.chart').length")
        assert charts >= 6
        drawn = "[...document.querySelectorAll('.chart')].filter(c => c.children.length && c.clientHeight > 100).length"
        assert view.page.evaluate(drawn) == charts
        papers = []
        for scheme in ("light", "dark"):
            view.page.emulate_media(color_scheme=scheme)
            papers.append(view.page.evaluate("getComputedStyle(document.body).backgroundColor"))
        assert papers[0] != papers[1]
        view.page.set_viewport_size({"width": 390, "height": 800})
        view.settle()
        # Wide tables scroll by themselves; the page does not.
        assert view.page.evaluate("document.documentElement.scrollWidth") <= 390


def test_a_changed_file_makes_its_certificate_stale(call: Call, whole: Path) -> None:
    with (whole / "loop.toml").open("a") as file:
        file.write('"pitch.iae" = 9.0\n')
    assert call("report", ".", "-o", "report.html").code == 0
    text = own_text((whole / "report.html").read_text(encoding="utf-8"))
    row = text.split("files changed since", 1)[1].split("</table>")[0]
    assert "loop.toml" in row


def test_reports_of_nothing(call: Call, tmp_path: Path) -> None:
    assert "is not a folder" in call("report", "nowhere").error
    (tmp_path / "empty").mkdir()
    assert "holds no softneck files" in call("report", "empty").error
    # The front of a search is no recording that cannot be read.
    (tmp_path / "empty" / "pareto.json").write_text("[]")
    (tmp_path / "empty" / "pareto.csv").write_text("kind\npi\n")
    assert "holds no softneck files" in call("report", "empty").error
    (tmp_path / "empty" / "pareto.json").unlink()
    assert call("report", "empty").code == 0
