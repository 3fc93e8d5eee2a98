"""Linear systems near a moment: of ours exactly, of any tool's FMU from pulses on a saved state."""

from __future__ import annotations

import math
import os
import shutil
import zipfile
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import loadmat

from softneck.core import Matrix, OutputFileError, SettingsError, SoftneckError, Vector, load
from softneck.cosim.parts._linearize import SavedBlock, linearize, realize
from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.runtime import Block
from softneck.signals import redefinition_matrix

from ..data import ROOT
from ._foreign import build_foreign

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")
GOLDEN = ROOT / "tests" / "golden"
TS = 0.02
FREQUENCIES = np.array([0.1, 1.0, 5.0, 30.0])
needs_cc = pytest.mark.skipif(shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here")


def block_of(kind: str) -> Block:
    return load(GOLDEN / f"{kind}.npz").block()


def response(system: control.StateSpace) -> np.ndarray:
    return np.array([system(np.exp(1j * w * system.dt), squeeze=False) for w in FREQUENCIES])


@pytest.mark.parametrize("kind", ["rls", "nn", "play", "greybox"])
def test_it_is_what_the_model_says_of_itself(kind: str) -> None:
    block = block_of(kind)
    at = linearize(block, at=0.4, values={"motor_setpoint_1": 0.5, "motor_setpoint_2": -0.25})
    u = np.full(len(block.inputs), np.nan)
    u[:3] = 0.5, -0.25, 0.0
    state = block.run(block.initial_state(), np.tile(u, (20, 1)))[0]
    model = load(GOLDEN / f"{kind}.npz", role="model")
    J = model.jacobian(state, u[:3])
    assert at.method == "exact"
    n = len(J.A)
    A = np.block([[J.A, np.zeros((n, 5))], [J.C[:5], np.zeros((5, 5))]])
    B, C = np.vstack([J.B, J.D[:5]]), np.hstack([np.zeros((5, n)), np.eye(5)])
    whole = control.StateSpace(A, B, C, np.zeros((5, 3)), TS)
    # States that nothing reaches are gone; what is left is solved with condition numbers up to 1e4.
    np.testing.assert_allclose(response(at.ss()), response(whole), rtol=1e-9, atol=1e-12)
    assert at.outputs == ("pitch", "roll", "motor_position_1", "motor_position_2", "motor_position_3")


@needs_cc
@pytest.mark.parametrize("kind", ["rls", pytest.param("play", marks=pytest.mark.slow)])
def test_a_block_and_its_fmus_say_the_same(kind: str, tmp_path: Path) -> None:
    block = block_of(kind)
    build_fmu(block, tmp_path / "Python.fmu")
    build_compiled_fmu(block, tmp_path / "Compiled.fmu")
    build_compiled_fmu(block, tmp_path / "Ahead.fmu", fmi=3, sensitivities=True)
    one = linearize(block, at=1.0, values={"motor_setpoint_2": 0.7})
    other = linearize(tmp_path / "Python.fmu", at=1.0, values={"motor_setpoint_2": 0.7})
    assert other.method == "exact"
    assert (other.inputs, other.outputs) == (one.inputs, one.outputs)
    for a, b in zip((one.A, one.B, one.C, one.D), (other.A, other.B, other.C, other.D), strict=True):
        np.testing.assert_array_equal(a, b)
    for name in ("Compiled", "Ahead") if kind == "rls" else ():  # pulses meet both sides of a kink, as `play` has many
        other = linearize(tmp_path / f"{name}.fmu", at=1.0, values={"motor_setpoint_2": 0.7})
        assert other.method == "pulses"
        # As pulses on the block itself: see below.
        np.testing.assert_allclose(response(other.ss())[:, :5], response(one.ss()), rtol=0, atol=1e-7)


def test_a_small_step_answers_as_it_says() -> None:
    block = block_of("nn")
    held = {"motor_setpoint_1": 1.0}
    # At rest: elsewhere a linear system does not know where the motion goes by itself.
    system = linearize(block, at=40.0, values=held)
    u = np.full(len(block.inputs), np.nan)
    u[:3] = 1.0, 0.0, 0.0
    state = block.run(block.initial_state(), np.tile(u, (2000, 1)))[0]
    small, rows = 1e-5, np.tile(u, (100, 1))
    rows[:, 0] += small
    moved = block.run(state, rows)[1][:, :5] - state.outputs[:5]
    _, said = control.forced_response(system.ss(), U=small * np.tile([[1.0], [0.0], [0.0]], 101))
    # Curvature: the square of 1e-5 rad, beside answers of 1e-6.
    np.testing.assert_allclose(moved, np.asarray(said)[:, 1:].T, rtol=0, atol=1e-9)


@pytest.mark.parametrize("version", [2, 3])
def test_another_tools_fmu_by_pulses(version: int, tmp_path: Path) -> None:
    """Two first-order lags by forward Euler, known to the last digit."""
    fmu = build_foreign(tmp_path, version)
    h, T, k = 0.05, 0.5, 10.0
    system = linearize(fmu, at=10 * h, values={"u1": 0.3}, sample_time=h)
    assert system.method == "pulses"
    assert len(system.A) == 2
    np.testing.assert_allclose(np.linalg.eigvals(system.A), 1.0 - h / T, rtol=1e-9)
    lag = control.TransferFunction([k * h / T], [1.0, -(1.0 - h / T)], h)
    z = np.exp(1j * FREQUENCIES * h)
    expected = lag(z)[:, None, None] * np.array([[1.0, -0.5, -0.5], [0.0, 1.0, -1.0]])
    # Differences of outputs of some deg, pulses of 1e-4: 1e-16 / 1e-4 times condition.
    np.testing.assert_allclose(response(system.ss()), expected, rtol=1e-7, atol=1e-12)
    other = linearize(fmu, values={"T": 0.25, "k": 4.0}, sample_time=h)
    np.testing.assert_allclose(np.linalg.eigvals(other.A), 1.0 - h / 0.25, rtol=1e-9)


def test_pulses_and_derivatives_say_the_same() -> None:
    block = block_of("rls")
    exact = linearize(block, at=1.0)
    held = np.array([np.nan if port.missing else port.start for port in block.inputs])
    part = SavedBlock(block)
    part.start(0.0, {})
    for k in range(50):
        part.advance(k * TS, held)
    A, B, C, D, error = realize(part, 50, held, [0, 1, 2], [6.0] * 3, [0, 1, 2, 3, 4], "rls")
    assert error < 1e-9
    found = control.StateSpace(A, B, C, D, TS)
    np.testing.assert_allclose(response(found), response(exact.ss()), rtol=0, atol=1e-8)


@pytest.mark.parametrize("kind", ["pi", "hinf", "lqg"])
def test_a_controller_is_its_own_linear_form(kind: str) -> None:
    controller = load(GOLDEN / f"{kind}.npz", role="controller")
    system = linearize(controller.block(), at=1.0)  # the first sample is another one: it takes over without a bump
    places = [system.inputs.index(name) for name in ("pitch_reference", "roll_reference", "pitch", "roll")]
    ours = redefinition_matrix()[:2] @ response(system.ss())[:, :, places]
    assert system.method == "exact"
    # Realisations of up to 20 states with poles near one: condition numbers up to 1e6.
    np.testing.assert_allclose(ours, response(controller.ss()), rtol=1e-9, atol=1e-9)


class Toy:
    """A linear system of given matrices."""

    sample_time, role = 0.1, "controller"

    def __init__(self, A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> None:
        self.system, self.x = (A, B, C, D), np.full(len(A), 0.1)

    def advance(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002
        outputs = self.system[2] @ self.x + self.system[3] @ inputs
        self.x = self.system[0] @ self.x + self.system[1] @ inputs
        return outputs

    def get_state(self) -> bytes:
        return self.x.tobytes()

    def set_state(self, state: bytes) -> None:
        self.x = np.frombuffer(state)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 2), st.integers(1, 2))
def test_any_linear_system_is_found_again(seed: int, order: int, inputs: int, outputs: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((order, order))
    A *= rng.uniform(0.3, 0.95) / np.abs(np.linalg.eigvals(A)).max()
    B, C = rng.standard_normal((order, inputs)), rng.standard_normal((outputs, order))
    D = rng.standard_normal((outputs, inputs))
    a, b, c, d, error = realize(
        Toy(A, B, C, D), 0, np.zeros(inputs), list(range(inputs)), [1.0] * inputs, list(range(outputs)), "toy"
    )
    assert len(a) <= order
    assert error <= 1e-6
    for k in range(20):
        expected = C @ np.linalg.matrix_power(A, k) @ B
        scale = max(np.abs(C @ B).max(), np.abs(D).max(), np.abs(expected).max())
        np.testing.assert_allclose(c @ np.linalg.matrix_power(a, k) @ b, expected, rtol=0, atol=1e-4 * scale)
    np.testing.assert_allclose(d, D, rtol=0, atol=1e-8)


def test_what_moves_nothing_is_said() -> None:
    quiet = Toy(np.eye(1), np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))
    with pytest.raises(SettingsError, match="no input moves an output"):
        realize(quiet, 0, np.zeros(1), [0], [1.0], [0], "toy")
    with pytest.raises(SettingsError, match="has no input that is a number"):
        realize(quiet, 0, np.zeros(1), [], [], [0], "toy")


def test_a_file_is_what_its_block_is(tmp_path: Path) -> None:
    out, values = tmp_path / "ss.mat", {"motor_setpoint_1": 0.5}
    system = linearize(GOLDEN / "rls.npz", at=1.0, values=values)
    assert system.method == "exact"
    expected = linearize(block_of("rls"), at=1.0, values=values)
    system.to_mat(out)
    found = loadmat(out)
    for name in "ABCD":
        np.testing.assert_array_equal(found[name], getattr(expected, name))
    assert found["Ts"].item() == TS
    assert [str(name[0]) for name in found["InputName"].ravel()] == list(expected.inputs)
    with pytest.raises(OutputFileError, match="exists"):
        system.to_mat(out)
    assert "19 states at t = 1 s, 0.02 s a sample, exact" in system.summary()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"at": -1.0}, "`at` must be"),
        ({"at": math.nan}, "`at` must be"),
        ({"at": 1e9}, "10000000 samples"),
        ({"at": 0.031}, "take 0.04 s"),
        ({"values": {"motor_setpoint_1": math.inf}}, "must be finite"),
        ({"values": {"thrust": 1.0}}, "has no input or parameter `thrust`"),
        ({"sample_time": 0.1}, "`sample_time` is for FMUs"),
    ],
)
def test_bad_input_is_one_line(more: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        linearize(GOLDEN / "rls.npz", **more)


def test_files_that_cannot_be(tmp_path: Path) -> None:
    fmu = build_foreign(tmp_path, 2)
    blind = tmp_path / "Blind.fmu"
    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(blind, "w") as target:
        for name in source.namelist():
            data = source.read(name).replace(b'canGetAndSetFMUstate="true"', b'canGetAndSetFMUstate="false"')
            target.writestr(name, data)
    (tmp_path / "no.fmu").write_text("no zip")
    (tmp_path / "D.fmu").mkdir()
    (tmp_path / "D.npz").mkdir()
    for file, words in (
        (fmu, "states no step size"),
        (tmp_path / "no.fmu", r"no\.fmu"),
        (tmp_path / "absent.fmu", r"absent\.fmu"),
        (tmp_path / "D.fmu", "is a folder; name a file"),
        (tmp_path / "D.npz", "is a folder; name a file"),
        (tmp_path / "none.ssp", "holds several FMUs; unzip it"),
        (GOLDEN / "family.npz", "is not a model, observer or controller"),
    ):
        with pytest.raises(SoftneckError, match=words):
            linearize(file)
    with pytest.raises(SoftneckError, match="cannot save its state"):
        linearize(blind, sample_time=0.1)
    with pytest.raises(SettingsError, match="sample_time"):
        linearize(fmu, sample_time=-1.0)
