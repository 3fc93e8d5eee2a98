"""What a model is worth is said: by the exit code where it is nothing, by `design` where it is too little."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import load
from softneck.identification import Model, Rls
from softneck.signals import read_recording, write_recording

from ..data import neck_recording
from .conftest import Call


def unstable(model: Model) -> Model:
    """The same model, whose outputs count 1.5 times: it runs away from any start."""
    arrays = {name: array.copy() for name, array in model.arrays.items()}
    arrays["a"] = 1.5 * arrays["a"]
    return replace(model, arrays=arrays)


def test_a_model_that_diverges_is_judged_and_gives_exit_code_1(
    call: Call, recording: Path, models: dict[str, Model]
) -> None:
    unstable(models["rls"]).save("away.npz")
    said = call("validate", "away.npz", "--data", recording, "--json")
    assert said.code == 1
    judged = json.loads(said.out)["models"][0]
    assert judged["diverged"] > 0.0
    assert judged["fits"]["model"]["25"]["pitch"] < -1000.0
    assert f"no model of this data: away.npz on {recording.name}: its simulation diverges at" in said.error
    # A table shows no digits of such a number.
    assert "<-1000" in call("validate", "away.npz", "--data", recording).out


def test_a_model_that_moves_the_wrong_way_gives_exit_code_1(call: Call, rls_file: Path) -> None:
    right = neck_recording(600)
    channels = {name: -right.channels[name] if name in ("pitch", "roll") else c for name, c in right.channels.items()}
    write_recording("mirrored.csv", replace(right, channels=channels))
    said = call("validate", rls_file, "--data", "mirrored.csv", "--horizon", "inf")
    assert said.code == 1
    assert "its fit in simulation is -1" in said.error


@pytest.mark.slow
def test_identify_of_outputs_that_follow_no_motor_gives_exit_code_1_and_what_to_do(call: Call) -> None:
    # Another neck's angles beside motors that move: the mean of the rows held out knows more than any model.
    moving, other = neck_recording(3000), neck_recording(3000, seed=5)
    angles = {name: np.roll(other.channels[name], 1300) for name in ("pitch", "roll")}
    write_recording("foreign.csv", replace(moving, channels={**moving.channels, **angles}))
    said = call("identify", "oe", "foreign.csv", "-o", "m.npz")
    assert said.code == 1
    assert "m.npz: no model of the rows held out: its fit in simulation is -" in said.error
    assert "does not follow the motors" in said.error
    assert call("identify", "oe", "foreign.csv", "-o", "m.npz", "--json", "--force").code == 1
    # One of the two alone: the robot may do without it.
    write_recording("drift.csv", replace(moving, channels={**moving.channels, "pitch": angles["pitch"]}))
    said = call("identify", "oe", "drift.csv", "-o", "d.npz")
    assert said.code == 1
    assert "Leave pitch out of `outputs.names` in a robot.toml: without it roll fits " in said.error


def test_identify_says_that_its_model_diverges_and_keeps_it(
    call: Call, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = Rls.fit
    monkeypatch.setattr(Rls, "fit", lambda *given, **more: unstable(fit(*given, **more)))
    said = call("identify", "rls", recording, "-o", "away.npz")
    assert said.code == 1
    assert "away.npz: no model of the rows held out: its simulation diverges at" in said.error
    assert load("away.npz").findings["hold_out"]["diverged"] > 0.0
    said = call("design", "pi", "away.npz", "-o", "pi.npz")
    assert (said.code, Path("pi.npz").exists()) == (2, False)
    assert "its simulation over the rows held out diverges" in said.error


def test_an_angle_that_stands_still_has_no_fit(call: Call, rls_file: Path) -> None:
    moving = neck_recording(600)
    still = np.full(600, np.radians(12.3))
    write_recording("still.csv", replace(moving, channels={**moving.channels, "roll": still}))
    assert np.ptp(read_recording("still.csv").outputs[:, 1]) == 0.0
    said = call("validate", rls_file, "--data", "still.csv", "--json")
    assert said.code == 0, said.err
    judged = json.loads(said.out)["models"][0]
    # The mean of 550 equal numbers is off by rounding, and a fit by it was -1e16 %.
    assert [judged["fits"]["model"][horizon]["roll"] for horizon in ("1", "25", "inf")] == [None] * 3
    assert judged["r2"]["inf"]["roll"] is None


@pytest.mark.parametrize(("fit", "code"), [(2.0, 2), (29.9, 2), (30.0, 0), (None, 0)])
def test_design_refuses_a_model_that_explains_less_than_half(
    call: Call, recording: Path, fit: float | None, code: int
) -> None:
    assert call("identify", "rls", recording, "-o", "m.npz").code == 0
    model = load("m.npz")
    known = model.findings["hold_out"]
    assert known["fit"]["pitch"] > 50.0
    worth = {**known, "fit": {**known["fit"], "roll": fit}}
    replace(model, findings={**model.findings, "hold_out": worth}).save("m.npz", force=True)
    said = call("design", "pi", "m.npz", "-o", "pi.npz")
    assert said.code == code, said.err
    if code == 2:
        assert f"m.npz: its simulation over the rows held out fits {fit} % in roll; 30 % is the least" in said.error
        assert "Leave roll out of `outputs.names` in a robot.toml." in said.error
        assert call("design", "pi", "m.npz", "-o", "pi.npz", "--any-fit").code == 0


def test_design_says_where_nothing_was_held_out(call: Call, recording: Path) -> None:
    assert call("identify", "rls", recording, "-o", "m.npz", "--train", "1").code == 0
    said = call("design", "pi", "m.npz", "-o", "pi.npz")
    assert said.code == 0
    assert "warning: m.npz: nothing was held out when it was identified: its fit is not known" in said.err


def test_warnings_of_libraries_do_not_leak(call: Call, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fit = Rls.fit

    def warning(*given: object, **more: object) -> Model:
        warnings.warn("inaccurate", UserWarning, stacklevel=1)
        return fit(*given, **more)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(Rls, "fit", warning)
    for asked in (False, True):
        with warnings.catch_warnings():
            warnings.simplefilter("always")  # as outside of pytest, where a warning is no error
            if asked:
                monkeypatch.setenv("SOFTNECK_TRACEBACK", "1")
                with pytest.warns(UserWarning, match="inaccurate"):
                    call("identify", "rls", recording, "-o", f"{asked}.npz")
            else:
                assert "inaccurate" not in call("identify", "rls", recording, "-o", f"{asked}.npz").err
