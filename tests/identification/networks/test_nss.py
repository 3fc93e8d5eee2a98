"""Kind `nss`: it contracts, its derivatives are exact, it starts from the linear model, and what it reaches."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.identification import INFINITE, Model, NeuralStateSpace, validate
from softneck.identification.models._directions import directions_of
from softneck.identification.models._drive import fit_loaded_drive
from softneck.identification.networks._nss_problem import FUNCTIONS, Inputs, Records, Shape, free_run
from softneck.identification.networks._nss_training import (
    BestMap,
    Contraction,
    Training,
    linear_start,
    random_start,
    whitened,
    whitening,
)
from softneck.identification.networks._state_space_network import INTERRUPTED
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import load_functions
from softneck.signals import signal

from ...data import neck_recording, short_neck

SMALL = NeuralStateSpace(order=1, neurons=2, starts=2, iterations=3)
SHAPE = Shape(3, 4, 2, 2)
MAP = Contraction(3, 2, 0.98)
ONES = np.array([0.3])


def step(arrays: dict[str, np.ndarray], x: np.ndarray, into: np.ndarray) -> np.ndarray:
    t = np.zeros(len(into))
    for i in range(t.size):
        t[i] = np.tanh(arrays["F"][i] @ x + arrays["D"][i] @ t + into[i])
    return arrays["A"] @ x + arrays["E"] @ t


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_any_parameters_give_a_map_that_contracts(size: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        theta = size * rng.standard_normal(MAP.size)
        arrays, (H, M) = MAP.matrices(theta), MAP._blocks(theta)
        # The metric in which distances fall: M' H33^-1 M.
        W = M.T @ np.linalg.solve(H[-MAP.states :, -MAP.states :], M)
        for _ in range(5):
            a, b, into = rng.standard_normal(3), rng.standard_normal(3), 3.0 * rng.standard_normal(2)
            before, after = a - b, step(arrays, a, into) - step(arrays, b, into)
            # Rounding of a metric whose condition is up to 1e6.
            assert after @ W @ after <= MAP.rate**2 * (before @ W @ before) * (1.0 + 1e-8)


@pytest.mark.parametrize("sample_time", [0.02, 0.05, 0.3, 1.5])
def test_a_start_has_room_for_neurons_however_long_the_samples_are(sample_time: float) -> None:
    """Robots sampled every tenth of their time constant had none, and ended in an error of Cholesky."""
    rng, rate = np.random.default_rng(0), float(np.exp(-sample_time / 5.0))
    A = rng.standard_normal((4, 4))
    A *= 0.9999 * rate / np.linalg.norm(A, 2)
    contraction = Contraction(4, 3, rate)
    theta = contraction.start(A, rng.standard_normal((3, 4)))
    # Rounding of a Cholesky factor and back.
    np.testing.assert_allclose(contraction.matrices(theta)["A"], A, rtol=0, atol=1e-12)


def test_the_derivatives_of_the_contraction_are_central_differences() -> None:
    theta, h = np.random.default_rng(1).standard_normal(MAP.size), 1e-6
    exact = MAP.derivatives(theta)
    for name, values in exact.items():
        ends = [(MAP.matrices(theta + h * e)[name], MAP.matrices(theta - h * e)[name]) for e in np.eye(MAP.size)]
        numeric = np.array([(up - down) / (2 * h) for up, down in ends])
        # h^2 times third derivatives of order 1e2, beside eps/h.
        np.testing.assert_allclose(values, numeric, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("rate", "norm"), [(0.98, 0.9), (0.9, 0.89)], ids=["usual", "norm close to the rate"])
def test_a_start_is_the_matrix_it_was_given_with_neurons_that_do_nothing(rate: float, norm: float) -> None:
    rng, contraction = np.random.default_rng(2), Contraction(3, 2, rate)
    A = rng.standard_normal((3, 3))
    A *= norm / np.linalg.norm(A, 2)
    F = rng.standard_normal((2, 3))
    arrays = contraction.matrices(contraction.start(A, F))
    # H is factored and multiplied out again; its smallest eigenvalues are 1e-2.
    np.testing.assert_allclose(arrays["A"], A, rtol=0, atol=1e-12)
    np.testing.assert_allclose(arrays["F"], F, rtol=0, atol=1e-12)
    np.testing.assert_allclose(arrays["E"], 0.0, rtol=0, atol=1e-12)


def test_whitened_states_have_unit_covariance_and_a_norm_below_the_rate() -> None:
    rng = np.random.default_rng(3)
    A = np.array([[0.9, 0.3], [0.0, 0.7]])
    x, X = np.zeros(2), np.empty((100_000, 2))
    for k, e in enumerate(rng.standard_normal(X.shape)):
        x = A @ x + e
        X[k] = x
    T = whitening(A, np.cov(X.T), 0.996)
    # A sample covariance of 100,000 correlated samples: about 1 %.
    np.testing.assert_allclose(np.cov(np.linalg.solve(T, X.T)), np.eye(2), rtol=0, atol=0.03)
    assert np.linalg.norm(np.linalg.solve(T, A @ T), 2) < 0.996
    # A covariance that no noise explains is changed until A contracts.
    odd = whitening(A, np.diag([1.0, 1e-3]), 0.996)
    assert np.linalg.norm(np.linalg.solve(odd, A @ odd), 2) < 0.996


def problem() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    w = 0.4 * rng.standard_normal(SHAPE.vector_size)
    V, states = rng.standard_normal((40, 4)), rng.standard_normal((40, 3))
    begin = np.zeros(40, dtype=np.int64)
    begin[[0, 25]], begin[[10, 15]] = 1, 2
    return w, V, begin, states


GAIN = 0.3 * np.random.default_rng(7).standard_normal((3, 2))
UNTOLD = np.full((40, 2), np.nan)
# Told both outputs for a while, then one of them.
TOLD = UNTOLD.copy()
TOLD[25:30], TOLD[30:35, 1] = 0.4, -0.2


def run(
    w: np.ndarray, V: np.ndarray, begin: np.ndarray, states: np.ndarray, told: np.ndarray, *, compiled: bool = True
) -> np.ndarray:
    Y, seen = np.empty((len(V), 2)), np.empty((len(V), 3))
    load_functions(FUNCTIONS, compiled=compiled).nss_free(w, 3, 2, V, begin, states, GAIN, told, seen, Y)
    return Y


@pytest.mark.parametrize("told", [UNTOLD, TOLD], ids=["free", "told"])
@pytest.mark.parametrize("compiled", [True, False])
def test_the_sensitivities_of_free_runs_and_windows_are_central_differences(
    told: np.ndarray, *, compiled: bool
) -> None:
    w, V, begin, states = problem()
    w[SHAPE.vector_size - 12 : SHAPE.vector_size - 8] = [0.0, 0.0, 0.5, 0.0]  # D is strictly lower triangular
    rows = np.full(40, -1, dtype=np.int64)
    rows[::3] = np.arange(14)
    J, Y = np.empty((28, w.size)), np.empty((40, 2))
    load_functions(FUNCTIONS, compiled=compiled).nss_sensitivities(w, 3, 2, V, begin, states, GAIN, told, rows, Y, J)
    # The same sums in the same order; numba may fuse none of them.
    np.testing.assert_allclose(Y, run(w, V, begin, states, told, compiled=compiled), rtol=0, atol=1e-14)
    h = 1e-5
    numeric = np.column_stack(
        [
            (run(w + h * e, V, begin, states, told) - run(w - h * e, V, begin, states, told))[::3].ravel()
            for e in np.eye(w.size)
        ]
    ) / (2 * h)  # fmt: skip
    inside = np.ones(w.size, dtype=bool)
    inside[np.flatnonzero(np.triu(np.ones((2, 2)))) + w.size - 12] = False
    # h^2 times third derivatives of order 1e2, beside eps/h.
    np.testing.assert_allclose(J[:, inside], numeric[:, inside], rtol=0, atol=1e-7)


def test_the_chain_to_the_parameters_is_that_of_central_differences() -> None:
    records, shape, linear, gain = started(2)
    contraction = Contraction(shape.states, 2, 0.996)
    theta, base = random_start(shape.arrays(linear), shape, contraction, np.random.default_rng(5))
    theta = theta + 0.03 * np.random.default_rng(6).standard_normal(theta.size)
    training = Training(shape, contraction, gain, records, 0.1, base)
    J = np.eye(shape.vector_size)
    numeric = np.column_stack(
        [(training.weights(theta + 1e-6 * e) - training.weights(theta - 1e-6 * e)) / 2e-6 for e in np.eye(theta.size)]
    )
    # Weights of the neurons behind a small L vary fast: third derivatives of order 1e4.
    np.testing.assert_allclose(training.chained(theta, J), numeric, rtol=1e-6, atol=1e-6)


def started(neurons: int) -> tuple[Records, Shape, np.ndarray, np.ndarray]:
    recording = neck_recording(900)
    drive = fit_loaded_drive(recording)
    directions = directions_of(recording, [])
    fits, delay = linear_start(recording, drive, directions, 1)
    made = Inputs(drive, directions, directions.inputs(recording), ONES, delay)
    records = Records.of(recording, made)
    return records, *whitened(fits, records, made, neurons)


def test_training_starts_from_the_free_run_of_the_output_error_model() -> None:
    records, shape, linear, gain = started(2)
    # The neck is linear: output error on simulated motors is all but the truth.
    assert records.fit(free_run(shape, linear, records, gain)[0]) > 95.0
    contraction = Contraction(shape.states, 2, 0.996)
    theta, base = random_start(shape.arrays(linear), shape, contraction, np.random.default_rng(0))
    training = Training(shape, contraction, gain, records, 0.1, base)
    X = free_run(shape, linear, records, gain)[1][records.own]
    np.testing.assert_allclose(np.cov(X.T), np.eye(shape.states), rtol=0, atol=0.3)
    idle, _ = free_run(shape, training.weights(theta), records, gain)
    # The factor of H and back, along 900 steps of a stable map.
    np.testing.assert_allclose(idle, free_run(shape, linear, records, gain)[0], rtol=0, atol=1e-9)
    best = BestMap(records, lambda _: None, lambda: False)
    for seconds in (0.0, 0.2, None):
        training.search(theta, seconds, 2, best, "")
    assert best.fit >= records.fit(idle)


def test_training_sees_what_the_free_run_computes(models: dict[str, Model]) -> None:
    model, recording = models["nss"], short_neck()
    directions = directions_of(recording, [])
    widths, delay = model.arrays["widths"], int(model.arrays["delay"][0])
    made = Inputs(fit_loaded_drive(recording), directions, directions.inputs(recording), widths, delay)
    records = Records.of(recording, made)
    scales = records.scales
    shape = Shape(len(model.arrays["A"]), model.arrays["B"].shape[1], model.arrays["h"].size, 2)
    scaled = dict(model.arrays) | {
        "B": model.arrays["B"] * scales.inputs,
        "G": model.arrays["G"] * scales.inputs,
        "C": model.arrays["C"] / scales.outputs[:, None],
        "c": (model.arrays["c"] - scales.middle) / scales.outputs,
    }
    Y, _ = free_run(shape, shape.vector(scaled), records, np.zeros((shape.states, 2)))
    expected = np.clip(scales.middle + scales.outputs * Y, *model.arrays["range"].T)[records.own]
    free = model.simulate(recording, warm_up=1)[:, :2]
    # Both starts are held for seconds, four of them in training, where the rate allows 5 s: nothing but what they
    # had forgotten by then, and the echo of the one measured sample, is left after 300 samples.
    np.testing.assert_allclose(free[300:], expected[300:], rtol=0, atol=1e-4)


def test_no_free_run_diverges_on_bounded_inputs_and_two_draw_together(models: dict[str, Model]) -> None:
    model = models["nss"]
    limits = model.arrays["range"]
    rng = np.random.default_rng(4)
    for _ in range(100):
        held = np.repeat(rng.uniform(-6, 6, (40, 3)), rng.integers(10, 30), axis=0)
        U = np.full((len(held), 8), np.nan)
        U[:, :3] = held
        block = model.block()
        y, other = (block.run(block.initial_state(pitch_start=p, roll_start=-p), U)[1][:, :2] for p in (0.5, -0.2))
        # y of the map is clipped; the echo of the start adds at most what the start was off, and dies.
        assert (y >= limits[:, 0] - 2.0).all()
        assert (y <= limits[:, 1] + 2.0).all()
        np.testing.assert_allclose(y[300:], other[300:], rtol=0, atol=1e-3)


def test_a_seed_gives_the_same_bits_and_progress_rises_to_one() -> None:
    seen: list[tuple[float, str]] = []
    first = SMALL.fit(short_neck(), progress=lambda done, what: seen.append((done, what)))
    again = SMALL.fit(short_neck())
    assert all(first.arrays[name].tobytes() == again.arrays[name].tobytes() for name in first.arrays)
    done = [part for part, _ in seen]
    assert done == sorted(done)
    assert done[-1] == 1.0


def test_ctrl_c_keeps_the_best_so_far_and_says_so() -> None:
    calls = 0

    def impatient(done: float, what: str) -> None:
        nonlocal calls
        calls += "loss" in what
        if calls == 1:
            assert "hold-out" in what
            calls += 1
            raise KeyboardInterrupt

    model = NeuralStateSpace(order=1, neurons=2, iterations=100_000).fit(short_neck(), progress=impatient)
    assert model.findings["interrupted"] == INTERRUPTED
    assert np.isfinite(model.simulate(neck_recording(100))).all()


@pytest.mark.slow
def test_the_hold_out_given_decides_and_without_one_the_model_says_so() -> None:
    assert "excitation it was trained on" in SMALL.fit(short_neck()).findings["remark"]
    assert "remark" not in SMALL.fit(short_neck(), hold_out=neck_recording(400, seed=8)).findings


def test_bad_settings_and_little_data_are_refused() -> None:
    with pytest.raises(SettingsError, match="`widths` must be positive"):
        NeuralStateSpace(widths=(-0.1,))
    with pytest.raises(SettingsError, match="`neurons` must be a whole number"):
        NeuralStateSpace(neurons=0)
    with pytest.raises(DataError, match=r"settled rows are too few for .* weights; record longer"):
        NeuralStateSpace(neurons=30).fit(neck_recording(150))


# The least of issue 7.
LEAST = {"validation": 95.0, "steps": 85.0, "sine": 85.0, "rotation": 85.0}


@pytest.mark.slow
@pytest.mark.nightly
def test_the_figures_of_the_issue_on_the_virtual_neck() -> None:
    neck = VirtualNeck(NeckParameters.paper())
    made = {n: record(signal(n), neck, seed=s) for s, n in enumerate(("eq22", "steps", "sine", "rotation"), start=1)}
    train, made["validation"] = made.pop("eq22").split(0.7)
    model = NeuralStateSpace().fit(train)
    for name, least in LEAST.items():
        judged = validate(model, made[name], horizons=(1, INFINITE))
        assert min(fit or 0.0 for fit in judged.fits[INFINITE].values()) >= least
        for axis, fit in judged.fits["1"].items():
            assert (fit or 0.0) >= 99.0
            assert (fit or 0.0) > (judged.persistence["1"][axis] or 0.0)
