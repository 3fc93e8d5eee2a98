"""softneck identify auto: table, JSON, page, the model it saves, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import softneck
from softneck.cli._auto import _refuse_useless
from softneck.core import CheckFailedError, SettingsError, load, read_archive
from softneck.identification._identify import _split_for_choice
from softneck.identification.selection import _auto
from softneck.signals import write_recording

from ..data import neck_recording, recording_from
from ..report.test_decisions import figures, is_value, opening, values_of
from .conftest import Call


@pytest.fixture(autouse=True)
def few_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two kinds are enough to rank, and quick."""
    monkeypatch.setattr(_auto, "_SIMPLE_FIRST", ("rls", "play"))


def test_auto_ranks_explains_and_saves(call: Call, recording: Path) -> None:
    said = call("identify", "auto", recording, "-o", "best.npz", "--html", "why.html")
    assert said.code == 0, said.err
    page = opening(Path("why.html").read_text())
    assert page.startswith(f"Use best.npz ({load('best.npz').kind}): on rows it has not seen it simulates pitch ")
    assert "chosen" in said.out
    assert "Simulation fit" in said.out
    assert "+-" in said.out
    assert "last one is held out" in " ".join(said.err.split())
    assert load("best.npz").kind in ("rls", "play")
    assert call("identify", "auto", recording, "-o", "best.npz").code == 2


def test_rows_held_out_that_stand_still_are_refused_before_anything_is_trained(call: Call) -> None:
    P = np.zeros((800, 3))
    P[50:] = [3.0, -1.0, 0.5]
    write_recording("step.csv", recording_from(P, noise=0.0))
    said = call("identify", "auto", "step.csv", "-o", "n.npz")
    assert said.code == 2
    assert "step.csv: the rows held out stand still: pitch moves by 0.0 % of what it does in all rows" in said.error
    assert not Path("n.npz").exists()


@pytest.mark.parametrize(
    ("payloads", "whole"), [((0.0, 1.0), False), ((0.0, 1.0, 0.5), True), ((1.0, 0.0), False), ((0.0, 0.0), True)]
)
def test_no_payload_is_held_out_whole(payloads: tuple[float, ...], whole: bool) -> None:
    """What nobody else carries is trained on as well, or the model would not know it."""
    one = neck_recording(300, seed=3)
    parts = [replace(one, channels={**one.channels, "payload": np.full(300, kg)}) for kg in payloads]
    head, tail, other = _split_for_choice(parts, 0.7)
    assert other == whole
    trained = set(np.unique(head.channels["payload"]))
    assert min(trained) == min(payloads)
    assert max(trained) == max(payloads)
    if whole:
        np.testing.assert_array_equal(tail.outputs, parts[-1].outputs)
    else:
        assert head.time.size + tail.time.size == 300 * len(payloads)


