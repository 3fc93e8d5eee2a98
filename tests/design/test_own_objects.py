"""A plain Python object with `step` as a controller: in a loop, in `verify` and as an FMU, and what is refused."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import control
import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

import softneck
from softneck.core import SettingsError
from softneck.fmu import build_compiled_fmu

TEXT = """
import math

import numpy as np


class Tilt:
    def __init__(self, integral, weights=(1.0, -0.5, -0.5), name="tilt"):
        self.integral, self.weights, self.name = integral, np.array(weights), name
        self.table, self.limit = {"a": [1, True, None]}, math.inf

    def initial_state(self):
        return [0.0, 0.0]

    def step(self, state, inputs):
        errors = [inputs[f"{axis}_reference"] - inputs[axis] for axis in ("pitch", "roll")]
        state = [x + 0.02 * error for x, error in zip(state, errors)]
        turn = self.integral * state[1]
        return state, self.integral * state[0] * self.weights + np.array([0.0, turn, -turn])


def made():
    return Tilt(4.0)


class Linear(Tilt):
    def ss(self):
        import control

        g = self.integral * 0.02
        names = ["pitch_reference", "roll_reference", "pitch", "roll"]
        return control.StateSpace(np.eye(2), np.hstack([np.eye(2), -np.eye(2)]), g * np.diag([1.5, 1.732]),
                                  np.hstack([g * np.diag([1.5, 1.732]), -g * np.diag([1.5, 1.732])]), 0.02,
                                  inputs=names, outputs=["theta_i", "phi_i"])
"""
PLANT = """
class Finger:
    role, sample_time = "plant", 0.01
    inputs, outputs = {"chamber_setpoint": "Pa"}, {"flexion": "rad"}

    def __init__(self, gain, rest=0.2):
        self.gain, self.rest = gain, rest

    def initial_state(self):
        return [self.rest]

    def initial_outputs(self):
        return [self.rest]

    def step(self, state, inputs):
        y = 0.9 * state[0] + 0.1 * (self.rest + self.gain * inputs["chamber_setpoint"])
        return [y], [y]


class Neck(Finger):
    sample_time = 0.02
    inputs = {f"motor_setpoint_{j}": "rad" for j in (1, 2, 3)}
    outputs = dict.fromkeys(["pitch", "roll", *(f"motor_position_{j}" for j in (1, 2, 3))], "rad")

    def initial_outputs(self):
        return [self.rest, 0.0, 0.0, 0.0, 0.0]

    def step(self, state, inputs):
        y = 0.9 * state[0] + 0.1 * (self.rest + self.gain * inputs["motor_setpoint_1"])
        return [y], [y, 0.0, *inputs.values()]


class Smooth:
    role, sample_time = "observer", 0.01
    inputs = {"chamber_setpoint": "Pa", "flexion_measured": "rad"}
    outputs = {"flexion": "rad", "innovation": "rad"}

    def __init__(self, share):
        self.share = share

    def initial_state(self):
        return [0.0]

    def step(self, state, inputs):
        innovation = inputs["flexion_measured"] - state[0]
        return [state[0] + self.share * innovation], [state[0] + self.share * innovation, innovation]
