"""Every foreign neck obeys mechanics: it rests, energy falls, slack tendons pull nothing, payloads stay finite."""

from __future__ import annotations

from importlib import import_module
from itertools import pairwise

import numpy as np
import pytest

import softneck
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import load_functions, load_runtime
from softneck.signals import SAMPLE_TIME, Excitation, signal

from ..data import slow_but
from ._beam_runtime import BeamState
from ._shared_runtime import ForeignArrays
from .necks import NECKS, ForeignNeck, record

# The others take a minute to compile.
QUICK = ("column",)
SOME = slow_but(NECKS, QUICK)
PITCH, TENSIONS, COMPRESSION = slice(0, 2), slice(10, 13), 13
# Wear and running in change a neck by the way its motors go; here they are off.
UNWORN = {
    "chain": {"running_in": (0.0, 1.0)}, "beam": {"wear": (0.0, 1.0)}, "twisted": {"running_in": (0.0, 1.0)},
    "spring": {"dead_zone": (0.03, 0.0, 1.0)}, "foam": {"grease": (0.0, 1.0)},
}  # fmt: skip
# Relays and sheaths hold energy that `energy` does not count.
COUNTED = {"beam": {"preisach": (0.0, 0.4, 0.2)}, "foam": {"sheath": (0.0, 0.001)}}


def quiet(name: str, *, seed: int = 0, **changes: tuple[float, ...]) -> ForeignNeck:
    return ForeignNeck(name=name, seed=seed, noise=False, changes=tuple(changes.items()))


def inputs(rows: int, motors: tuple[float, float, float], payload: float = 0.0) -> np.ndarray:
    U = np.zeros((rows, 8))
    U[:, :3], U[:, 3] = motors, payload
    return U


@pytest.mark.parametrize("name", SOME)
def test_a_neck_that_nobody_moves_rests(name: str) -> None:
    block = quiet(name).block()
    state = block.initial_state()
    _, Y = block.run(state, inputs(250, (0.0, 0.0, 0.0)))
    # Homing ends where the springs balance; what the relays of `beam` hold there moves it by 0.02 deg.
    assert np.degrees(np.abs(Y[:, PITCH] - state.outputs[PITCH])).max() < 0.05
    np.testing.assert_allclose(Y[:, TENSIONS], quiet(name).numbers()["pretension"][0], atol=0.1)


@pytest.mark.parametrize("payload", [0.0, 1.0])
@pytest.mark.parametrize("name", SOME)
def test_energy_falls_with_locked_winches(name: str, payload: float) -> None:
    drive = quiet(name).numbers()["drive"].copy()
    drive[1] = 0.0  # the speed limit
    block = quiet(name, drive=tuple(drive), **COUNTED.get(name, {})).block()
    U = inputs(40, (0.0, 0.0, 0.0), payload)
    U[:, 4], U[:, 5] = 3.0, -1.0
    state, Y = block.run(block.initial_state(), U)
    assert np.ptp(Y[:, 0]) > 0.01
    measure, let_go = load_functions(quiet(name).runtime, compiled=False).energy, inputs(1, (0.0, 0.0, 0.0), payload)[0]
    E = [measure(state.parameters, state.values, let_go)]
    for _ in range(60):
        state, _ = block.step(state, let_go)
        E.append(measure(state.parameters, state.values, let_go))
    # Semi-implicit Euler swings about the true energy by its step times the fastest speed.
    assert np.diff(E).max() < 1e-3 * (E[0] - E[-1])
    assert E[0] - E[-1] > 1e-4


# What makes each neck lag, whatever the speed; nothing of it.
WITHOUT_HYSTERESIS = {
    "chain": {"friction": (0.0, 1.6, 0.006)}, "spring": {"hysteresis": (0.0, 0.0)}, "foam": {"sheath": (0.0, 0.001)},
    "beam": {"preisach": (0.0, 0.4, 0.2)}, "twisted": {"slider": (0.0, 0.0, 0.0, 0.0)},
}  # fmt: skip
# Coordinates of the bodies, and how far they are moved [rad, m].
MOVED = {name: {"b": 0.15} for name in NECKS} | {"chain": {"b": 0.04}, "beam": {"d": 0.006, "t": 0.15}}


