"""FMUs of robots with other motors and outputs: variables, units, terminals, and the model's own numbers."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from softneck.core import FileFormatError, Matrix, SettingsError
from softneck.cosim import make_loop
from softneck.cosim.parts._fmu_part import drive_fmu
from softneck.design import PiSettings
from softneck.design.predictive._settings import MpcNumbers
from softneck.fmu import build_compiled_fmu, build_fmu, fmu_info
from softneck.fmu.compiled._model_file import node_of
from softneck.fmu.describe._description import terminals, with_modelled_drives
from softneck.identification import (
    GreyBox,
    Model,
    OutputError,
    Play,
    SetMembership,
    embed_model,
    embedded_model,
    validate,
)
from softneck.plant import VirtualNeck
from softneck.robot import Robot
from softneck.runtime import Block, Port, load_runtime
from softneck.signals import Recording

from ..data import slow_but
from ..design.test_robots import plant as lag

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")
TS = 0.02
ROWS = 500
WARM_UP = 300
CHAMBERS = {
    "name": "chambers",
    "sample_time_s": TS,
    "motors": {"names": ["left", "right"], "unit": "bar", "setpoint_min": 0.0, "setpoint_max": 2.0},
    "outputs": {"names": ["x", "y", "z"], "unit": "m", "display_unit": "mm"},
    "directions": {"kind": "identified"},
}
native = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)
BACKENDS = [("python", 2), pytest.param("compiled", 2, marks=native), pytest.param("compiled", 3, marks=native)]


@cache
def recording(chambers: bool) -> Recording:
    """First-order answers of three lengths to two pressures, or of one angle to two tendons."""
    robot = Robot.from_dict(CHAMBERS) if chambers else Robot.preset("antagonist")
    rng = np.random.default_rng(0)
    scale, G = (1e5, [[0.02, 0.01], [-0.01, 0.03], [0.005, -0.02]]) if chambers else (1.0, [[0.1, -0.1]])
    u = np.repeat(rng.uniform(0.2, 1.8, (ROWS // 20, 2)), 20, axis=0)
    y = np.zeros((ROWS, len(G)))
    for k in range(ROWS - 1):
        y[k + 1] = 0.8 * y[k] + 0.2 * np.array(G) @ u[k]
    y += 1e-4 * rng.standard_normal(y.shape)
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*scale * u.T, *y.T), strict=True))
    return Recording(np.arange(ROWS) * TS, TS, channels, robot=robot)


@cache
def trunk() -> Recording:
    """First-order answers of two angles to four tendons."""
    robot, rng = Robot.preset("trunk4"), np.random.default_rng(1)
    W, u = robot.weights(), np.repeat(rng.uniform(-2.0, 2.0, (ROWS // 20, 4)), 20, axis=0)
    assert W is not None
    y = np.zeros((ROWS, 2))
    for k in range(ROWS - 1):
        y[k + 1] = 0.8 * y[k] + 0.02 * W @ u[k]
    y += 1e-3 * rng.standard_normal(y.shape)
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*u.T, *y.T), strict=True))
    return Recording(np.arange(ROWS) * TS, TS, channels, robot=robot)


# Few numbers and steps: what an FMU says is to be what its model says, however good that is.
EVERY_KIND: dict[str, Any] = {
    "paper_eq21": SetMembership(epsilon=3e-3, output_weight=3.0),
    "nlsm": SetMembership(form="residual", epsilon=3e-3, output_weight=5.0),
    "greybox": GreyBox(evaluations=1, sensor_delay=1),
}


@pytest.mark.parametrize("backend", ["python", pytest.param("compiled", marks=native)])
@pytest.mark.parametrize("name", slow_but(["antagonist", "trunk4"], ["antagonist"], ["trunk4"]))
@pytest.mark.parametrize("kind", slow_but(EVERY_KIND, ["nlsm"], ["paper_eq21", "greybox"]))
def test_an_fmu_of_any_kind_runs_free_as_its_model(kind: str, name: str, backend: str, tmp_path: Path) -> None:
    rec = trunk() if name == "trunk4" else recording(False)
    chosen: Model = EVERY_KIND[kind].fit(rec)
    path = built(chosen.block(), tmp_path / "Kind.fmu", backend, 2)
    inputs = {motor: rec.channels[motor][:80] for motor in rec.robot.set_points}
    found = drive_fmu(path, inputs, parameters={"use_measurement": 0.0})
    rows = np.full((80, len(chosen.block().inputs)), np.nan)
    rows[:, : len(rec.robot.set_points)] = rec.set_points[:80]
    state = chosen.initial_state(use_measurement=0.0)
    expected = np.vstack([state.outputs, chosen.block().run(state, rows)[1][:-1]])
    # The same operations by another compiler; a search among points answers to rounding.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@cache
def model(kind: str, chambers: bool) -> Model:
    settings: dict[str, Any] = {
        "oe": OutputError(delay=0.0),
        "play": Play(rate=15.0, widths=(0.2,), degree=1),
    }
    return settings[kind].fit(recording(chambers))


def built(block: Block, path: Path, backend: str, fmi: int) -> Path:
    if backend == "python":
        build_fmu(block, path)
    else:
        build_compiled_fmu(block, path, fmi=fmi)
    assert not validate_fmu(str(path))
    return path


def variables(path: Path) -> dict[str, Any]:
    return {item.name: item for item in fmpy.read_model_description(str(path)).modelVariables}


@pytest.mark.parametrize(("backend", "fmi"), BACKENDS)
def test_an_fmu_is_simulated_as_its_model(backend: str, fmi: int, tmp_path: Path) -> None:
    rec, chosen = recording(False), model("oe", False)
    path = built(chosen.block(), tmp_path / "Oe.fmu", backend, fmi)
    measured = rec.channels["pitch"].copy()
    measured[WARM_UP:] = np.nan
    inputs = {name: rec.channels[name] for name in rec.robot.set_points} | {"pitch_measured": measured}
    found = drive_fmu(path, inputs, parameters={"use_measurement": 1.0})
    # What the start was is forgotten: 0.8^300 is below rounding.
    expected = chosen.simulate(rec, warm_up=WARM_UP)
    np.testing.assert_allclose(found[WARM_UP:, :-1], expected[WARM_UP:, :-1], atol=1e-12)
    # Of where the motors have been held 0.98^300 is left: 0.2 % of a unit.
    np.testing.assert_allclose(found[WARM_UP:, -1], expected[WARM_UP:, -1], atol=2e-3)


@pytest.mark.parametrize(("backend", "fmi"), BACKENDS)
@pytest.mark.parametrize("kind", ["oe", "play"])
def test_pressures_and_lengths_keep_their_names_units_and_ranges(
    kind: str, backend: str, fmi: int, tmp_path: Path
) -> None:
    rec, block = recording(True), model(kind, True).block()
    path = built(block, tmp_path / "Chambers.fmu", backend, fmi)
    found = variables(path)
    assert list(found)[:10] == [
        "left_setpoint", "right_setpoint", "x_measured", "y_measured", "z_measured",
        "left_position_measured", "right_position_measured", "x", "y", "z",
    ]  # fmt: skip
    assert [found[name].causality for name in ("x_start", "z_start", "use_measurement")] == ["parameter"] * 3
    pressure = found["left_setpoint"]
    assert float(pressure.max) == rec.channels["left_setpoint"].max()
    units = {unit.name: unit for unit in fmpy.read_model_description(str(path)).unitDefinitions}
    (bar,), (mm,) = units["Pa"].displayUnits, units["m"].displayUnits
    assert (bar.name, bar.factor, mm.name, mm.factor) == ("bar", 1e-5, "mm", 1e3)
    assert (pressure.displayUnit, found["x"].displayUnit) == ("bar", "mm")
    tunable = {name: found[name].unit for name in found if found[name].variability == "tunable"}
    gains = dict.fromkeys(("x_gain", "y_gain", "z_gain"), "m/Pa")
    assert tunable == ({**gains, "dead_time": None} if kind == "oe" else {})
    inputs = {name: rec.channels[name][:60] for name in rec.robot.set_points}
    # To rounding: sums in another order, 1e5 Pa of what makes 1e-2 m.
    np.testing.assert_allclose(
        drive_fmu(path, inputs, parameters={"use_measurement": 0.0}), plain(block, 60, **inputs), rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize("backend", ["python", pytest.param("compiled", marks=native)])
def test_without_tendons_the_recorded_range_of_outputs_and_half_of_it_is_declared(
    backend: str, tmp_path: Path, running: Any
) -> None:
    rec, chosen = recording(True), model("oe", True)
    path = built(chosen.block(), tmp_path / "Ranges.fmu", backend, 2)
    found = variables(path)
    for name in "xyz":
        low, high = min(rec.channels[name].min(), 0.0), max(rec.channels[name].max(), 0.0)  # it starts at zero
        ends = [float(found[name].min), float(found[name].max)]
        np.testing.assert_allclose(ends, [1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low], rtol=1e-12)
    assert found["left_position"].max is None
    most = float(found["x"].max)
    with running(path) as fmu:
        fmu.begin(limit_outputs=1.0)
        fmu.set(left_setpoint=1e5, right_setpoint=1e5)
        fmu.fmu.doStep(0.0, 50 * TS)
        assert fmu.get("validity")[0] > 0.0
        fmu.set(left_setpoint=1e6)
        fmu.fmu.doStep(50 * TS, 50 * TS)
        assert fmu.get("x", "validity") == [most, 0.0]
        assert any("output x = " in text for _, text in fmu.log)
    before = replace(chosen, findings={k: v for k, v in chosen.findings.items() if k != "outputs_si"})
    assert all(port.maximum is None for port in before.block().outputs[:3])
    header, arrays = embed_model(chosen)
    findings = {**chosen.findings, "outputs_si": {"min": [0.0] * 2, "max": [1.0] * 2}}
    with pytest.raises(FileFormatError, match="a minimum and a maximum for each motor and output"):
        embedded_model({**header, "findings": findings}, arrays)


def plain(block: Block, rows: int, **inputs: Matrix) -> Matrix:
    """Outputs of a block in plain Python from its start, its parameters at their starts but use_measurement."""
    runtime = load_runtime(block.runtime, compiled=False)
    q, U = np.array([port.start for port in block.parameters]), np.zeros((rows, len(block.inputs)))
    for column, port in zip(U.T, block.inputs, strict=True):
        column[:] = inputs.get(port.name, np.nan if port.missing else port.start)
    x, Y = np.zeros(runtime.state_size(block.arrays)), np.zeros((rows, len(block.outputs)))
    runtime.initialise(block.arrays, q, x, Y[0])
    for k in range(rows - 1):
        runtime.step(block.arrays, q, x, U[k], Y[k + 1])
    return Y


def test_terminals_and_pages_speak_of_the_robot_s_outputs() -> None:
    chosen = model("oe", True)
    assert terminals(chosen.block())["outputs"] == ["x", "y", "z"]
    assert terminals(model("oe", False).block())["angles"] == ["pitch"]
    page = fmu_info(chosen, validation=validate(chosen, recording(True), include_training=True)).documentation
    assert all(f"<th>{name}</th>" in page for name in "xyz")


@pytest.mark.parametrize(("backend", "fmi"), BACKENDS[:2])
def test_a_robot_s_virtual_plant_is_an_fmu(backend: str, fmi: int, tmp_path: Path) -> None:
    block = VirtualNeck.of(Robot.preset("antagonist")).block(internal_step=0.004)
    path = built(block, tmp_path / "Antagonist.fmu", backend, fmi)
    inputs = {"motor_setpoint_1": np.full(15, 2.0), "payload": np.full(15, 0.1)}
    np.testing.assert_allclose(drive_fmu(path, inputs), plain(block, 15, **inputs), atol=1e-9)
    assert [name for name in variables(path) if name.startswith("tendon_angle_")] == [
        "tendon_angle_1", "tendon_angle_2",
    ]  # fmt: skip


@pytest.mark.parametrize(("backend", "fmi"), BACKENDS[1:])
@pytest.mark.parametrize("kind", slow_but(["pi", "mpc"], ["pi"], nightly=["mpc"]))
def test_a_controller_of_two_motors_is_an_fmu(kind: str, backend: str, fmi: int, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"pi": PiSettings(), "mpc": MpcNumbers(bandwidth=5.0, horizon=8, moves=3)}
    controller = settings[kind].design(model("oe", False)).block()
    path = built(controller, tmp_path / "Controller.fmu", backend, fmi)
    rng = np.random.default_rng(1)
    inputs = {"pitch_reference": np.full(80, 0.1), "pitch": 0.02 * rng.standard_normal(80)}
    inputs |= {f"motor_position_{j}": 0.1 * rng.standard_normal(80) for j in (1, 2)}
    asked = {"use_motor_positions": 1.0}
    # A controller answers at once, a plant a sample later. The same operations, compiled by another compiler.
    found, expected = drive_fmu(path, inputs, parameters=asked), plain(controller, 80, **inputs)
    np.testing.assert_allclose(found[:-1], expected[1:], rtol=1e-9, atol=1e-12)


def test_sizes_that_no_robot_has_are_not_made() -> None:
    block = VirtualNeck.of(Robot.preset("antagonist")).block()
    for size in ("9x1", "2x1x1", "999999x2", "n"):
        with pytest.raises(SettingsError, match="cannot be in a compiled FMU"):
            node_of(f"softneck.plant._neck_runtime@{size}", block.arrays)


def test_a_controller_of_two_motors_has_the_drives_of_two() -> None:
    neck = with_modelled_drives(_controller(3, 2))
    assert [array.tolist()[2:] for array in neck.arrays[:1]] == [[]]
    two = with_modelled_drives(_controller(2, 1))
    assert two.arrays[0].tolist()[2:] == [3.0, 2.0]
    assert two.parameters[-1].description.startswith("true: use the inputs motor_position_1..2;")
    bar = _controller(2, 1)
    bar = replace(bar, inputs=tuple(replace(port, unit="Pa") for port in bar.inputs))
    assert with_modelled_drives(bar) is bar


def _controller(motors: int, outputs: int) -> Block:
    """Ports in the order of our controllers: references, co-contraction, outputs, positions."""
    names = ["pitch", "roll"][:outputs]
    inputs = [f"{name}_reference" for name in names] + ["cocontraction_reference", *names]
    inputs += [f"motor_position_{j + 1}" for j in range(motors)]
    return Block(
        kind="pid", role="controller", runtime="softneck.design.linear._linear_controller_runtime", sample_time=TS,
        arrays=(), inputs=tuple(Port(name=name, unit="rad") for name in inputs),
        outputs=tuple(Port(name=f"motor_setpoint_{j + 1}", unit="rad") for j in range(motors)),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("backend", "fmi"), BACKENDS)
def test_a_controller_and_another_robot_s_fmu_are_refused_in_a_line_that_names_both(
    backend: str, fmi: int, tmp_path: Path
) -> None:
    ours, other = (lag(Robot.preset(name)) for name in ("antagonist", "trunk4"))
    build: Any = build_fmu if backend == "python" else partial(build_compiled_fmu, fmi=fmi)
    for name, model in (("ours", ours), ("other", other)):
        build(model.block(), tmp_path / f"{name}.fmu", info=fmu_info(model))
    table = {"duration_s": 0.1, "controller": PiSettings().design(ours), "reference": {"kind": "step", "pitch_deg": 3}}
    make_loop({**table, "plant": tmp_path / "ours.fmu"}).loop.close()
    with pytest.raises(SettingsError, match=r"\[plant\] is an FMU of robot `trunk4` .* and the loop of .*`antagonist`"):
        make_loop({**table, "plant": tmp_path / "other.fmu"})