"""
LOOP: dict[str, Any] = {
    "duration_s": 2.0, "plant": "paper", "reference": {"kind": "step", "pitch_deg": 10.0, "at_s": 0.5},
}  # fmt: skip
QUICK = {"sampling": {"plants": 10, "search_generations": 0}, "sim": {"necks": 1, "payloads_kg": [0.0]}}


@pytest.fixture
def tilt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    (tmp_path / "own_tilt.py").write_text(TEXT, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "own_tilt", raising=False)
    import own_tilt  # pyright: ignore[reportMissingImports]

    return own_tilt


@pytest.fixture
def own_plants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    (tmp_path / "own_plants.py").write_text(PLANT, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_plants", raising=False)
    import own_plants  # pyright: ignore[reportMissingImports]

    return own_plants


def test_a_file_names_the_object_of_a_loop(tilt: ModuleType) -> None:
    ours = softneck.simulate({**LOOP, "controller": tilt.Tilt(4.0)})
    assert float(ours["pitch"][-1]) > 0.01  # it moves
    file = softneck.simulate({**LOOP, "controller": {"python": "own_tilt:made"}})
    np.testing.assert_array_equal(file["pitch"], ours["pitch"])


def test_the_fmu_computes_what_the_loop_does(tilt: ModuleType) -> None:
    controller = tilt.Tilt(np.float64(4.0), weights=[1.0, -0.25, -0.75])
    ours = softneck.simulate({**LOOP, "controller": controller})
    softneck.build_fmu(controller, "Tilt.fmu")
    theirs = softneck.simulate({**LOOP, "controller": {"fmu": "Tilt.fmu"}})
    for name in ("pitch", "motor_setpoint_1", "motor_setpoint_3"):
        np.testing.assert_array_equal(ours[name], theirs[name])


@pytest.mark.parametrize("name", ["Tilt", "Linear"])
def test_verify_judges_it(tilt: ModuleType, name: str) -> None:
    model = softneck.identify("rls", softneck.record("eq22", "paper", seed=1))
    found = softneck.verify(getattr(tilt, name)(4.0), model, {"overshoot_pct": 80.0, **QUICK})
    values = {verdict.requirement.metric: verdict.value for verdict in found.verdicts}
    assert values["step.overshoot_pct"] is not None
    # Margins are of the linear form, which only `ss` tells.
    assert (values["axes.gain_margin"] is None) == (name == "Tilt")


def test_a_study_varies_objects_and_knows_them_by_their_attributes(tilt: ModuleType, tmp_path: Path) -> None:
    vary = {"controller": {"choices": [tilt.Tilt(2.0), tilt.Tilt(6.0)]}, "reference.pitch_deg": [5.0, 10.0]}
    runs = softneck.study(LOOP | {"controller": tilt.Tilt(1.0)}, vary=vary, runs=4, workers=0, output=tmp_path / "a")
    assert not any(runs["error"])
    again = softneck.study(LOOP | {"controller": tilt.Tilt(1.0)}, vary=vary, runs=4, workers=0, output=tmp_path / "a")
    assert again["seconds"].tolist() == runs["seconds"].tolist()  # nothing was run again
    vary["controller"] = {"choices": [tilt.Tilt(2.0), tilt.Tilt(7.0)]}
    with pytest.raises(SettingsError, match="another study"):
        softneck.study(LOOP | {"controller": tilt.Tilt(1.0)}, vary=vary, runs=4, workers=0, output=tmp_path / "a")


def test_what_does_not_fit_is_said(tilt: ModuleType, tmp_path: Path) -> None:
    class Short(tilt.Tilt):
        def step(self, state: Any, inputs: Any) -> Any:  # noqa: ARG002
            return state, [0.0]

    class Wrong(tilt.Tilt):
        def step(self, state: Any, inputs: Any) -> Any:
            return state, inputs["yaw"]

    with pytest.raises(SettingsError, match=r"Short: `step` must return \(2 state, 3 set-points\)"):
        softneck.simulate({**LOOP, "controller": Short(1.0)})
    with pytest.raises(SettingsError, match="Wrong: its first step fails with KeyError: 'yaw'"):
        softneck.simulate({**LOOP, "controller": Wrong(1.0)})
    with pytest.raises(SettingsError, match="a Python object cannot be in a compiled FMU; use `--backend python`"):
        build_compiled_fmu(tilt.Tilt(1.0), tmp_path / "Compiled.fmu")
    holding = tilt.Tilt(1.0)
    holding.system = control.tf([1], [1, 1])
    with pytest.raises(SettingsError, match="`system` is a TransferFunction"):
        softneck.build_fmu(holding, tmp_path / "Holding.fmu")
    (tmp_path / "own_tilt.py").write_text("import control\n" + TEXT, encoding="utf-8")
    with pytest.raises(SettingsError, match="its file imports `control`"):
        softneck.build_fmu(tilt.Tilt(1.0), tmp_path / "Control.fmu")


def test_a_plant_of_ones_own_is_an_fmu_with_its_ports(tmp_path: Path, own_plants: ModuleType) -> None:
    path = softneck.build_fmu(own_plants.Finger(2e-5), tmp_path / "Finger.fmu")
    assert validate_fmu(str(path)) == []
    model = fmpy.read_model_description(str(path))
    named = {v.name: (v.causality, v.unit) for v in model.modelVariables}
    assert named == {"chamber_setpoint": ("input", "Pa"), "flexion": ("output", "rad")}
    signals = np.array([(0.0, 5e4), (1.0, 5e4)], dtype=[("time", float), ("chamber_setpoint", float)])
    result: Any = fmpy.simulate_fmu(str(path), input=signals, stop_time=0.2, output_interval=0.01)
    # First order: y(k) = rest + gain u (1 - 0.9^k), at the sample itself; rounding of twenty steps.
    expected = 0.2 + 1.0 * (1.0 - 0.9 ** np.arange(21))
    np.testing.assert_allclose(result["flexion"], expected, rtol=1e-13)


def test_a_loop_takes_a_plant_of_ones_own_and_its_fmu(tmp_path: Path, tilt: ModuleType, own_plants: ModuleType) -> None:
    plant, loop = own_plants.Neck(0.05, rest=0.01), {**LOOP, "controller": tilt.Tilt(1.0)}
    ours = softneck.simulate({**loop, "plant": plant})
    softneck.build_fmu(plant, tmp_path / "Own.fmu")
    theirs = softneck.simulate({**loop, "plant": {"fmu": str(tmp_path / "Own.fmu")}})
    assert ours["pitch"][0] == 0.01
    assert np.ptp(ours["pitch"]) > 0.01
    np.testing.assert_array_equal(ours["pitch"], theirs["pitch"])


def test_an_observer_of_ones_own_is_an_fmu_with_its_ports(tmp_path: Path, own_plants: ModuleType) -> None:
    path = softneck.build_fmu(own_plants.Smooth(0.25), tmp_path / "Smooth.fmu")
    assert validate_fmu(str(path)) == []
    named = {v.name: (v.causality, v.unit) for v in fmpy.read_model_description(str(path)).modelVariables}
    assert named == {
        "chamber_setpoint": ("input", "Pa"), "flexion_measured": ("input", "rad"), "flexion": ("output", "rad"),
        "innovation": ("output", "rad"),
    }  # fmt: skip
    signals = np.array([(0.0, 0.4), (1.0, 0.4)], dtype=[("time", float), ("flexion_measured", float)])
    result: Any = fmpy.simulate_fmu(str(path), input=signals, stop_time=0.2, output_interval=0.01)
    # It answers at once: the estimate of sample k, seen at the end of its step, is 0.4 (1 - 0.75^(k+1)).
    left = 0.4 * 0.75 ** np.arange(20)
    np.testing.assert_allclose(result["innovation"][1:], left, rtol=1e-13)
    np.testing.assert_allclose(result["flexion"][1:], 0.4 - 0.75 * left, rtol=1e-13)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"role": "motor"}, "`role` is 'motor'; use one of controller, plant, observer"),
        ({"inputs": ["chamber_setpoint"]}, "a plant needs `inputs`, a dictionary of names and SI units"),
        ({"outputs": {"flexion": "deg"}}, "a plant needs `outputs`, a dictionary of names and SI units"),
        ({"outputs": {"flexion": "rad", "tip": "m"}}, r"must return \(1 state, 2 outputs\)"),
        ({"initial_outputs": list}, "`initial_outputs` must return 1 numbers"),
    ],
)
def test_a_wrong_declaration_is_said(
    change: dict[str, Any], words: str, tmp_path: Path, own_plants: ModuleType
) -> None:
    plant = type("Wrong", (own_plants.Finger,), change)(1.0)
    with pytest.raises(SettingsError, match=words):
        softneck.build_fmu(plant, tmp_path / "Wrong.fmu")
