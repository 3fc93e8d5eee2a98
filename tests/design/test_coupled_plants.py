"""`lqg`, `mpc` and `custom` on plants of any number of inputs and outputs, each of which may move each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError, load, read_archive
from softneck.design import CustomSettings, LqgSettings, MpcController, MpcSettings, PidSettings, makeweight, mixsyn
from softneck.design.linear._axis_loop import rise_time
from softneck.design.linear._linear_parts_runtime import LinearArrays
from softneck.design.plants._coupled import (
    CoupledPlant,
    _plant_from_system,
    close_loop,
    coupled_plant,
    responses,
    scale_gains,
)
from softneck.design.predictive._settings import MpcNumbers
from softneck.identification import Rls
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.robot import Robot
from softneck.signals import redefinition_matrix, signal

from ..oracles.bake_off import bake_off_plant, exact

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")
TS = 0.02
NECK = Robot.preset()
SIZES = [(2, 2), (3, 2), (4, 3), (3, 1)]


def plant(inputs: int, outputs: int, *, late: int = 2, seed: int = 0) -> control.StateSpace:
    """Return lags of 0.1 to 0.5 s, mixed at random, behind so many samples."""
    rng = np.random.default_rng(seed)
    poles = np.exp(-TS * rng.uniform(2.0, 9.0, outputs + 2))
    B, C = rng.standard_normal((outputs + 2, inputs)), rng.standard_normal((outputs, outputs + 2))
    lags = control.StateSpace(np.diag(poles), (1.0 - poles)[:, None] * B, C, np.zeros((outputs, inputs)), TS)
    line: Any = control.ss(control.TransferFunction([1.0], [1.0, *[0.0] * late], TS))
    return lags * control.append(*[line] * inputs)


def within(inputs: int, outputs: int) -> Robot:
    """Return a robot of so many channels with limits, whose directions nobody knows."""
    return Robot.from_dict({
        "name": "plant", "directions": {"kind": "identified"},
        "motors": {"names": [f"p{j}" for j in range(inputs)], "unit": "1", "setpoint_min": -6, "setpoint_max": 6,
                   "rate_limit": 12},
        "outputs": {"names": [f"output_{i + 1}" for i in range(outputs)], "unit": "1"},
    })  # fmt: skip


def list_assumptions(G: Any, **more: Any) -> CoupledPlant:
    found = coupled_plant(G, **more)
    assert found is not None
    return found


def neck(gains: tuple[float, float] = (1.0, 0.8), across: float = 0.0) -> Any:
    """Return a neck's plant from theta_i, phi_i whose axes answer to each other by this part."""
    each: Any = control.append(*(control.ss(bake_off_plant(gain, 1.0).tf()) for gain in gains))
    return each * control.StateSpace([], [], [], [[1.0, across], [-across, 1.0]], TS)


@pytest.mark.parametrize(("inputs", "outputs"), [size for size in SIZES if size != (2, 2)])
def test_a_plants_rows_answer_as_it_does(inputs: int, outputs: int) -> None:
    G = plant(inputs, outputs)
    found = list_assumptions(G)
    w = np.array([0.1, 1.0, 10.0, 100.0])
    each = np.array([G(np.exp(1j * x * TS), squeeze=False) for x in w]) @ found.redefinition[1][:, :outputs]
    # An orthogonal change of at most 17 states.
    np.testing.assert_allclose(responses(found.rows, w, 0), each, rtol=1e-9, atol=1e-12)
    # The dead time is split off, and what is left shows in the output at once.
    assert [row.delay for row in found.rows] == [2] * outputs
    # At rest each redefined input moves its own output alone.
    at_rest = responses(found.rows, np.array([0.0]), 0)[0].real
    np.testing.assert_allclose(at_rest, np.diag(np.diag(at_rest)), atol=1e-10)


def test_plants_that_are_not_coupled_get_what_each_axis_gets() -> None:
    """One filter and one regulator for two axes that do not touch are those of each axis."""
    gains = (1.0, 1.0)  # so that both axes of the searches end at the same filter
    settings = LqgSettings(reference_time=0.2)
    each, whole = (
        settings.design(exact(neck(gains))),
        settings._design_coupled(_plant_from_system(neck(gains), NECK, NECK.weights())),
    )
    z = np.exp(1j * np.array([0.3, 3.0, 30.0]) * TS)
    # Riccati equations of twice the order.
    np.testing.assert_allclose(whole.ss()(z), each.ss()(z), rtol=1e-7, atol=1e-9)
    plans = [MpcSettings(bandwidth=5.0).design(G) for G in (neck(), neck(across=1e-9))]
    # What couples them is a billionth.
    np.testing.assert_allclose(plans[1].ss()(z), plans[0].ss()(z), rtol=1e-5, atol=1e-6)
    assert plans[1].arrays[2].shape[1] == 2 * plans[0].arrays[2].shape[1]


