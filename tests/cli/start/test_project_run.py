"""A run runs the commands that it prints, does nothing twice, and goes on wherever it was left."""

from __future__ import annotations

import errno
import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

import softneck
from softneck.cli.start import _compile_ahead, _plan, _project_run, _start
from softneck.core import CheckFailedError, DataError, OutputFileError, SettingsError
from softneck.robot import Robot

from ...data import neck_recording
from ..conftest import Call

popen = subprocess.Popen
STEPS = ["robot: robot.toml", "quality: copy.toml", "loop: project/loop.toml"]


def contents(folder: Path) -> dict[str, bytes]:
    """All files but the run's own, which holds seconds."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != _project_run.FILE)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def states(call: Call, *more: str, code: int = 0) -> list[bool]:
    """Run the run and return which of its steps were done before."""
    said = call("start", "log.csv", "-o", "p", "--yes", "--json", *more)
    assert said.code == code, said.err
    return [step["done_before"] for step in json.loads(said.out)["steps"]]


def test_the_commands_that_are_printed_make_the_same_by_hand(call: Call, short: Path, tmp_path: Path) -> None:
    said = call("start", "log.csv", "-o", "p", "--yes")
    assert said.code == 0, said.err
    (tmp_path / "hand").mkdir()
    os.chdir("hand")
    for line in said.out.splitlines():
        if line.startswith("$ softneck "):
            # The project is named after its folder, which is `project` in both.
            assert _main(shlex.split(line)[2:]) == 0, line
    os.chdir("..")
    assert contents(tmp_path / "hand") == contents(tmp_path / "p")
    recorded = json.loads((tmp_path / "p" / "start.json").read_text())["steps"]
    assert list(recorded) == STEPS
    assert [f"$ {entry['command']}" for entry in recorded.values()] == [
        line for line in said.out.splitlines() if line.startswith("$ softneck ")
    ]


def _main(words: list[str]) -> int:
    from softneck.cli._main import run

    return run(words)


def test_what_is_done_is_done_again_only_where_what_it_reads_changed(call: Call, short: Path) -> None:
    assert states(call) == [False] * 3
    assert states(call) == [True] * 3
    made = Path("p/copy.toml")
    made.write_text(made.read_text() + "# mine\n", encoding="utf-8")  # an edit is kept, and what reads it follows
    assert states(call) == [True, True, False]
    assert made.read_text().endswith("# mine\n")
    short.write_text("a,b\n3,4\n", encoding="utf-8")
    # The robot is made anew from another log, and is the same: nothing after it has to be done.
    assert states(call) == [False, True, True]
    Path("p/copy.toml").unlink()
    assert states(call) == [True, False, False], "the edit is gone with the file"


def test_other_settings_do_a_step_again_and_are_kept_for_the_next_time(call: Call, short: Path) -> None:
    assert states(call, "--robot", "arm") == [False] * 3
    assert states(call) == [True] * 3, "what was asked for stands in the folder"
    assert states(call, "--robot", "finger") == [False, False, False]


def beside(plan: Callable[[Any], Iterator[Any]], *words: str) -> Callable[[Any], Iterator[Any]]:
    """Return a plan in which step 2 is a command that begins with step 1."""

    def changed(asked: Any) -> Iterator[Any]:
        first, second, third = plan(asked)
        second = replace(second, command=("softneck", *words), reads=asked.logs)
        yield from (replace(first, beside=(second,)), second, third)

    return changed


@pytest.mark.parametrize("cores", [1, 2])
def test_a_step_that_begins_with_another_makes_and_says_the_same_in_its_turn(
    call: Call, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int
) -> None:
    begun: list[Any] = []
    monkeypatch.setattr(_project_run, "core_count", lambda: cores)
    monkeypatch.setattr(_project_run.subprocess, "Popen", lambda *a, **k: begun.append(popen(*a, **k)) or begun[-1])
    monkeypatch.setattr(_start, "steps", beside(_start.steps, "robot", "new", "copy.toml", "--preset", "arm"))
    said = call("start", "log.csv", "-o", "p", "--yes")
    assert (said.code, len(begun)) == (0, cores - 1), said.err
    lines = said.out.splitlines()
    # A command says what it made after the line that tells of it.
    at = lines.index("$ softneck robot new copy.toml --preset arm")
    assert [line.split(":")[0] for line in lines if line.startswith(("robot.toml:", "copy.toml:"))] == [
        "robot.toml", "copy.toml"]  # fmt: skip
    assert any(line.startswith("copy.toml:") for line in lines[at:])
    assert Robot.read("p/copy.toml").name == "arm"
    assert states(call) == [True] * 3
    assert len(begun) == cores - 1, "what is done does not begin again"


def test_steps_that_begin_early_read_nothing_that_the_steps_before_their_turn_make(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_plan, "possible", lambda _: "")
    assert call("robot", "new", "robot.toml", "--preset", "neck").code == 0
    Path("tune").mkdir()
    Path("tune/loop.toml").write_text("duration_s = 7.0\n", encoding="utf-8")
    asked = _plan.Options(logs=())
    early = 0
    planned = [*_plan._models(["recordings/log.csv"], asked), *_plan._controller(asked)]
    for number, step in enumerate(planned):
        for other in step.beside:
            between = planned[number : planned.index(other)]
            assert not set(other.reads) & {name for one in between for name in one.makes}
            early += 1
    assert early == 4, "the family beside the models, the plant's FMU beside the observer, two beside the search"


def test_a_step_that_failed_beside_another_tells_of_it_in_its_turn(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_project_run, "core_count", lambda: 2)
    monkeypatch.setattr(_start, "steps", beside(_start.steps, "robot", "new", "copy.toml", "--preset", "nobody"))
    said = call("start", "log.csv", "-o", "p", "--yes")
    assert said.code == 2
    assert "nobody" in said.err.splitlines()[-1]
    assert said.err.count("got 'nobody'") == 1, "what the other process said of it is not told twice"


def test_a_step_that_has_no_turn_leaves_no_file(call: Call, short: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[Any] = []
    monkeypatch.setattr(_project_run, "core_count", lambda: 2)
    monkeypatch.setattr(_project_run.subprocess, "Popen", lambda *a, **k: begun.append(popen(*a, **k)) or begun[-1])

    def fails(words: tuple[str, ...], *, as_json: bool) -> None:
        assert begun[0].wait() == 0
        assert Path("copy.toml").is_file()
        raise SettingsError(f"{words[1]} cannot.")

    monkeypatch.setattr(_project_run, "_softneck", fails)
    monkeypatch.setattr(_start, "steps", beside(_start.steps, "robot", "new", "copy.toml", "--preset", "arm"))
    assert call("start", "log.csv", "-o", "p", "--yes").code == 2
    assert not Path("p").exists()


@pytest.mark.parametrize(("cores", "before", "begun"), [(1, False, 0), (2, True, 0), (2, False, 1)])
def test_functions_are_compiled_ahead_on_another_core_once_and_no_longer_than_the_run(
    call: Call, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int, before: bool, begun: int
) -> None:
    made: list[Any] = []
    plan = _start.steps

    def changed(asked: Any) -> Iterator[Any]:
        first, second, third = plan(asked)
        yield from (first, replace(second, compiles=("a.csv", "b.csv")), third)

    def waits(words: list[str], **more: Any) -> Any:
        assert words[-1].endswith("compile_ahead('a.csv', 'b.csv')")
        made.append(popen([sys.executable, "-c", "import time; time.sleep(60)"], **more))
        return made[-1]

    monkeypatch.setattr(_compile_ahead, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(_project_run, "core_count", lambda: cores)
    monkeypatch.setattr(_project_run.subprocess, "Popen", waits)
    monkeypatch.setattr(_start, "steps", changed)
    if before:
        monkeypatch.setattr(_compile_ahead, "compiled_before", lambda: short)
    assert states(call) == [False] * 3
    assert len(made) == begun
    assert all(one.returncode for one in made), "it was ended"


@pytest.mark.parametrize("enough", [True, False])
@pytest.mark.parametrize("nonlinear", [True, False])
def test_what_is_compiled_ahead_is_over_the_draws_and_then_over_the_best_model_if_loops_are(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nonlinear: bool, enough: bool
) -> None:
    """The observer is over a model of few rows, before the family is there; where they tell too little it has none."""
    tuning = SimpleNamespace(LEVELS=("linear", "margins"))
    ran: list[tuple[Any, ...]] = []
    tuning.task_of = lambda plants, *_: plants
    tuning.judge_candidate = lambda task, kind, _, level: ran.append((*task[1:], kind, level, Path(_plan.PI).exists()))
    asked: list[float] = []

    def comes(_: float) -> None:
        asked.append(1.0)
        Path(_plan.PI).parent.mkdir(exist_ok=True)
        Path(_plan.PI if Path(_plan.FAMILY).exists() else _plan.FAMILY).touch()

    def fit(rows: str) -> str:
        assert rows == "log.csv to 2000"
        if not enough:
            raise DataError("record longer.")
        return "rls"

    call("robot", "new", "robot.toml", "--preset", "neck")
    Path("models").mkdir()
    Path("models", f"auto_{'linear' if nonlinear else 'nonlinear'}.npz").touch()  # the best of the other sort
    monkeypatch.setattr(softneck, "tuning", tuning)
    monkeypatch.setattr(softneck, "estimation", _Estimation(ran))
    monkeypatch.setattr(softneck.identification, "Rls", lambda: SimpleNamespace(fit=fit))
    monkeypatch.setattr(_compile_ahead.time, "sleep", comes)
    monkeypatch.setattr(_compile_ahead, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(softneck.signals, "read_recording", _Rows)
    monkeypatch.setattr(_compile_ahead, "load", lambda name: _Family() if name == _plan.FAMILY else _Model(name, ran))
    monkeypatch.setattr(_compile_ahead.gc, "set_threshold", lambda *_: None)
    _compile_ahead.compile_ahead("log.csv")
    # The search needs the loops of margins last, so these are compiled first: then the two cores do different ones.
    auto = _Model("models/auto.npz", ran)

    def judged(model: Any, late: bool) -> list[tuple[Any, ...]]:
        return [(model, kind, level, late) for kind in ("pi", "hinf") for level in ("margins", "linear")]

    # Last what the report predicts with: the best model and the best linear one.
    report = [("log.csv", "models/auto.npz"), *([("log.csv", "models/auto_linear.npz")] if nonlinear else [])]
    observed = [("observer over rls", ["log.csv to 2000"], set())] if enough else []
    assert ran == [*observed, *judged("drawn", False), *(judged(auto, True) if nonlinear else []), *report]
    assert len(asked) == 2, "it waits for the family, then for the controller"
    assert _compile_ahead.compiled_before().is_file()


def test_the_observer_of_few_rows_is_fitted_with_our_own_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors in the process that compiles ahead are seen by nobody: here they would be."""
    fitted: list[Any] = []
    fit = softneck.estimation.fit_observer
    monkeypatch.setattr(softneck.estimation, "fit_observer", lambda *asked: fitted.append(fit(*asked)))
    monkeypatch.setattr(_compile_ahead.gc, "set_threshold", lambda *_: None)
    monkeypatch.setattr(_compile_ahead.os, "getppid", iter(range(9)).__next__)  # the run ends at once
    path = tmp_path / "log.csv"
    softneck.signals.write_recording(path, neck_recording(2500))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        _compile_ahead.compile_ahead(str(path))
    assert len(fitted) == 1


