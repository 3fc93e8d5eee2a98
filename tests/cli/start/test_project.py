"""What a project is made of: the robot that is copied, the loop of `tune` over FMUs, its study and its test."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from softneck.cli.start._plan import CONTROLLER_FMU, OBSERVER_FMU, PLANT_FMU
from softneck.loop._references import make_reference
from softneck.loop._result import metric_names
from softneck.robot import Robot
from softneck.signals import signal

from ..conftest import Call

# As `softneck tune` writes it.
TUNED: dict[str, Any] = {
    "duration_s": 7.0,
    "plant": {"model": "../models/auto.npz"},
    "observer": {"file": "observer.npz"},
    "controller": {"file": "best.npz"},
    "reference": {"kind": "step", "pitch_deg": 10.0, "at_s": 1.0},
    "limits": {"pitch.overshoot_pct": 5.0, "pitch.rise_s": 0.4},
}


def table(name: str) -> dict[str, Any]:
    return tomllib.loads(Path("p", name).read_text(encoding="utf-8"))


def made(call: Call, loop: dict[str, Any], *more: str) -> int:
    Path("tuned.toml").write_text(tomli_w.dumps(loop), encoding="utf-8")
    return call("new", "p", "--loop", "tuned.toml", *more).code


def test_the_study_of_another_robot_asks_in_its_units(call: Call) -> None:
    tables = {"name": "arm", "motors": {"names": ["a", "b"], "unit": "V"}, "outputs": {"names": ["x"], "unit": "m"},
              "directions": {"kind": "identified"}}  # fmt: skip
    Path("p").mkdir()
    Path("p/robot.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
    loop = {**TUNED, "reference": {"kind": "step", "x_m": 0.1, "at_s": 1.0}, "limits": {}}
    assert made(call, loop, "--force") == 0
    study = table("study.toml")
    assert study["objectives"] == ["x.settling_s", "motors.total_variation_V"]
    assert set(study["objectives"]) <= set(metric_names(Robot.read("p/robot.toml")))


def test_a_robot_of_one_output_is_asked_for_that_output_alone(call: Call) -> None:
    tables = {"name": "one axis", "motors": {"names": ["a", "b"], "unit": "rad"},
              "outputs": {"names": ["pitch"], "unit": "rad", "display_unit": "deg"},
              "directions": {"kind": "identified"}}  # fmt: skip
    Path("p").mkdir()
    Path("p/robot.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
    assert made(call, TUNED, "--force") == 0
    reference = {key: value for key, value in table("loop.toml")["reference"].items() if key != "kind"}
    # It takes no key of an output that the robot does not have.
    assert make_reference("step", reference, Robot.read("p/robot.toml")).values == pytest.approx([np.radians(10.0)])
    varied = {key.partition(".")[2] for key in table("study.toml")["vary"] if key.startswith("reference.")}
    assert varied <= set(reference)


def test_the_project_of_a_loop_keeps_what_was_judged_and_takes_fmus(call: Call) -> None:
    assert made(call, TUNED) == 0
    loop = table("loop.toml")
    for key in ("duration_s", "limits"):
        assert loop[key] == TUNED[key]
    assert loop["reference"] == {**TUNED["reference"], "roll_deg": 0.0}
    assert (loop["plant"]["fmu"], loop["observer"], loop["controller"]) == (
        PLANT_FMU, {"fmu": OBSERVER_FMU}, {"fmu": CONTROLLER_FMU}
    )  # fmt: skip
    assert loop["plant"]["parameters"]["noise_std"] == Robot.preset("neck").noise_std
    study = table("study.toml")
    assert study["vary"]["reference.pitch_deg"]["grid"][-1] == 10.0, "the step that was judged is in the study"
    for key in study["vary"]:
        inside: Any = loop
        for part in key.split("."):
            inside = inside[part]  # every key that varies is in the loop
    assert "closed_loop" in Path("p/test_closed_loop.py").read_text()
    assert "NAME" not in Path("p/README.md").read_text()
    # What is the same in the project of the virtual neck.
    call("new", "q")
    for name in ("pyproject.toml", ".gitignore"):
        assert Path("p", name).read_text().replace('"p"', '"q"') == Path("q", name).read_text()


def test_a_loop_without_observer_or_limits_has_none(call: Call) -> None:
    bare = {key: value for key, value in TUNED.items() if key not in ("observer", "limits")}
    assert made(call, bare) == 0
    assert not {"observer", "limits"} & set(table("loop.toml"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"reference": {"kind": "sine"}}, "a project is made around a loop with a step"),
        ({"plant": "x"}, r"is no loop file: [plant], [controller] and [reference] are needed"),
    ],
)
def test_what_is_no_such_loop_makes_nothing(call: Call, change: dict[str, Any], says: str) -> None:
    Path("tuned.toml").write_text(tomli_w.dumps({**TUNED, **change}), encoding="utf-8")
    said = call("new", "p", "--loop", "tuned.toml")
    assert said.code == 2
    assert says in said.error
    assert not Path("p").exists()
    Path("tuned.toml").write_text("= no", encoding="utf-8")
    assert "is not valid TOML" in call("new", "p", "--loop", "tuned.toml").error


def test_a_robot_file_in_another_folder_names_the_same_files(call: Call, tmp_path: Path) -> None:
    call("robot", "new", "there/robot.toml")
    text = Path("there/robot.toml").read_text().replace('neck = "paper"', 'neck = "mine/neck.toml"')
    Path("there/robot.toml").write_text(text)
    assert call("robot", "new", "here/robot.toml", "--preset", "there/robot.toml").code == 0
    first, second = Robot.read("there/robot.toml"), Robot.read("here/robot.toml")
    assert first.hash == second.hash
    assert first.neck is not None
    assert second.neck is not None
    assert (tmp_path / "there" / first.neck).resolve() == (tmp_path / "here" / second.neck).resolve()
    # Beside it, it is the same text, remarks and all.
    assert call("robot", "new", "there/copy.toml", "--preset", "there/robot.toml").code == 0
    assert Path("there/copy.toml").read_text() == text
    Path("there/robot.toml").write_text("nonsense = 1\n")
    assert call("robot", "new", "third.toml", "--preset", "there/robot.toml").code == 2
    assert not Path("third.toml").exists()


def test_the_signal_that_a_refusal_asks_for_is_one(call: Call) -> None:
    from softneck.cli.start._start import _NEXT_RECORDING

    assert "`mixed`" in _NEXT_RECORDING
    assert signal("mixed", duration=10.0).set_points.shape[1] == 3


def test_a_page_leaves_out_the_worst_plants_of_a_certificate_and_nothing_else(tmp_path: Path) -> None:
    from softneck.report._project import _files

    for name in ("best.certificate.json", "best_worst/a.toml", "my_worst/b.toml", "_worst/c.toml", "loop.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    found = {path.relative_to(tmp_path).as_posix() for path in _files(tmp_path)}
    assert found == {"best.certificate.json", "my_worst/b.toml", "_worst/c.toml", "loop.toml"}