@pytest.mark.parametrize(("inputs", "outputs"), SIZES)
@pytest.mark.parametrize("settings", [LqgSettings(), MpcSettings(bandwidth=4.0)], ids=["lqg", "mpc"])
def test_references_are_reached_on_the_plant_itself(settings: Any, inputs: int, outputs: int, tmp_path: Path) -> None:
    G: Any = plant(inputs, outputs, seed=1)
    G = control.StateSpace(G.A, G.B, G.C, G.D, TS, inputs=[f"p{j}" for j in range(inputs)],
                           outputs=[f"y{i}" for i in range(outputs)])  # fmt: skip
    robot = within(inputs, outputs)
    robot = replace(robot, outputs=replace(robot.outputs, names=tuple(G.output_labels)))
    controller = settings.design(G, robot=robot)
    controller.save(tmp_path / "k.npz")
    block = load(tmp_path / "k.npz").block()
    assert [port.name for port in block.outputs] == [f"p{j}_setpoint" for j in range(inputs)]
    asked = 0.05 * np.arange(1, outputs + 1)
    state, x, u, most = block.initial_state(), np.zeros(len(G.A)), np.zeros(inputs), np.zeros(outputs)
    load_at = 0.1 * np.ones(inputs)
    for k in range(1500):
        y = G.C @ x
        most = np.maximum(most, y) if k < 750 else most
        state, u = block.step(state, np.concatenate([asked, [0.0], y, u, [1.0, 1.0]]))
        # A load on the inputs half way.
        x = G.A @ x + G.B @ (u + (load_at if k >= 750 else 0.0))
    # Integral action: what is left of modes of half a second after 15 s.
    np.testing.assert_allclose(G.C @ x, asked, atol=1e-4)
    # 4 % asked of `lqg`, 2 % of `mpc`, of each step alone; here all step at once.
    assert (most <= 1.15 * asked.max()).all()


def test_a_coupled_design_holds_where_one_for_each_axis_does_not() -> None:
    """Axes that turn into each other by as much as they move themselves."""
    G, settings = neck((1.0, 1.0), across=1.0), LqgSettings()
    whole, apart = settings.design(G), settings.design({"pitch": G[0, 0], "roll": G[1, 1]})
    # What `lqg` asks of a step of each reference, some of it for the spread of gains; the other swings.
    assert largest(whole, G) < 1.06
    assert largest(apart, G) > 1.3


def largest(controller: Any, G: Any) -> float:
    """Return the largest angle after a unit step of pitch's reference, on the plant from theta_i, phi_i."""
    K, T = controller.ss(), controller.arrays[LinearArrays.names().index("T")]
    turn = redefinition_matrix()[:2] @ np.linalg.inv(T)[:, :2]
    A = np.block([[G.A + G.B @ turn @ K.D[:, 2:] @ G.C, G.B @ turn @ K.C], [K.B[:, 2:] @ G.C, K.A]])
    B = np.concatenate([G.B @ turn @ K.D[:, 0], K.B[:, 0]])
    x, most = np.zeros(len(A)), 0.0
    for _ in range(500):
        x = A @ x + B
        most = max(most, float((G.C @ x[: len(G.A)])[0]))
    return most


@pytest.mark.parametrize("more", [{"rise_s": 1.2}, {"rise_s": 1.2, "order": "jacobi"}, {}])
def test_steps_are_as_they_were_asked_for(more: dict[str, Any]) -> None:
    """The slowest output's rise, or what the worst sample overshoots by, on the plant with the delay of its loop."""
    G = plant(3, 2, seed=2)
    controller = LqgSettings(**more).design(G, robot=within(3, 2))
    late = 2 if "order" in more else 0
    asked = [step_of(controller, list_assumptions(G), gain, late) for gain in (1.0, 0.8, 1.2)]
    if "rise_s" in more:
        # The filter is found to a millionth.
        assert max(rise_time(y, TS) for y in asked[0].T) == pytest.approx(1.2, rel=1e-3)
    else:
        assert max(float(y.max()) for y in asked) <= 1.04


def step_of(controller: Any, G: CoupledPlant, gain: float, late: int) -> np.ndarray:
    """Return each output (rows, outputs) after a unit step of its reference alone, over the filter of its file."""
    made, count = controller.ss(), len(G.rows)
    A, B, C = close_loop((made.A, made.B, made.C, made.D), scale_gains(G.rows, gain), late)
    x, y = np.zeros((len(A), count)), np.zeros((600, count))
    for k in range(600):
        x = A @ x + B
        y[k] = np.diag(C @ x)
    return y