@pytest.mark.parametrize("name", SOME)
def test_energy_falls_from_wherever_a_neck_is_let_go(name: str) -> None:
    neck = quiet(name)
    drive = neck.numbers()["drive"].copy()
    drive[1] = 0.0  # the speed limit
    block = quiet(name, drive=tuple(drive), **COUNTED.get(name, {})).block()
    measure, u = load_functions(neck.runtime, compiled=False).energy, inputs(1, (0.0, 0.0, 0.0))[0]
    at = getattr(import_module(neck.runtime), f"{name.capitalize()}State").parts(ForeignArrays(block.arrays))
    for seed in range(3):
        rng, state = np.random.default_rng(seed), block.initial_state()
        for part, size in MOVED[name].items():
            state.values[at[part]] += size * rng.uniform(-1.0, 1.0, state.values[at[part]].size)
        E = [measure(state.parameters, state.values, u)]
        for _ in range(25):
            state, _ = block.step(state, u)
            E.append(measure(state.parameters, state.values, u))
        # As above.
        assert np.diff(E).max() < 1e-3 * (E[0] - E[-1])


@pytest.mark.parametrize("name", SOME)
def test_energy_is_stationary_where_a_neck_stands(name: str) -> None:
    neck = quiet(name)
    drive = neck.numbers()["drive"].copy()
    drive[1] = 0.0  # the speed limit
    block = quiet(name, drive=tuple(drive), **WITHOUT_HYSTERESIS.get(name, {})).block()
    u = inputs(1, (0.0, 0.0, 0.0), 0.3)[0]
    u[6:] = 0.2, -0.1  # the base leans
    state, _ = block.run(block.initial_state(), np.tile(u, (500, 1)))
    measure = load_functions(neck.runtime, compiled=False).energy
    at = getattr(import_module(neck.runtime), f"{name.capitalize()}State").parts(ForeignArrays(block.arrays))
    places = [i for part in (*MOVED[name], "s") for i in range(at[part].start, at[part].stop)]
    for place in places:
        energies = []
        for sign in (1.0, -1.0):
            moved = state.values.copy()
            moved[place] += sign * 1e-5
            energies.append(measure(state.parameters, moved, u))
        # It still creeps by some 1e-4 rad/s against its dashpots; the weight alone turns it by some 0.05 N m.
        assert abs(energies[0] - energies[1]) / 2e-5 < 5e-4


@pytest.mark.parametrize("name", slow_but(sorted({*NECKS} - {"chain"}), QUICK))  # whose turns and energy tell
def test_tendons_pull_along_the_gradient_of_their_length(name: str) -> None:
    neck = quiet(name)
    block, runtime = neck.block(), load_functions(neck.runtime, compiled=False)
    tendon = getattr(runtime, f"{name}_tendon")
    state = block.initial_state()
    at = getattr(import_module(neck.runtime), f"{name.capitalize()}State").parts(ForeignArrays(block.arrays))
    places = [i for part in (*MOVED[name], "s") for i in range(at[part].start, at[part].stop)]
    x = state.values
    x[places] += np.random.default_rng(0).uniform(-0.1, 0.1, len(places)) * [*[1.0] * (len(places) - 1), 0.1]
    for i in range(3):
        gradient = tendon(state.parameters, x, i)[1:]
        for place, slope in zip(places, gradient, strict=True):
            lengths = []
            for sign in (1.0, -1.0):
                moved = x.copy()
                moved[place] += sign * 1e-6
                lengths.append(tendon(state.parameters, moved, i)[0])
            # Rounding of 0.1 m over 2e-6.
            assert abs((lengths[0] - lengths[1]) / 2e-6 - slope) < 1e-9


@pytest.mark.parametrize("name", slow_but(sorted(WITHOUT_HYSTERESIS), ["foam"]))
def test_hysteresis_lags_and_never_leads(name: str) -> None:
    def gap(neck: ForeignNeck) -> float:
        U = np.zeros((2000, 8))
        theta = 2.0 * np.sin(2 * np.pi * np.arange(2000) / 1000)
        U[:, :3] = theta[:, None] * np.array([2.0, -1.0, -1.0]) / 3.0
        block = neck.block()
        Y = np.degrees(block.run(block.initial_state(), U)[1])
        return float(Y[1499, 0] - Y[1999, 0])  # theta is 0, on the way down and up

    with_it, without = gap(quiet(name)), gap(quiet(name, **WITHOUT_HYSTERESIS[name]))
    # Viscosity and creep lag too; a torque of the wrong sign would take from that.
    assert with_it > without + 0.1 > 0.1