@pytest.mark.slow
def test_auto_saves_the_best_of_the_other_sort_beside_its_choice(
    call: Call, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_auto, "ALIKE", 1e-9)  # the better one is taken, however little better
    monkeypatch.setattr(_auto.KindTrial, "fit", property(lambda one: {"play": 90.0, "rls": 80.0}[one.kind]))
    said = call("identify", "auto", recording, "-o", "best.npz", "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert (facts["chosen"], facts["linear_model"]) == ("play", "best_linear.npz")
    assert facts["nonlinear_model"] is None
    assert load("best_linear.npz").kind == "rls"
    assert call("design", "pi", "best.npz", "-o", "a.npz").code == 2
    assert call("design", "pi", "best_linear.npz", "-o", "pi.npz").code == 0
    assert call("observer", "best_linear.npz", "-o", "obs.npz").code == 0
    # Nothing is replaced without --force; with it what another choice left beside it goes.
    Path("best.npz").unlink()
    assert "best_linear.npz: exists already" in call("identify", "auto", recording, "-o", "best.npz").error
    monkeypatch.setattr(_auto.KindTrial, "fit", property(lambda one: {"play": 80.0, "rls": 90.0}[one.kind]))
    said = call("identify", "auto", recording, "-o", "best.npz", "--json", "--force")
    facts = json.loads(said.out)
    assert (facts["chosen"], facts["nonlinear_model"], facts["linear_model"]) == ("rls", "best_nonlinear.npz", None)
    assert load("best_nonlinear.npz").kind == "play"
    assert load("best_nonlinear.npz").findings["hold_out"]["rows"] > 0, "it was judged as the chosen one was"
    assert not Path("best_linear.npz").exists()


@pytest.mark.slow
def test_auto_ends_with_exit_code_1_where_no_kind_makes_a_model(
    call: Call, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "softneck.cli._auto.useless", lambda judged: f"its simulation diverges at {judged.time[0]:.0f} s"
    )
    for more in ((), ("--json",)):
        said = call("identify", "auto", recording, "-o", f"best{len(more)}.npz", *more)
        assert said.code == 1
        assert "no kind is a model of the rows held out: its simulation diverges" in said.err.splitlines()[-1]
    assert json.loads(said.out)["model"] == "best1.npz"


def test_that_no_kind_is_a_model_is_said_only_where_none_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.cli._auto.useless", lambda judged: None if judged == "good" else "its fit is -3 %")
    monkeypatch.setattr("softneck.cli._auto.left_out", lambda _: "")

    def trial(kind: str, judged: str | None, fits: tuple[float, float]) -> Any:
        return SimpleNamespace(kind=kind, judged=judged, hold_out_fit=fits[0], fit=min(fits), worst="largest motions")

    ranking = [trial("oe", "bad", (-3.0, 9.0)), trial("nn", None, (0.0, 0.0)), trial("rls", "good", (81.0, -20.0))]
    choice: Any = SimpleNamespace(chosen=ranking[0], ranking=ranking)
    with pytest.raises(CheckFailedError, match="oe, the best by its worst test, is no model of the rows") as said:
        _refuse_useless(Path("m.npz"), choice)
    assert "rls fits them 81.0 %, but -20.0 % on largest motions." in str(said.value)
    alone: Any = SimpleNamespace(chosen=ranking[0], ranking=ranking[:2])
    with pytest.raises(CheckFailedError, match="no kind is a model of the rows held out: its fit"):
        _refuse_useless(Path("m.npz"), alone)
    _refuse_useless(Path("m.npz"), SimpleNamespace(chosen=ranking[2], ranking=ranking))  # type: ignore[arg-type]


def test_auto_prints_one_json_object_and_holds_out_the_last_of_several(call: Call, recording: Path) -> None:
    write_recording(Path("other.csv"), neck_recording(300, seed=44))
    said = call("identify", "auto", recording, "other.csv", "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert facts["model"] == "build/models/auto.npz"
    assert facts["decision"].startswith(f"Use build/models/auto.npz ({facts['chosen']}): ")
    assert [figure for figure in figures(facts["decision"]) if not is_value(figure, [*values_of(facts)])] == []
    assert facts["remarks"] == []
    assert facts["chosen"] in [entry["kind"] for entry in facts["ranking"]]
    chosen = next(entry for entry in facts["ranking"] if entry["kind"] == facts["chosen"])
    # The model is that of all recordings: the last 30 % of both are held out, less 25 rows each that align.
    assert chosen["hold_out"]["rows_scored"] == round(0.3 * (600 + 300)) - 2 * 25
    model, again = load(Path("build/models/auto.npz")), softneck.identify(facts["chosen"], [recording, "other.csv"])
    assert {name: values.tobytes() for name, values in model.arrays.items()} == {
        name: values.tobytes() for name, values in again.arrays.items()
    }
    assert model.findings["examination"] == again.findings["examination"]
    assert chosen["fit"] == min(chosen["scores"].values())
    assert {"largest motions", "other excitation", "trained on the other", "hold-out", "cold start"} <= set(
        chosen["scores"]
    )
    assert not chosen["stopped_early"]


@pytest.mark.slow
def test_auto_in_python_makes_the_same_model(call: Call, recording: Path) -> None:
    write_recording(Path("other.csv"), neck_recording(300, seed=44))
    facts = json.loads(call("identify", "auto", recording, "other.csv", "-o", "cli.npz", "--json").out)
    model = softneck.identify("auto", [recording, "other.csv"])
    assert model.kind == facts["chosen"]
    assert model.findings["chosen"] == facts["why"]
    model.save("python.npz")
    (head, arrays), (head_too, arrays_too) = read_archive(Path("cli.npz")), read_archive(Path("python.npz"))
    assert head["findings"]["hold_out"] == head_too["findings"]["hold_out"]
    assert all(np.array_equal(arrays[name], arrays_too[name], equal_nan=True) for name in arrays)
    with pytest.raises(SettingsError, match="`auto` has no setting 'na'"):
        softneck.identify("auto", recording, na=1)


def test_auto_refuses_settings_and_nothing_held_out(call: Call, recording: Path) -> None:
    assert "`auto` takes no settings" in call("identify", "auto", recording, "--set", "na=1").error
    assert "has to hold rows out" in call("identify", "auto", recording, "--train", "1").error
    assert "--html goes with KIND auto" in call("identify", "rls", recording, "--html", "x.html").error


def test_three_rows_are_one_line(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_auto, "_SIMPLE_FIRST", ("rls", "nlsm"))
    Path("r.csv").write_text(
        "time [s],motor_setpoint_1 [rad],motor_setpoint_2 [rad],motor_setpoint_3 [rad],pitch [deg],roll [deg]\n"
        + "".join(f"{0.02 * k:g},{k},{-k},0,{k},{2 * k}\n" for k in range(3))
    )
    said = call("identify", "auto", "r.csv", "-o", "m.npz")
    assert said.code == 2
    assert "2 rows are too few to identify from; at least 100 are needed" in said.error
    for kind in ("rls", "nlsm"):
        assert "too few" in call("identify", kind, "r.csv", "-o", "m.npz").error
    assert not Path("m.npz").exists()
