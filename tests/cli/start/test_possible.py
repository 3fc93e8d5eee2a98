"""Defaults of `tune` that cannot be are left out, and the verdict says that they do not hold."""

from __future__ import annotations

import itertools
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tomli_w

import softneck.tuning
import softneck.tuning._tune
from softneck.cli.start import _plan, _possible, _project_run, _start
from softneck.cli.start._plan import PI, Options, Step, Unmet
from softneck.core import CheckFailedError, SettingsError
from softneck.robot import Robot

from ..conftest import Call
from .conftest import facts_of, short_plan

# Of a linear model alone, whose steps are asked of it.
WHY = {
    "step.rise_s": "`step.rise_s` <= 0.4 s cannot be: too slow.",
    "track.ahead_rms_deg": "`track.ahead_rms_deg` cannot be: late.",
}


def refuse(asked: Any, _: Any) -> None:
    for metric, why in WHY.items():
        if asked.robot_limit(metric) is not None:
            raise SettingsError(why)


def test_all_that_a_robots_file_lacks_is_named_at_once() -> None:
    for name in ("neck", "antagonist", "finger", "trunk4"):
        _possible.require_known(Robot.preset(name))
    bare = {"name": "pump", "motors": {"names": ["pump"], "unit": "V"}, "outputs": {"names": ["level"], "unit": "V"},
            "directions": {"kind": "identified"}, "sensor": {"delay_s": 0.0}}  # fmt: skip
    lacks = "motors.setpoint_min, motors.setpoint_max, motors.rate_limit, sensor.noise_std, sensor.rate_hz"
    with pytest.raises(SettingsError, match=re.escape(f"robot.toml: add {lacks};")) as said:
        _possible.require_known(Robot.from_dict(bare))
    assert len(str(said.value)) <= 160
    # A preset may lack some as well, and only those are named.
    arm = "robot.toml: add motors.rate_limit, sensor.noise_std, sensor.delay_s, sensor.rate_hz; controller"
    with pytest.raises(SettingsError, match=re.escape(arm)):
        _possible.require_known(Robot.preset("arm"))