@pytest.mark.parametrize("name", SOME)
def test_slack_tendons_pull_nothing(name: str) -> None:
    block = quiet(name, **UNWORN.get(name, {})).block()
    slack, Y = block.run(block.initial_state(), inputs(100, (-5.0, -5.0, -5.0)))
    assert not Y[-1, TENSIONS].any()
    _, still = block.run(slack, inputs(50, (-5.0, -5.0, -5.0)))
    _, moved = block.run(slack, inputs(50, (-4.0, -5.5, -5.0)))
    assert not moved[:, TENSIONS].any()
    assert (moved[:, 7] != still[:, 7]).any()
    # To the bit: nothing but tension couples a winch to the body.
    np.testing.assert_array_equal(moved[:, [0, 1, COMPRESSION]], still[:, [0, 1, COMPRESSION]])


@pytest.mark.parametrize("payload", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("name", SOME)
def test_payloads_to_1_kg_stay_finite_and_tendons_never_push(name: str, payload: float) -> None:
    U = np.zeros((250, 8))
    U[:, :3], U[:, 3] = signal("eq22", duration=5.0).set_points * 1.5, payload
    for seed in (0, 1):
        block = quiet(name, seed=seed).block()
        _, Y = block.run(block.initial_state(), U)
        assert np.isfinite(Y).all()
        assert Y[:, TENSIONS].min() >= 0.0
        assert np.degrees(np.abs(Y[:, PITCH])).max() < 70.0
        assert Y[:, COMPRESSION].max() < 0.06


def moves() -> np.ndarray:
    t = np.arange(150) * SAMPLE_TIME
    return np.column_stack([1.5 * np.sin(w * t + f) for w, f in ((1.1, 0.0), (2.3, 1.0), (3.1, 2.0))])


@pytest.mark.parametrize("name", ["chain", "foam"])
def test_a_third_of_a_turn_turns_the_answer(name: str) -> None:
    block = quiet(name).block()
    U = np.zeros((150, 8))
    U[:, :3] = moves()
    _, here = block.run(block.initial_state(), U)
    U[:, :3] = np.roll(moves(), 1, axis=1)
    _, there = block.run(block.initial_state(), U)
    turn = np.array([[np.cos(a := 2 * np.pi / 3), -np.sin(a)], [np.sin(a), np.cos(a)]])
    # Tangents are the normal over its third part. Rounding, grown where tendons fall slack.
    np.testing.assert_allclose(np.tan(here[:, PITCH]) @ turn.T, np.tan(there[:, PITCH]), atol=1e-8)
    np.testing.assert_allclose(np.roll(here[:, TENSIONS], 1, axis=1), there[:, TENSIONS], atol=1e-6)


def test_the_column_in_a_mirror() -> None:
    block = quiet("column").block()
    U = np.zeros((150, 8))
    U[:, :3] = moves()
    _, here = block.run(block.initial_state(), U)
    U[:, :3] = moves()[:, [0, 2, 1]]
    _, there = block.run(block.initial_state(), U)
    # Rounding, grown where tendons fall slack.
    np.testing.assert_allclose(here[:, PITCH] * [1, -1], there[:, PITCH], atol=1e-8)


@pytest.mark.parametrize("name", slow_but(sorted({*NECKS} - {"chain", "foam"}), QUICK))
def test_the_others_have_no_symmetry_of_a_third_of_a_turn(name: str) -> None:
    block = quiet(name).block()
    bends = []
    for motor in range(3):
        _, Y = block.run(block.initial_state(), inputs(150, tuple(np.eye(3)[motor] * 3.0)))
        bends.append(float(np.hypot(*np.degrees(Y[-1, PITCH]))))
    assert np.ptp(bends) > 0.1


@pytest.mark.parametrize("name", SOME)
def test_seeds_give_the_same_bits_and_others_do_not(name: str) -> None:
    U = inputs(80, (1.5, 0.0, -1.0))

    def run(seed: int, noise: int) -> np.ndarray:
        block = ForeignNeck(name=name, seed=seed).block(noise_seed=noise)
        return block.run(block.initial_state(), U)[1]

    first, again, specimen, noisy = run(0, 5), run(0, 5), run(1, 5), run(0, 6)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first[:, PITCH], noisy[:, PITCH])
    assert (first[:, 2] != noisy[:, 2]).mean() > 0.5
    assert np.degrees(np.abs(first[-1, PITCH] - specimen[-1, PITCH])).max() > 0.05


