"""FMUs with sensitivities: what later samples will be, and their directional derivatives, in FMI 2.0 and 3.0."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from softneck.cli._main import run
from softneck.core import Matrix, SettingsError, load
from softneck.fmu import build_compiled_fmu, unpacked
from softneck.runtime import Block
from softneck.runtime._compile import load_tangent

from ..data import ROOT, slow_but
from .conftest import Running

TS = 0.02
MOTORS = [f"motor_setpoint_{j}" for j in (1, 2, 3)]
NEXT, AHEAD = ["pitch_next", "roll_next"], ["pitch_ahead", "roll_ahead"]
LATER = NEXT + AHEAD
KINDS = (
    "rls", "rls_mimo", "oe", "nn", "play", "greybox", "guarded", "nlsm",
    "nlsm_residual",
)  # fmt: skip
# Controllers and observers: their outputs follow the inputs of a sample at once.
LAWS = ("pi", "pid", "lqg", "fopi", "hinf", "custom", "nonlinear")
pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)


MEASURED = ["pitch_measured", "roll_measured", *(f"motor_position_measured_{j}" for j in (1, 2, 3))]


def horizon(path: Path) -> int:
    """Return the samples that the description tells."""
    [port] = [v for v in fmpy.read_model_description(str(path)).modelVariables if v.name == "pitch_ahead"]
    found = re.search(r"(\d+) samples \(([\d.]+) s\) ahead", port.description or "")
    assert found
    # Three digits are shown.
    assert float(found[2]) == pytest.approx(int(found[1]) * TS, rel=5e-3)
    return int(found[1])


def block_of(kind: str) -> Block:
    return load(ROOT / "tests" / "golden" / f"{kind}.npz", role="model").block()


@pytest.fixture(scope="module", params=slow_but(KINDS, ("nn",)))
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def path(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp(kind) / f"{kind}.fmu"
    build_compiled_fmu(block_of(kind), target, sensitivities=True)
    return target


def motion(rows: int) -> Matrix:
    """Set-points that wander, far from the corners of friction and limits."""
    walk = np.cumsum(np.random.default_rng(3).normal(0.0, 0.3, (rows, 3)), axis=0)
    return np.clip(walk, -4.0, 4.0)


def move(fmu: Running, rows: int) -> None:
    for k, row in enumerate(motion(rows)):
        fmu.set(**dict(zip(MOTORS, row, strict=True)))
        fmu.fmu.doStep(k * TS, TS)


def derivatives(fmu: Running, names: list[str]) -> Matrix:
    """Return (outputs to come, inputs), one input at a time as fmpy gives them."""
    unknown = [fmu.references[name] for name in LATER]
    columns = [fmu.fmu.getDirectionalDerivative(unknown, [fmu.references[name]], [1.0]) for name in names]
    return np.array(columns).T


def differences(fmu: Running, names: list[str], size: float = 1e-5) -> Matrix:
    columns = []
    for name in names:
        [held] = fmu.get(name)
        sides = []
        for sign in (1.0, -1.0):
            fmu.set(**{name: held + sign * size})
            sides.append(np.array(fmu.get(*LATER)))
        fmu.set(**{name: held})
        columns.append((sides[0] - sides[1]) / (2.0 * size))
    return np.array(columns).T


def test_what_it_says_will_come_comes(path: Path, running: Any) -> None:
    with running(path) as fmu, running(path) as blind:
        fmu.begin()
        blind.begin()
        for k, row in enumerate(motion(60)):
            for one in (fmu, blind) if k % 2 else ():  # held for two samples each
                one.set(**dict(zip(MOTORS, row, strict=True)))
            said = fmu.get(*LATER)
            derivatives(fmu, MOTORS)
            for one in (fmu, blind):
                one.fmu.doStep(k * TS, TS)
            assert fmu.get("pitch", "roll") == said[:2]
            # Looking changes nothing.
            assert fmu.get("pitch", "roll") == blind.get("pitch", "roll")


@pytest.mark.parametrize("measured", [False, True])
def test_held_set_points_lead_to_what_is_ahead(path: Path, measured: bool, running: Any) -> None:
    """What is ahead is a prediction: with measured angles up to now, and without any behind."""
    h = horizon(path)
    with running(path) as fmu:
        fmu.begin(use_measurement=float(measured))
        move(fmu, 20)
        if measured:
            fmu.set(pitch_measured=0.05, roll_measured=-0.1, motor_position_measured_1=0.3)
        said = fmu.get(*AHEAD)
        fmu.fmu.doStep(20 * TS, 0.4 * TS)
        assert fmu.get(*AHEAD) == said  # between samples it is still that of the last one reached
        fmu.set(**dict.fromkeys(MEASURED, np.nan))
        fmu.fmu.doStep(20.4 * TS, 0.6 * TS)
        held = fmu.get("pitch_next")
        for k in range(21, 20 + h):
            fmu.fmu.doStep(k * TS, TS)
        assert fmu.get("pitch", "roll") == said
        assert h == 1 or fmu.get("pitch_next") != held


@pytest.mark.parametrize("measured", [False, True])
def test_derivatives_are_those_of_differences(path: Path, measured: bool, running: Any) -> None:
    names = MOTORS + (MEASURED[:2] if measured else [])
    with running(path) as fmu:
        fmu.begin(use_measurement=float(measured))
        if measured:
            fmu.set(pitch_measured=0.01, roll_measured=-0.02)
        move(fmu, 60)
        exact, near = derivatives(fmu, names), differences(fmu, names)
        # Rounding of differences: 1e-16 / 1e-5 of angles below 1; curvature times 1e-10; three digits of room.
        np.testing.assert_allclose(exact, near, rtol=1e-5, atol=1e-8)
        # Along several inputs at once: the sum.
        seeds = np.linspace(-1.0, 1.0, len(names))
        references = [fmu.references[name] for name in names]
        moved = fmu.fmu.getDirectionalDerivative([fmu.references[name] for name in LATER], references, seeds.tolist())
        np.testing.assert_allclose(moved, exact @ seeds, rtol=1e-12, atol=1e-15)


def test_it_is_the_derivative_of_the_python_model(path: Path, kind: str, running: Any) -> None:
    block = block_of(kind)
    state = block.initial_state(use_measurement=0.0)
    rows = np.full((60, len(block.inputs)), np.nan)
    rows[:, :3] = motion(60)
    with running(path) as fmu:
        fmu.begin()
        for k, row in enumerate(motion(60)):
            fmu.set(**dict(zip(MOTORS, row, strict=True)))
            if k == 59:
                at = block.run(state, rows[:59])[0]
                x, y, found = at.values.copy(), at.outputs.copy(), []
                X, U, Y = np.zeros((x.size, 3)), np.zeros((8, 3)), np.zeros((y.size, 3))
                U[:3] = np.eye(3)
                tangent = load_tangent(block.runtime, compiled=False)  # numba would take its time
                for _ in range(horizon(path)):  # the chain rule, one sample at a time
                    tangent(block.arrays, at.parameters, x, rows[k], y, X, U, Y, 3)
                    found.append(Y[:2].copy())
                # Sums of a network come in another order: rounding of some hundred terms.
                expected = np.vstack([found[0], found[-1]])
                np.testing.assert_allclose(derivatives(fmu, MOTORS), expected, rtol=1e-10, atol=1e-13)
            fmu.fmu.doStep(k * TS, TS)


def test_between_samples_the_next_one_is_settled(path: Path, running: Any) -> None:
    with running(path) as fmu:
        fmu.begin()
        move(fmu, 20)
        fmu.set(motor_setpoint_1=1.0)
        fmu.fmu.doStep(20 * TS, 0.4 * TS)
        said = fmu.get(*NEXT)
        fmu.set(motor_setpoint_1=-3.0)
        assert fmu.get(*NEXT) == said
        moved = derivatives(fmu, MOTORS)
        assert not moved[:2].any()
        # Those ahead are not: what is set now acts from the next sample on.
        np.testing.assert_allclose(moved, differences(fmu, MOTORS), rtol=1e-5, atol=1e-8)
        fmu.fmu.doStep(20.4 * TS, 0.6 * TS)
        assert fmu.get("pitch", "roll") == said


def test_a_step_behind_a_derivative_takes_the_inputs_of_its_own(path: Path, running: Any) -> None:
    with running(path) as fmu, running(path) as blind:
        for one in (fmu, blind):
            one.begin()
            move(one, 10)
        derivatives(fmu, MOTORS)  # works the step out, which must not be taken any more
        for one in (fmu, blind):
            one.set(motor_setpoint_1=1.0)
            one.fmu.doStep(10 * TS, TS)
        assert fmu.get("pitch", "roll") == blind.get("pitch", "roll")
        derivatives(fmu, MOTORS)
        for one in (fmu, blind):
            one.fmu.doStep(11 * TS, 3 * TS)  # the first of three samples alone was worked out
        assert fmu.get("pitch", "roll") == blind.get("pitch", "roll")


def test_a_state_brings_its_next_sample_back(path: Path, running: Any) -> None:
    with running(path) as fmu:
        fmu.begin()
        move(fmu, 20)
        state = fmu.fmu.getFMUstate()
        said, moved = fmu.get(*LATER), derivatives(fmu, MOTORS)
        move(fmu, 5)
        assert fmu.get(*LATER) != said
        fmu.fmu.setFMUstate(state)
        assert fmu.get(*LATER) == said
        np.testing.assert_array_equal(derivatives(fmu, MOTORS), moved)


def test_what_the_file_says(path: Path, kind: str, running: Any) -> None:
    assert validate_fmu(str(path)) == []
    model = fmpy.read_model_description(str(path))
    assert model.coSimulation is not None
    assert model.coSimulation.providesDirectionalDerivative
    known = {
        getattr(unknown.variable, "name", ""): {v.name for v in unknown.dependencies or () if v is not None}
        for unknown in model.outputs
    }
    assert not any(known[name] for name in known.keys() - set(LATER))
    acting = {name: known[name] & set(MOTORS) for name in LATER}
    # A dead time is between a set-point and the next sample, unless a parameter may take it away (`oe` is over motors).
    assert bool(acting["pitch_next"]) == (kind in ("rls", "rls_mimo", "guarded"))
    assert acting["pitch_ahead"] == set(MOTORS)
    assert acting["roll_ahead"] >= set(MOTORS[1:])
    # What is declared is what derivatives say along a motion.
    shortest = {v.name: 0.0 for v in model.modelVariables if v.name.endswith("dead_time")}
    found = np.zeros((len(LATER), len(MOTORS)), dtype=bool)
    with running(path) as fmu:
        fmu.begin(**shortest)
        for k, row in enumerate(motion(40)):
            fmu.set(**dict(zip(MOTORS, row, strict=True)))
            found |= derivatives(fmu, MOTORS) != 0.0
            fmu.fmu.doStep(k * TS, TS)
    for name, row in zip(LATER, found, strict=True):
        moving = {motor for motor, moves in zip(MOTORS, row, strict=True) if moves}
        assert acting[name] >= moving if kind == "guarded" else acting[name] == moving, name


def test_fmi3_gives_the_same_bits(path: Path, kind: str, tmp_path: Path, running: Any) -> None:
    build_compiled_fmu(block_of(kind), tmp_path / f"{kind}.fmu", sensitivities=True, fmi=3)
    assert validate_fmu(str(tmp_path / f"{kind}.fmu")) == []
    with running(path) as two:
        two.begin()
        move(two, 30)
        expected, said = derivatives(two, MOTORS), two.get(*LATER)
    with unpacked(tmp_path / f"{kind}.fmu") as folder:
        model = fmpy.read_model_description(str(folder))
        assert model.coSimulation is not None
        assert b'providesDirectionalDerivatives="true"' in (Path(folder) / "modelDescription.xml").read_bytes()
        name = model.coSimulation.modelIdentifier
        fmu = FMU3Slave(guid=model.guid, unzipDirectory=str(folder), modelIdentifier=name, instanceName="three")
        references = {v.name: v.valueReference for v in model.modelVariables}
        fmu.instantiate()
        fmu.enterInitializationMode(startTime=0.0)
        fmu.exitInitializationMode()
        motors, unknown = [references[name] for name in MOTORS], [references[name] for name in LATER]
        for k, row in enumerate(motion(30)):
            fmu.setFloat64(motors, row.tolist())
            fmu.doStep(currentCommunicationPoint=k * TS, communicationStepSize=TS)
        moved = [fmu.getDirectionalDerivative(unknown, [motor], [1.0]) for motor in motors]
        assert list(fmu.getFloat64(unknown)) == said
        fmu.freeInstance()
    np.testing.assert_array_equal(np.array(moved).T, expected)


def test_what_has_no_derivative_is_said(kind: str, path: Path, running: Any) -> None:
    with running(path) as fmu:
        fmu.begin()
        ask = fmu.fmu.getDirectionalDerivative
        ahead, motor = fmu.references["pitch_next"], fmu.references["motor_setpoint_1"]
        # Other outputs wait for a step: no input moves them now.
        assert ask([fmu.references["pitch"]], [motor], [1.0]) == [0.0]
        for unknown, known, seed, words in (
            (motor, motor, 1.0, "derivatives are of outputs"),
            (ahead, fmu.references["pitch_start"], 1.0, "by inputs that are numbers"),
            (ahead, 999, 1.0, "variable 999"),
            (ahead, motor, float("nan"), "finite seeds"),
        ):
            with pytest.raises(FMICallException):
                ask([unknown], [known], [seed])
            assert words in fmu.log[-1][1]


def test_an_fmu_without_says_so(tmp_path: Path, running: Any) -> None:
    build_compiled_fmu(block_of("rls"), tmp_path / "Plain.fmu")
    with running(tmp_path / "Plain.fmu") as fmu:
        fmu.begin()
        with pytest.raises(FMICallException):
            fmu.fmu.getDirectionalDerivative([8], [0], [1.0])
        assert "--sensitivities" in fmu.log[-1][1]


@pytest.mark.parametrize("name", slow_but(LAWS, ("pi", "nonlinear")))
def test_controllers_and_observers_have_them_too(name: str, tmp_path: Path, running: Any) -> None:
    block = load(ROOT / "tests" / "golden" / f"{name}.npz").block()
    build_compiled_fmu(block, tmp_path / "Law.fmu", sensitivities=True)
    assert validate_fmu(str(tmp_path / "Law.fmu")) == []
    model = fmpy.read_model_description(str(tmp_path / "Law.fmu"))
    ahead = [v.name for v in model.modelVariables if v.name.endswith("_next")]
    assert ahead[0] == ("motor_setpoint_1_next" if block.role == "controller" else "pitch_next")
    numbers = [port.name for port in block.inputs if not port.boolean]
    rng, values, said = np.random.default_rng(0), np.zeros(len(numbers)), [0.0]
    with running(tmp_path / "Law.fmu") as fmu:
        fmu.begin()
        references = [fmu.references[one] for one in ahead]
        for k in range(30):
            values += rng.normal(0.0, 0.003, len(numbers))
            fmu.set(**{p.name: 1.0 for p in block.inputs if p.boolean}, **dict(zip(numbers, values, strict=True)))
            if k == 29:
                exact = [fmu.fmu.getDirectionalDerivative(references, [fmu.references[one]], [1.0]) for one in numbers]
                near = []
                for one, value in zip(numbers, values, strict=True):
                    sides = []
                    for sign in (1.0, -1.0):
                        fmu.set(**{one: value + sign * 1e-6})
                        sides.append(np.array(fmu.get(*ahead)))
                    fmu.set(**{one: value})
                    near.append((sides[0] - sides[1]) / 2e-6)
                # Rounding of differences: 1e-16 / 1e-6 of set-points below 10, with room; gates take squares of moves.
                np.testing.assert_allclose(exact, near, rtol=1e-6, atol=1e-7)
                assert np.abs(exact).max() > 0.1
                said = fmu.get(*ahead)
            fmu.fmu.doStep(k * TS, TS)
        assert fmu.get(*(one.removesuffix("_next") for one in ahead)) == said


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mpc", "quadratic program"), ("kalman", "covariance"), ("adaptive", "learns its plant"),
    ],
)  # fmt: skip
def test_kinds_without_are_refused(name: str, words: str, tmp_path: Path) -> None:
    block = load(ROOT / "tests" / "golden" / f"{name}.npz").block()
    with pytest.raises(SettingsError, match=words):
        build_compiled_fmu(block, tmp_path / "X.fmu", sensitivities=True)
    assert not list(tmp_path.iterdir())


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = str(ROOT / "tests" / "golden" / "nn.npz"), tmp_path / "Nn.fmu"
    assert run(["fmu", source, "-o", str(target), "--sensitivities"]) == 2
    assert "--backend compiled" in capsys.readouterr().err
    assert not target.exists()
    assert run(["fmu", source, "-o", str(target), "--backend", "compiled", "--sensitivities"]) == 0
    assert "pitch_next" in {v.name for v in fmpy.read_model_description(str(target)).modelVariables}
