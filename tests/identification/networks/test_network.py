"""The network: exact derivatives by two independent methods, training that goes down, seeds that repeat."""

from __future__ import annotations

import itertools
from dataclasses import replace

import casadi
import numpy as np
import pytest

from softneck.core import DataError, SettingsError, silent
from softneck.identification import PAPER_EQ21, Network
from softneck.identification.models._drive import fit_loaded_drive
from softneck.identification.networks._network import _hints, _Problem
from softneck.identification.networks._nn_training import Layers, jacobian, levenberg, random_layers

from ...data import neck_recording, short_neck

RNG = np.random.default_rng(0)
NET = random_layers(4, (5, 3), RNG)
Z = RNG.standard_normal((6, 4))


def casadi_output(w: casadi.SX, z: np.ndarray) -> casadi.SX:
    """The network written out in CasADi, weights in the order W1, b1, W2, b2, w3, b3, row by row."""
    W1 = casadi.reshape(w[:20], 4, 5).T
    W2 = casadi.reshape(w[25:40], 5, 3).T
    h = casadi.tanh(W1 @ z + w[20:25])
    return casadi.dot(w[43:46], casadi.tanh(W2 @ h + w[40:43])) + w[46]


def derivatives(net: Layers, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The outputs (rows,) and their derivatives by all weights (rows, weights)."""
    J = np.full((len(inputs), net.vector().size), np.nan)
    return jacobian(net, inputs, J), J


def test_the_jacobian_is_that_of_casadi() -> None:
    w = casadi.SX.sym("w", 47)
    outputs = casadi.vertcat(*[casadi_output(w, z) for z in Z])
    value, derivative = casadi.Function("f", [w], [outputs, casadi.jacobian(outputs, w)])(NET.vector())
    y, J = derivatives(NET, Z)
    # The same arithmetic in another order: tens of ulp of numbers of order one.
    np.testing.assert_allclose(y, np.array(value).ravel(), rtol=0, atol=1e-13)
    np.testing.assert_allclose(J, np.array(derivative), rtol=0, atol=1e-13)
    np.testing.assert_allclose(NET.output(Z), y, rtol=0, atol=1e-14)


def test_the_jacobian_is_that_of_central_differences() -> None:
    w, h = NET.vector(), 1e-5
    numeric = np.column_stack(
        [(NET.like(w + h * e).output(Z) - NET.like(w - h * e).output(Z)) / (2 * h) for e in np.eye(w.size)]
    )
    # h^2 times third derivatives of order one, beside eps/h: 1e-10 and 2e-11.
    np.testing.assert_allclose(derivatives(NET, Z)[1], numeric, rtol=0, atol=1e-8)


def test_weights_survive_the_vector() -> None:
    back = NET.like(NET.vector())
    assert back.vector().tobytes() == NET.vector().tobytes()
    assert isinstance(back, Layers)
    assert back.W2.shape == (3, 5)


def trained(start: Layers, inputs: np.ndarray, target: np.ndarray, iterations: int, decay: float) -> list[float]:
    """The cost after each step of a training by one-step errors."""
    costs: list[float] = []

    def errors(w: np.ndarray, J: np.ndarray | None) -> np.ndarray:
        layers = start.like(w)
        return target - (layers.output(inputs) if J is None else jacobian(layers, inputs, J))

    def seen(_: np.ndarray, cost: float) -> bool:
        costs.append(cost)
        return True

    levenberg(errors, start.vector(), np.ones(len(inputs)), iterations=iterations, decay=decay, on_step=seen)
    return costs


def test_training_goes_down_and_finds_a_network_behind_clean_data() -> None:
    rng = np.random.default_rng(3)
    inputs = rng.standard_normal((200, 4))
    target = NET.output(inputs)
    start = random_layers(4, (5, 3), rng)
    cost = trained(start, inputs, target, iterations=60, decay=1e-8)
    assert all(b < a for a, b in itertools.pairwise(cost))
    # The same shape can be matched exactly; Levenberg-Marquardt from one start comes far below 1 % of the variance.
    assert cost[-1] < 1e-2 * cost[0]


def test_a_target_that_is_not_finite_is_refused() -> None:
    with pytest.raises(DataError, match="the network's first error is not finite"):
        trained(NET, Z, np.full(6, np.inf), iterations=2, decay=1.0)


@pytest.mark.slow
def test_a_seed_gives_the_same_bits() -> None:
    first, again, other = (Network(hidden=(3, 3), iterations=3, seed=s).fit(short_neck()) for s in (1, 1, 2))
    for name in first.arrays:
        assert first.arrays[name].tobytes() == again.arrays[name].tobytes(), name
    assert first.arrays["W1"].tobytes() != other.arrays["W1"].tobytes()


def test_hints_are_learnt_by_their_weight() -> None:
    recording, settings = neck_recording(900), Network(hidden=(4, 4), starts=1, iterations=6, refine=3)
    drive = fit_loaded_drive(recording)
    hints = _hints(recording, drive)
    assert hints is not None
    # Twice what the record says: a weight of 0 cannot know it.
    hints = hints.with_channels(pitch=2.0 * hints.channels["pitch"], roll=2.0 * hints.channels["roll"])
    found = []
    for prior in (0.0, 1.0):
        problem = _Problem(recording, hints, drive, PAPER_EQ21, hints, prior, has_time_constant=True)
        found.append([axis["fit"] for axis in settings._train(problem, silent)[0]])
    # Half of it is missed without them.
    assert max(found[0]) < 60.0
    assert min(found[1]) > max(found[0]) + 5.0


def test_a_prior_leaves_the_scales_of_the_record_and_weighs_its_own_rows_alone() -> None:
    recording = short_neck()
    drive = fit_loaded_drive(recording)
    plain = _Problem(recording, recording, drive, PAPER_EQ21, None, 0.1, has_time_constant=True)
    own, *scales = plain.training(0)
    both, *same = replace(plain, hints=_hints(recording, drive)).training(0)
    rows = own.target.size
    np.testing.assert_array_equal(both.measured[:rows], own.measured)
    assert all((one == other).all() for one, other in zip(scales, same, strict=True))
    assert set(both.weight[:rows]) == {1.0}
    assert set(both.weight[rows:]) == {0.1}


def test_progress_rises_to_one() -> None:
    seen: list[float] = []
    Network(hidden=(3, 3), iterations=4).fit(short_neck(), progress=lambda done, _what: seen.append(done))
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


def test_more_weights_than_rows_and_wrong_settings_are_refused() -> None:
    with pytest.raises(DataError, match=r"147 rows are fewer than the network's 951 weights"):
        Network(hidden=(25, 25)).fit(neck_recording(150))
    with pytest.raises(SettingsError, match="`hidden` must be two numbers of neurons"):
        Network(hidden=(3,))  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="`hidden` must be a whole number"):
        Network(hidden=(3, 0))
    with pytest.raises(SettingsError, match="`decay` must be positive"):
        Network(decay=0.0)
    with pytest.raises(SettingsError, match="`prior` must be between 0 and 1"):
        Network(prior=2.0)