@pytest.mark.parametrize("name", SOME)
def test_plain_python_steps_as_the_compiled_one(name: str) -> None:
    block = ForeignNeck(name=name).block()
    state, _ = block.run(block.initial_state(), inputs(30, (2.0, -1.0, 0.5)))
    plain, x, y = load_runtime(block.runtime, compiled=False), state.values.copy(), np.zeros(14)
    u = inputs(1, (-1.0, 2.0, 0.5))[0]
    for _ in range(3):
        plain.step(block.arrays, state.parameters, x, u, y)
        state, compiled = block.step(state, u)
        # Compilers order sums and contract products as they like.
        np.testing.assert_allclose(y, compiled, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", SOME)
def test_a_held_neck_creeps(name: str) -> None:
    block = quiet(name).block()
    _, Y = block.run(block.initial_state(), inputs(1500, (3.0, 0.0, 0.0)))
    lean = np.degrees(np.hypot(Y[:, 0] - Y[0, 0], Y[:, 1] - Y[0, 1]))
    # From the third second, when all drives have arrived, to the thirtieth.
    assert 0.05 < lean[-1] - lean[150] < 3.0


@pytest.mark.parametrize("name", SOME)
def test_a_warm_neck_is_another(name: str) -> None:
    t = np.arange(200) * SAMPLE_TIME
    excitation = Excitation("steps", t, np.where(t < 2.0, 0.3, 1.0)[:, None] * np.array([1.0, -0.5, 0.2]))
    cold, warm = (record(excitation, quiet(name), warm=seconds) for seconds in (0.0, 60.0))
    assert np.degrees(np.abs(cold.outputs - warm.outputs)).max() > 0.05


@pytest.mark.parametrize("name", SOME)
def test_ports_and_recordings_are_those_of_the_virtual_neck(name: str) -> None:
    ours, excitation = VirtualNeck(NeckParameters.paper()), signal("eq22", duration=1.0)
    block, like = ForeignNeck(name=name).block(), ours.block()
    assert [port.name for port in block.inputs] == [port.name for port in like.inputs]
    assert [port.name for port in block.outputs] == [port.name for port in like.outputs]
    recording = record(excitation, ForeignNeck(name=name), payload=0.5)
    other = softneck.record(excitation, ours, payload=0.5)
    assert set(recording.channels) == set(other.channels)
    assert all(np.isfinite(channel).all() for channel in recording.channels.values())


@pytest.mark.parametrize("name", SOME)
def test_a_plant_names_its_numbers_in_the_runtimes_order(name: str) -> None:
    neck = quiet(name)
    layout = getattr(import_module(neck.runtime), f"{name.capitalize()}Numbers")
    lengths = {part: at.stop - at.start for part, at in layout.parts(ForeignArrays(neck.block().arrays)).items()}
    assert lengths == {"noise_seed": 1, **{number: values.size for number, values in neck.numbers().items()}}
    assert list(lengths) == ["noise_seed", *neck.numbers()]


def preisach_means(turns: list[float]) -> np.ndarray:
    """The relays' mean along a slope that goes from turn to turn in steps of 0.005 rad, with its slope (rows, 2)."""
    runtime, block = load_functions(quiet("beam").runtime, compiled=False), quiet("beam").block()
    start = block.initial_state()
    p, x = start.parameters, np.zeros(start.values.size)
    at = BeamState.parts(ForeignArrays(block.arrays))
    runtime.beam_relays(p, x)
    rows = []
    for here, there in pairwise(turns):
        for slope in np.linspace(here, there, 1 + round(abs(there - here) / 0.005)):
            x[at["t"].start] = slope
            runtime.beam_switch(p, x, 0)
            rows.append((slope, x[at["m"].start]))
    return np.array(rows)


def test_the_relays_of_the_beam_forget_what_larger_turns_wipe_out_and_closed_loops_cost_energy() -> None:
    # Where they meet, a loop inside a larger turn is gone (Mayergoyz 1991, sec. 1.2).
    once, nested = preisach_means([0.0, 0.3, -0.3, 0.3]), preisach_means([0.0, 0.3, -0.3, 0.1, -0.1, 0.3])
    assert once[-1, 1] == nested[-1, 1]
    outer = once[61:]
    # Work on the neck over the closed loop, the integral of m dt: the relays take it out.
    assert np.sum(outer[1:, 1] * np.diff(outer[:, 0])) < -0.01
    assert np.abs(once[:, 1]).max() <= 1.0 + 1e-12