def test_a_controller_of_ones_own_is_taken_with_its_plant() -> None:
    G = plant(3, 2, seed=1)
    found = list_assumptions(G)
    # K of u = K e in the plant's inputs is T K in its redefined ones.
    K: Any = mixsyn(G, makeweight(10.0, 1.0, 0.5), 0.5).controller
    K = control.StateSpace(K.A, K.B, found.redefinition[0][:2] @ K.C, found.redefinition[0][:2] @ K.D, TS)
    controller = CustomSettings(controller=K).design(G, robot=within(3, 2))
    z = np.exp(1j * np.array([0.3, 3.0]) * TS)
    np.testing.assert_allclose(controller.ss()(z)[:, :2], K(z), rtol=1e-9)
    with pytest.raises(SettingsError, match="the loop is not stable around sample 0 of 1"):
        CustomSettings(controller=K * 100.0).design(G, robot=within(3, 2))
    with pytest.raises(SettingsError, match="need one `controller` of output_1 and output_2"):
        CustomSettings(controller={"pitch": K[0, 0], "roll": K[1, 1]}).design(G, robot=within(3, 2))


@pytest.fixture(scope="module")
def mimo() -> Any:
    excitation = signal("eq22", duration=40.0)
    return Rls(structure="mimo", na=2, nb=2).fit(
        record(excitation, VirtualNeck(NeckParameters.preset("paper")), seed=1)
    )


@pytest.mark.slow
@pytest.mark.parametrize("settings", [LqgSettings(), MpcSettings(bandwidth=5.0)], ids=["lqg", "mpc"])
def test_an_identified_model_is_taken_with_what_it_says_between_its_axes(settings: Any, mimo: Any) -> None:
    controller = settings.design(mimo.ss())
    plants = list_assumptions(mimo.ss()).own_rows
    late = tuple(row.with_min_delay(0.08 if isinstance(settings, LqgSettings) else 0.1) for row in plants)
    made = controller.ss()
    A, B, C = close_loop((made.A, made.B, made.C, made.D), late, 0)
    assert np.abs(np.linalg.eigvals(A)).max() < 1.0
    at_rest = C @ np.linalg.solve(np.eye(len(A)) - A, B)
    # Integral action; the slowest modes that nothing shows are within 1e-3 of the border.
    np.testing.assert_allclose(at_rest, np.eye(2), atol=1e-6)


def test_a_file_whose_inputs_are_neither_its_own_nor_those_of_all_is_refused(tmp_path: Path) -> None:
    """Compiled text would read beyond the array."""
    MpcNumbers(bandwidth=3.0, horizon=8, moves=3).design(plant(3, 2), robot=within(3, 2)).save(tmp_path / "mpc.npz")
    header, arrays = read_archive(tmp_path / "mpc.npz")
    n = arrays["model_A"].shape[1]
    more = {name: np.hstack([arrays[name], arrays[name][:, :n]]) for name in ("model_B", "rest")}
    with pytest.raises(FileFormatError, match="`model_B` is of other inputs"):
        MpcController.from_archive(header, {**arrays, **more})


@pytest.mark.parametrize("settings", [LqgSettings(), MpcNumbers(bandwidth=5.0, reference_time=0.0)], ids=["lqg", "mpc"])
def test_what_it_says_of_itself_is_in_the_robots_own_inputs(settings: Any) -> None:
    """`ss()` goes to theta_i and phi_i of Eq. 9 and 10, whatever the inputs are that it was designed in."""
    G = neck(across=0.4)
    # The second axis answers to the first at rest as well.
    controller = settings.design(control.StateSpace(G.A, G.B, np.array([[1.0, 0.0], [0.3, 1.0]]) @ G.C, G.D, TS))
    block, asked = controller.block(), np.array([1e-3, -2e-3])
    _, out = block.step(block.initial_state(), np.concatenate([asked, np.zeros(6), [1.0, 1.0]]))
    # Sums of three numbers.
    np.testing.assert_allclose(redefinition_matrix()[:2] @ out, direct(controller, asked), rtol=1e-9, atol=1e-12)


def direct(controller: Any, asked: np.ndarray) -> np.ndarray:
    """Return what the references do at once, of `lqg` behind its filter."""
    made = controller.ss()
    return np.asarray(made.D)[:, :2] @ asked


UNSTABLE = control.StateSpace(np.diag([1.1, 0.5, 0.5]), np.ones((3, 3)), np.ones((2, 3)), np.zeros((2, 3)), TS)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (UNSTABLE, r"not stable \(spectral radius 1.1000\).*`mixsyn`"),
        (plant(1, 2), "1 input.s. cannot bring 2 output.s. to references of their own: they are too few"),
        (plant(3, 2) * 0.0, "`output_1` answers to none of them at rest"),
        (plant(9, 2), "`motors.names` must hold 1 to 8 names; got 9"),
        (plant(3, 2), "gives no `motors.setpoint_min` and `setpoint_max`"),
        (control.StateSpace(0.5 * np.eye(2), np.ones((2, 3)), np.eye(2), np.ones((2, 3)), TS), "strictly proper"),
    ],
)
@pytest.mark.parametrize("settings", [LqgSettings(), MpcSettings()], ids=["lqg", "mpc"])
def test_what_cannot_be_is_one_line(settings: Any, source: Any, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        settings.design(source)


def test_other_kinds_say_who_takes_it() -> None:
    with pytest.raises(SettingsError, match="`lqg`, `mpc` and `custom` take systems of any size"):
        PidSettings().design(plant(3, 2))