class _Rows(str):
    """A recording by its name."""

    __slots__ = ()

    def rows(self, start: int, stop: int) -> str:
        assert start == 0
        return f"{self} to {stop}"


@dataclass(frozen=True)
class _Family:
    draws: Any = field(default_factory=lambda: SimpleNamespace(model="drawn"))


@dataclass(frozen=True)
class _Estimation:
    ran: list[tuple[Any, ...]]

    def KalmanSettings(self) -> Any:
        return SimpleNamespace(design=lambda model: f"observer over {model}")

    def fit_observer(self, *asked: Any) -> None:
        self.ran.append(asked)


@dataclass(frozen=True)
class _Model:
    name: str
    ran: list[tuple[Any, ...]] = field(compare=False, repr=False)

    def predict(self, rows: str, horizon: int) -> None:
        assert horizon > 1, "one sample ahead has a function of its own"
        self.ran.append((rows, self.name))


def test_what_is_compiled_ahead_ends_with_the_run_that_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    parents = iter([7, 7, 1])
    monkeypatch.setattr(_compile_ahead.os, "getppid", lambda: next(parents))
    monkeypatch.setattr(_compile_ahead.time, "sleep", lambda _: None)
    with pytest.raises(SystemExit):
        _compile_ahead._await("never.npz")


