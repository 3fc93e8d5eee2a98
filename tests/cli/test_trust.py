"""Python that a loop or study file names: run from the loop's folder, asked for from elsewhere, never for a report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softneck.cosim.loops._loop_file import foreign_python

from .conftest import Call

LOOP = """{folder}duration_s = 0.2
[plant]
neck = "paper"
[controller]
python = "{module}:make"
[reference]
kind = "step"
pitch_deg = 1.0
"""
# Says that it ran, before anything can fail.
CODE = "from pathlib import Path\nPath({ran!r}).write_text('ran')\ndef make():\n    raise ValueError('no controller')\n"


def written(folder: Path, module: str, *, place: Path | None = None, key: str = "") -> tuple[Path, Path]:
    """Write a loop that names `module`, and the module at `place`; return the loop and what appears when it runs."""
    folder.mkdir(exist_ok=True)
    ran = folder.parent / f"{module}.ran"
    target = (place or folder) / f"{module.replace('.', '/')}.py"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(CODE.format(ran=str(ran)))
    loop = folder / "loop.toml"
    loop.write_text(LOOP.format(folder=key, module=module))
    return loop, ran


def test_python_of_the_loop_s_folder_runs(call: Call, tmp_path: Path) -> None:
    for module in ("trusted_here", "trusted_package.inside"):
        loop, ran = written(tmp_path / "project", module)
        assert "no controller" in call("simulate", loop).err
        assert ran.exists()


@pytest.mark.parametrize("command", ["simulate", "study", "drives"])
def test_python_of_elsewhere_asks_for_trust(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    elsewhere = tmp_path / "elsewhere"
    module = f"foreign_to_{command}"
    loop, ran = written(tmp_path / "project", module, place=elsewhere)
    monkeypatch.syspath_prepend(str(elsewhere))
    (loop.parent / "study.toml").write_text('loop = "loop.toml"\nruns = 1\n[vary]\n"reference.pitch_deg" = [1.0]\n')
    words = {
        "simulate": ("simulate", loop),
        "study": ("study", loop.parent / "study.toml", "--workers", "0", "-o", "out"),
        "drives": ("drives", "run", loop, "--loop", loop, "--simulated"),
    }[command]
    said = call(*words)
    assert said.code == 2
    assert (
        f"python = `{module}:make` is not in the loop's folder and would run with your rights; use --trust" in said.err
    )
    assert not ran.exists()
    call(*words, "--trust")
    assert ran.exists()


def test_another_folder_a_link_and_a_library_are_elsewhere(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    loop, _ = written(tmp_path / "project", "moved", place=elsewhere, key='folder = "../elsewhere"\n')
    assert foreign_python(loop) == "moved:make"
    (loop.parent / "moved.py").symlink_to(elsewhere / "moved.py")
    loop.write_text(LOOP.format(folder="", module="moved"))
    assert foreign_python(loop) == "moved:make"
    for module in ("os", "subprocess", "not_to_be_found"):
        loop.write_text(LOOP.format(folder="", module=module))
        assert foreign_python(loop) == f"{module}:make"
    # What a study puts in the place of a part counts with it.
    loop.write_text(LOOP.format(folder="", module="softneck.verification"))
    assert foreign_python(loop) == ""
    loop.write_text(LOOP.format(folder="", module="here"))
    (loop.parent / "here.py").write_text("")
    assert foreign_python(loop) == ""
    study = loop.parent / "study.toml"
    for vary in ('"controller.python" = { choices = ["here:make", "os:abort"] }',
                 'controller = { choices = [{ python = "here:make" }, { python = "os:abort" }] }'):  # fmt: skip
        study.write_text(f'loop = "loop.toml"\n[vary]\n{vary}\n')
        assert foreign_python(study) == "os:abort"


def test_a_report_never_runs_python(call: Call, tmp_path: Path) -> None:
    loop, ran = written(tmp_path / "project", "never_by_a_report")
    said = call("report", loop.parent, "-o", "page.html", "--json")
    assert said.code == 0, said.err
    problem = json.loads(said.out)["problems"]["loop.toml"]
    assert "names Python (`never_by_a_report:make`), which a report never runs" in problem
    assert not ran.exists()