def test_each_default_that_cannot_be_is_left_out_with_its_reason(
    tmp_path: Path, rls_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(softneck.tuning, "check_feasibility", refuse)
    assert _possible.possible((str(rls_file),)) == " ".join(WHY.values())
    text = Path(_possible.FILE).read_text(encoding="utf-8")
    assert tomllib.loads(text)["require"] == dict.fromkeys(WHY, False)
    assert all(f"# {why}" in text for why in WHY.values())
    # Nothing is left out, and no file made, where all can be.
    Path(_possible.FILE).unlink()
    monkeypatch.setattr(softneck.tuning, "check_feasibility", lambda *_: None)
    assert _possible.possible((str(rls_file),)) == ""
    assert not Path(_possible.FILE).exists()


def test_what_is_no_requirement_s_fault_is_refused(rls_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any) -> None:
        raise SettingsError("the plant cannot be: it is no plant.")

    monkeypatch.setattr(softneck.tuning, "check_feasibility", never)
    with pytest.raises(SettingsError, match="it is no plant"):
        _possible.impossible((str(rls_file),))


@pytest.mark.parametrize("ends", ["holds", "fails"])
def test_what_was_left_out_fails_in_the_verdict_whatever_came_of_the_rest(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch, ends: str
) -> None:
    def plan(asked: Options) -> Iterator[Step]:
        command = ("softneck", "robot", "new", "robot.toml", "--preset", "neck", "--force")
        why = "The circle cannot be."
        yield Step(stage="tune", command=command, makes=("robot.toml",), reads=asked.logs, finding=why)

    def facts(run: _project_run.ProjectRun, folder: Path) -> dict[str, Any]:
        rows = [{"stage": "tune", "done_before": False, **entry} for entry in run.done.values()]
        return {
            "folder": str(folder),
            "models": {},
            "loosened": {},
            "draws": [],
            "judged_elsewhere": {},
            "report": "",
            "doubts": {},
            "failed": ["tune"],
            "steps": rows,
        }

    def failing(words: tuple[str, ...], *, as_json: bool) -> None:
        inner(words, as_json=as_json)
        raise _project_run.CheckFailedError("rise_s stands in the way.")

    inner = _project_run._softneck
    if ends == "fails":
        monkeypatch.setattr(_project_run, "_softneck", failing)
    monkeypatch.setattr(_start, "steps", plan)
    monkeypatch.setattr(_start, "_facts", facts)
    said = call("start", short, "-o", "p", "--yes", "--json")
    assert said.code == 1
    (step,) = json.loads(said.out)["steps"]
    assert not step["holds"]
    more = " rise_s stands in the way." if ends == "fails" else ""
    assert re.search(re.escape(f"tune does not hold: The circle cannot be.{more}"), said.err)


@pytest.mark.parametrize(
    ("robot", "what"), [("neck", "Record 60 s of `mixed`"), ("finger", "Record steps of every motor, each held")]
)
@pytest.mark.parametrize(("why", "records"), [("30 % is the least to design on.", True), ("it has no rise.", False)])
def test_a_log_is_asked_for_only_where_the_model_is_at_fault(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch, why: str, records: bool, robot: str, what: str
) -> None:
    def plan(asked: Options) -> Iterator[Step]:
        yield Step(stage="identification", command=("softneck", "design", "pi"), makes=(PI,), reads=asked.logs)

    def refuse_design(*_: Any, **__: Any) -> None:
        Path("robot.toml").write_text(f'extends = "{robot}"\n')
        raise SettingsError(why)

    monkeypatch.setattr(_start, "steps", plan)
    monkeypatch.setattr(_project_run, "_softneck", refuse_design)
    said = call("start", short, "-o", "p", "--yes")
    assert (what in said.err.splitlines()[-1]) == records
    assert ("`mixed`" in said.err) == (records and robot == "neck")  # no signal for a pneumatic finger
    assert why in said.err.splitlines()[-1]
    assert said.code == (1 if records else 2)


def test_a_family_that_cannot_be_made_is_done_without_and_none_of_other_recordings_is_left(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run goes on, says why, and plans on the models alone; where it can be made it is the first plant."""

    def plan(asked: Options) -> Iterator[Step]:
        Path("models").mkdir(exist_ok=True)
        Path(_plan.FAMILY).write_bytes(b"of an earlier call")
        yield Step(stage="identification", command=("softneck", "family", "log.csv"), makes=(_plan.FAMILY,),
                   reads=asked.logs, unmet=Unmet.DONE_WITHOUT)  # fmt: skip
        yield from itertools.islice(short_plan(asked), 1)
        planned.append(next(_plan._controller(asked)).command)

    def refuse_family(words: tuple[str, ...], *, as_json: bool) -> None:
        if words[1] == "family":
            raise SettingsError("log.csv: too short.")
        inner(words, as_json=as_json)

    inner, planned = _project_run._softneck, list[tuple[str, ...]]()
    monkeypatch.setattr(_start, "steps", plan)
    monkeypatch.setattr(_start, "_facts", facts_of)
    monkeypatch.setattr(_project_run, "_softneck", refuse_family)
    monkeypatch.setattr(_plan, "possible", lambda _: "")
    said = call("start", short, "-o", "p", "--yes")
    assert said.code == 0, said.err
    assert "continues without models/family.npz: log.csv: too short." in " ".join(said.err.split())
    assert not Path("p", _plan.FAMILY).exists()
    assert planned[0][2:5] == ("models/auto.npz", "--kinds", "pi,pid,fopi,hinf,lqg,mpc")
    Path("models").mkdir()
    Path(_plan.FAMILY).touch()
    assert call("robot", "new", "robot.toml", "--preset", "neck").code == 0
    cases = [(None, None, "auto.npz"), ("draws", "nonlinear", "auto.npz"), (None, "nonlinear", "auto_nonlinear.npz"),
             ("draws", "linear", "auto.npz")]  # fmt: skip
    for draws, other, second in cases:
        # The better model stands in auto.npz, the best of the other sort beside it.
        family = SimpleNamespace(draws=draws)
        monkeypatch.setattr(_plan, "load", {Path(_plan.FAMILY): family, _plan.FAMILY: family}.get)
        others = [Path("models", f"auto_{other}.npz")] * (other is not None)
        for path in others:
            path.touch()
        beside = next(_plan._controller(Options(logs=())))
        kinds = "pi,hinf" if draws else "pi,pid,fopi,hinf,lqg"
        assert beside.command[2:6] == (_plan.FAMILY, f"models/{second}", "--kinds", kinds)
        assert beside.command[6:8] == ("--budget", "40" if draws else "60")
        asked = next(_plan._controller(Options(logs=(), budget=7)))
        assert asked.command[6:8] == ("--budget", "7")
        plant = beside.beside[0].command[2]
        assert plant == ("models/auto_nonlinear.npz" if other == "nonlinear" else "models/auto.npz")
        for path in others:
            path.unlink()


@pytest.mark.parametrize("bad", ["yaw", "roll"])
def test_an_output_that_spoils_the_model_of_the_others_may_be_left_out(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch, bad: str
) -> None:
    leave = f"Leave {bad} out of `outputs.names` in a robot.toml"

    def plan(asked: Options) -> Iterator[Step]:
        yield Step(stage="identification", command=("softneck", "identify", "auto"), makes=("m.npz",), reads=asked.logs,
                   unmet=Unmet.NO_MODEL)  # fmt: skip

    def refuse(*_: Any, **__: Any) -> None:
        why = f"no kind is a model of the rows held out: its fit in simulation is -31.9 % in {bad}."
        Path("robot.toml").write_text(tomli_w.dumps(Robot.preset().as_dict()), encoding="utf-8")
        raise CheckFailedError(f"models/auto.npz: {why} {leave}: without it pitch fits 76.5 %.")

    monkeypatch.setattr(_start, "steps", plan)
    monkeypatch.setattr(_project_run, "_softneck", refuse)
    said = call("start", short, "-o", "p", "--yes")
    last = said.err.splitlines()[-1]
    assert said.code == 1
    # Of a neck's log one option takes the other output alone.
    advice = {"yaw": leave, "roll": "Go on without roll: --output pitch"}[bad]
    assert last.endswith(f"its fit in simulation is -31.9 % in {bad}. {advice}.")
    assert len(last) <= 160


def test_a_robots_file_that_lacks_something_is_to_be_mended_and_no_log_to_be_recorded(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare = Robot.from_dict({"name": "pump", "motors": {"names": ["pump"], "unit": "V"},
                            "outputs": {"names": ["level"], "unit": "V"},
                            "directions": {"kind": "identified"}})  # fmt: skip

    def plan(asked: Options) -> Iterator[Step]:
        command = ("softneck", "robot", "new", "m.npz", "--preset", "neck", "--force")
        yield Step(stage="identification", command=command, makes=("m.npz",), reads=asked.logs, unmet=Unmet.NO_MODEL)
        _possible.require_known(bare)

    monkeypatch.setattr(_start, "steps", plan)
    monkeypatch.setattr(_project_run, "_softneck", lambda *_, **__: Path("m.npz").touch())
    for _ in range(2):  # and so it is where the models are kept
        said = call("start", short, "-o", "p", "--yes")
        last = said.err.splitlines()[-1]
        assert said.code == 2
        assert all(f"{table}.{key}" in last for table, key in (("motors", "setpoint_min"), ("sensor", "rate_hz")))
        assert "Record" not in said.err
        assert "run the same command again" in said.err
        assert len(last) <= 160


def test_named_columns_are_given_to_the_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "log.csv"
    log.write_text("t,u,y\n0,1,2\n")
    asked = Options(logs=(str(log),), motors=("u",), outputs=("y",), sample_time="0.1")
    step = _plan._import(str(log), "recordings/log.csv", asked)
    assert step.command[3:9] == ("--motor", "u", "--output", "y", "--sample-time", "0.1")
    # Other columns are another import.
    assert (
        step.depends_on
        != _plan._import(str(log), "recordings/log.csv", Options(logs=(str(log),), motors=("y",))).depends_on
    )


def test_the_verdict_says_what_holds_what_does_not_and_what_to_record(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert _start._certified() == {"loosened": {}, "draws": [], "judged_elsewhere": {}}
    said = {
        "loosened": {"sim.rise_s": {"default": 0.53, "reached": 0.62, "limit": 0.66}},
        "draws": [{"statement": "none of 59 draws of family fails"}],
        "judged_elsewhere": {"payload 1 kg": "judged with at most 0 kg, as recorded"},
    }
    path = tmp_path / "tune/best.certificate.json"
    path.parent.mkdir()
    path.write_text(json.dumps(said), encoding="utf-8")
    row = {"stage": "tune", "holds": True, "seconds": 1.0, "said": "", "done_before": False}
    _start._tell(
        {"folder": "my_neck", "models": {}, **_start._certified(), "doubts": {}, "failed": [], "steps": [row],
         "not_run": {}, "report": "r.html"}, as_json=False,
    )  # fmt: skip
    lines = capsys.readouterr().out.splitlines()
    at = lines.index("all holds but sim.rise_s: 0.62, by default 0.53 is required (certified: 0.66)")
    assert lines[at + 1].startswith(
        "to accept that: --requirements my_neck/tune/requirements.toml; to have more: record"
    )
    assert lines[at + 2 : at + 4] == [
        "none of 59 draws of family fails", "payload 1 kg: judged with at most 0 kg, as recorded"
    ]  # fmt: skip