@pytest.fixture
def heard() -> Iterator[None]:
    """Ctrl-C arrives, whatever runs the tests: what a shell puts into the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("how", ["before", "after", "swallowed"])
def test_ctrl_c_at_any_step_ends_in_one_line_and_the_same_command_goes_on(
    call: Call, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, how: str
) -> None:
    assert call("start", "log.csv", "-o", "whole/p", "--yes").code == 0
    real: Callable[..., Any] = _project_run._softneck
    calls: list[int] = []

    def pressed(words: tuple[str, ...], *, as_json: bool) -> None:
        calls.append(1)
        if len(calls) <= number:
            real(words, as_json=as_json)
            return
        if how == "after":
            real(words, as_json=as_json)
        if how != "swallowed":
            raise KeyboardInterrupt
        try:  # as trainings do, which keep the best so far
            os.kill(os.getpid(), signal.SIGINT)
            signal.pause()
        except KeyboardInterrupt:
            real(words, as_json=as_json)

    monkeypatch.setattr(_project_run, "_softneck", pressed)
    said = call("start", "log.csv", "-o", "p", "--yes")
    assert (said.code, len(calls)) == (130, number + 1)
    assert said.error == "softneck: interrupted; files already finished are kept, none is half written"
    monkeypatch.setattr(_project_run, "_softneck", real)
    assert states(call) == [k < number for k in range(3)], "the step that was interrupted is done again"
    assert contents(tmp_path / "p") == contents(tmp_path / "whole" / "p")


def test_ctrl_c_means_what_it_meant_before_a_project_run(call: Call, short: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    states(call)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("unmet", [_project_run.Unmet.FINDING, _project_run.Unmet.NO_MODEL])
def test_a_check_that_does_not_hold_is_a_result_but_of_models(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch, unmet: _project_run.Unmet
) -> None:
    from softneck.cli.start import _start

    real: Callable[..., Any] = _project_run._softneck
    plan = _start.steps

    def fails(words: tuple[str, ...], *, as_json: bool) -> None:
        real(words, as_json=as_json)
        if "copy.toml" in words:
            raise CheckFailedError("too slow.")

    def judged(asked: Any) -> Any:
        for step in plan(asked):
            yield _project_run.Step(**{**{name: getattr(step, name) for name in step.__slots__}, "unmet": unmet})

    monkeypatch.setattr(_project_run, "_softneck", fails)
    monkeypatch.setattr(_start, "steps", judged)
    for _ in range(2):  # what was found stays found
        said = call("start", "log.csv", "-o", "p", "--yes")
        assert said.code == 1
        assert "too slow." in said.err.splitlines()[-1]
        assert Path("p/project/loop.toml").exists() == (unmet is _project_run.Unmet.FINDING)


def test_json_is_one_object_on_stdout(call: Call, short: Path) -> None:
    said = call("start", "log.csv", "-o", "p", "--yes", "--json")
    assert isinstance(json.loads(said.out), dict)
    assert [line for line in said.err.splitlines() if line.startswith("$ ")] == [
        f"$ {step['command']}" for step in json.loads(said.out)["steps"]
    ]


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("folder", None, "is a folder; name a file in it"),
        ("absent.csv", b"", "no such file"),
        ("empty.csv", b"", "empty"),
        ("picture.png", b"\x89PNG\r\n\x1a\n" + bytes(200), "picture"),
        ("picture.csv", b"\x89PNG\r\n\x1a\n" + bytes(200), "picture"),
        ("words.csv", b"nothing\nof\nthis\nis a log\n", ""),
    ],
    ids=["folder", "absent", "empty", "picture", "named_csv", "words"],
)
def test_what_is_no_log_ends_in_one_line_and_leaves_nothing(
    call: Call, tmp_path: Path, name: str, data: bytes | None, says: str
) -> None:
    if data is None:
        (tmp_path / name).mkdir()
    elif name != "absent.csv":
        (tmp_path / name).write_bytes(data)
    before = {path.name for path in tmp_path.iterdir()}
    said = call("start", name, "-o", "new/p", "--yes")
    assert said.code == 2
    last = said.err.splitlines()[-1]
    assert name in last
    assert says in last
    assert not any(line.startswith("Traceback") for line in said.err.splitlines())
    assert {path.name for path in tmp_path.iterdir()} == before, "the folders that were made for it are gone"


def test_a_folder_of_something_else_is_left_alone(call: Call, short: Path, tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "mine.txt").write_text("mine")
    said = call("start", "log.csv", "-o", "p", "--yes")
    assert (said.code, said.error.endswith("holds no `start.json`; choose another folder.")) == (2, True)
    assert contents(tmp_path / "p") == {"mine.txt": b"mine"}
    assert "is a file" in call("start", "log.csv", "-o", "log.csv", "--yes").error


def test_logs_of_one_name_are_refused(call: Call, short: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "log.csv").write_text("a\n")
    assert "another log is called `log` too" in call("start", "log.csv", "other/log.csv", "--yes").error


def test_a_damaged_state_is_said_and_nothing_is_done(call: Call, short: Path) -> None:
    states(call)
    for text in (
        "{",
        "[]",
        '{"format": 1, "asked": {}, "steps": {"a": {}}}',
        '{"format": 2, "asked": {}, "steps": {}}',
    ):
        Path("p/start.json").write_text(text)
        assert "remove it to repeat all steps" in call("start", "log.csv", "-o", "p", "--yes").error


@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EROFS])
@pytest.mark.parametrize("number", range(6))
def test_a_full_disk_or_a_read_only_one_ends_in_one_line_wherever_it_comes(
    call: Call, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: int, number: int
) -> None:
    """The disk takes no file after the n-th, whichever file that is: those of steps, or the run's own."""
    real = Path.replace
    written: list[Path] = []

    def replace(self: Path, target: Any) -> Path:
        if len(written) >= number:
            raise OSError(reason, os.strerror(reason))
        written.append(Path(target))
        return real(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replace)
        said = call("start", "log.csv", "-o", "p", "--yes")
    assert said.code == 2
    assert f"cannot be written: {os.strerror(reason)}" in said.err.splitlines()[-1]
    left = {path for path in (tmp_path / "p").rglob("*") if path.is_file()}
    assert left <= {path.absolute() for path in written} | {(tmp_path / "p" / path) for path in written}, "no half file"
    assert all(states(call)) is False
    assert call("start", "log.csv", "-o", "fresh/p", "--yes").code == 0
    assert contents(tmp_path / "p") == contents(tmp_path / "fresh" / "p")


def test_a_folder_that_cannot_be_made_is_one_line(call: Call, short: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def mkdir(self: Path, *_: Any, **__: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    monkeypatch.setattr(Path, "mkdir", mkdir)
    said = call("start", "log.csv", "-o", "p", "--yes")
    assert (said.code, said.error.endswith("cannot be written: Read-only file system. Choose another folder.")) == (
        2,
        True,
    )


def test_in_a_terminal_what_was_not_said_is_asked_once(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from softneck.cli.start import _start
    from softneck.robot import Robot

    asked: list[str] = []

    def prompt(text: str, **_: Any) -> str:
        asked.append(text)
        return "arm" if "Whose log" in text else ""

    monkeypatch.setattr(_start, "is_terminal", lambda: True)
    monkeypatch.setattr(_start.click, "prompt", prompt)
    assert call("start", "log.csv", "-o", "p").code == 0
    assert ["Whose log" in text for text in asked] == [True, False]
    assert Robot.read("p/robot.toml").hash == Robot.preset("arm").hash
    assert call("start", "log.csv", "-o", "p").code == 0
    assert len(asked) == 2, "the answers stand in the folder"
    for more in (("--yes",), ("--json",)):
        assert call("start", "log.csv", "-o", f"q{more[0]}", *more).code == 0
    assert len(asked) == 2


def test_a_recording_that_lacks_something_is_asked_about_before_it_is_identified(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from softneck.cli.start import _start

    plan = [_project_run.Step(stage="identification", command=("softneck", "new", "q"), makes=("q/loop.toml",))]
    monkeypatch.setattr(_start, "steps", lambda _: iter(plan))
    monkeypatch.setattr(_start, "is_terminal", lambda: True)
    monkeypatch.setattr(_start.click, "prompt", lambda *_, default, **__: default)
    monkeypatch.setattr(_start.click, "confirm", lambda *_, **__: False)
    monkeypatch.setattr(_start, "_lacks", lambda _: ["log: a motor never moves."])
    (tmp_path / "log.csv").write_text("a\n")
    said = call("start", "log.csv", "-o", "p")
    assert said.code == 1
    assert "log: a motor never moves." in said.err
    assert "stopped by the user. Record 60 s" in said.err.splitlines()[-1]
    assert not Path("p").exists()


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (("--kinds", "pi,mcp"), "mpc"),
        (("--requirements", "absent.toml"), "absent.toml: no such file"),
        (("--robot", "nek"), "nek"),
        (("--budget", "0"), "--budget"),
    ],
)
def test_what_a_later_step_would_refuse_is_refused_at_once(
    call: Call, short: Path, more: tuple[str, ...], says: str
) -> None:
    said = call("start", "log.csv", "-o", "p", "--yes", *more)
    assert (said.code, says in said.error) == (2, True), said.err
    assert not Path("p").exists()


@pytest.mark.parametrize(("stage", "advice"), [("tune", "pass them by --requirements"), ("verify", "paths are")])
def test_a_step_that_cannot_be_done_says_which_and_how_to_go_on(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch, stage: str, advice: str
) -> None:
    from softneck.cli.start import _start
    from softneck.core import SettingsError

    def refuses(words: tuple[str, ...], *, as_json: bool) -> None:
        raise SettingsError(f"`{words[1]}` cannot be (as JSON: {as_json}); allow it.")

    plan = [_project_run.Step(stage=stage, command=("softneck", "new", "q"), makes=("q/loop.toml",))]
    monkeypatch.setattr(_start, "steps", lambda _: iter(plan))
    monkeypatch.setattr(_project_run, "_softneck", refuses)
    said = call("start", "log.csv", "-o", "p", "--yes")
    assert said.code == 2
    assert said.err.splitlines()[-1].startswith(f"softneck: {stage}: `new` cannot be")
    assert advice in said.err
    assert "fix this and run the same command again" in said.err


def neck_log(folder: Path) -> None:
    neck = neck_recording(700)
    angles = dict(zip(("pitch", "roll"), neck.outputs.T, strict=True))
    motors = {f"target_motor{j}": neck.set_points[:, j - 1] for j in (1, 2, 3)}
    pd.DataFrame({"time": neck.time, **motors, **angles}).to_csv(folder / "log.csv", index=False)


@pytest.mark.usefixtures("heard")
@pytest.mark.slow
def test_ctrl_c_of_a_user_in_steps_at_work(tmp_path: Path) -> None:
    """In the import, the quality and the identification: each time the same command continues."""
    neck_log(tmp_path)
    words = ["start", "log.csv", "-o", "p", "--yes"]
    script = f"import sys; from softneck.cli._main import run; sys.exit(run({words}))"
    for number, begun in enumerate(("[1/12] import", "[3/12] quality", "[4/12] identification")):
        with subprocess.Popen([sys.executable, "-u", "-c", script], cwd=tmp_path, text=True,
                              stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:  # fmt: skip
            assert process.stdout is not None
            assert process.stderr is not None
            seen = []
            for line in process.stdout:
                seen.append(line.strip())
                if line.startswith(begun):
                    process.send_signal(signal.SIGINT)
                    break
            _, err = process.communicate(timeout=300)
        assert process.returncode == 130, err
        assert err.splitlines()[-1] == "softneck: interrupted; files already finished are kept, none is half written"
        assert sum("(done before)" in line for line in seen) == (0, 0, 2)[number]
        assert not list(tmp_path.rglob("*.tmp*")), "nothing half written"
        if number:
            assert json.loads((tmp_path / "p" / "start.json").read_text())["steps"]


def test_a_disk_that_is_really_full_ends_in_one_line(tmp_path: Path) -> None:
    """Files may grow to 8 KiB only, as on a small disk: the first that does not fit ends the run; none is half."""
    neck_log(tmp_path)
    limited = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192)); "
    words = ["start", "log.csv", "-o", "p", "--yes"]
    done = subprocess.run(
        [sys.executable, "-c", f"{limited}from softneck.cli._main import run; sys.exit(run({words}))"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("softneck: import: ")
    assert f"cannot be written: {os.strerror(errno.EFBIG)}" in last
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]


@pytest.mark.parametrize("stage", ["identification", "verify"])
def test_a_long_refusal_is_noted_whole_and_ends_in_a_short_line(
    call: Call, short: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    from softneck.cli.start import _start

    whole = f"models/a b.npz: no kind could be identified{', for one reason or another' * 8}. Look at 0.5 % of it."

    def refuses(*_: Any, **__: Any) -> None:
        raise DataError(whole)

    monkeypatch.setattr(_start, "steps", lambda _: iter([_project_run.Step(stage=stage, command=("a",), makes=("b",))]))
    monkeypatch.setattr(_project_run, "_softneck", refuses)
    said = call("start", "log.csv", "-o", "p", "--yes")
    *before, last = said.err.splitlines()
    assert len(last) <= 160
    assert " ... " in f"{last} "
    noted = " ".join(" ".join(before).split())
    if stage == "identification":
        assert last.startswith("softneck: identification: no kind could be identified, for one reason")
        assert last.endswith(" ... Record 60 s of `mixed` and start with that.")
        assert whole.partition(": ")[2].partition(". ")[0] in noted
    else:
        assert whole in noted


@pytest.mark.parametrize(
    ("robot", "middles", "told"),
    [("neck", [(-0.01, 0.02)], "by 0.005 rad"), ("neck", [(-0.01, 0.02), (0.9, 1.1)], "by 1 rad"),
     ("neck", [(1.4, 1.6), (0.0, 0.0)], ""), ("neck", [], ""), ("arm", [(0.0, 0.0)], "by 0 rad"),
     ("finger", [(0.0, 0.0)], "")],
)  # fmt: skip
def test_tendons_that_no_recording_pulls_far_enough_together_are_told(
    robot: str, middles: list, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    family = SimpleNamespace(
        robot=Robot.preset(robot), findings={"tested": {"conditions": [{"cocontraction": pair} for pair in middles]}}
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_start, "load", lambda _path, role: {"family": family}[role])
    _start._advise_tautness()  # there is no family
    assert not capsys.readouterr().err
    Path("models").mkdir()
    Path(_start.FAMILY).touch()
    _start._advise_tautness()
    said = capsys.readouterr().err
    assert bool(said) == bool(told)
    assert told in said
    assert not said or "mixed --cocontraction" in " ".join(said.split())


def test_a_run_that_was_killed_at_its_first_file_begins_again(tmp_path: Path) -> None:
    (tmp_path / ".start-softneck-00000000.json").touch()
    with _start._project(tmp_path):
        assert list(Path().iterdir()) == []
    (tmp_path / "theirs.txt").touch()
    with pytest.raises(OutputFileError, match="is not empty"), _start._project(tmp_path):
        pass
