"""Training over windows of free run: exact sensitivities, Ctrl-C, the hold-out, bounded free runs."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError
from softneck.identification import Model, Network
from softneck.identification.models._drive import fit_correction
from softneck.identification.networks._network import INTERRUPTED
from softneck.identification.networks._nn_training import axis_data, jacobian, levenberg, random_layers
from softneck.runtime import load_functions

from ...data import neck_recording, short_neck

FUNCTIONS = load_functions("softneck.identification.networks._nn_fit_runtime")
RNG = np.random.default_rng(5)
NET = random_layers(4, (5, 3), RNG)
Z = RNG.standard_normal((24, 4))
# Two past outputs are fed back, the second from three samples before.
LAGS, SHIFT, GAIN = np.array([1, 3]), np.array([0.2, -0.1]), np.array([0.7, 0.4])
NAN = np.nan


def free_run(w: np.ndarray, starts: np.ndarray) -> np.ndarray:
    y = np.empty(len(Z))
    FUNCTIONS.nn_free(w, 5, 3, Z, LAGS, starts, SHIFT, GAIN, y)
    return y


def starts(*at: int) -> np.ndarray:
    values = np.full((len(Z), 2), NAN)
    for k in at:
        values[k, 0], values[k : k + 3, 1] = 0.3, 0.3
    return values


def test_windows_of_one_step_are_the_network_on_measured_outputs() -> None:
    y = free_run(NET.vector(), np.full((len(Z), 2), 0.3))
    given = Z.copy()
    given[:, :2] = SHIFT + GAIN * 0.3
    # The same sums in another order.
    np.testing.assert_allclose(y, NET.output(given), rtol=0, atol=1e-13)
    J, again = np.empty((len(Z), NET.vector().size)), np.empty(len(Z))
    FUNCTIONS.nn_sensitivities(NET.vector(), 5, 3, Z, LAGS, np.full((len(Z), 2), 0.3), SHIFT, GAIN, 1, again, J)
    alone = np.empty_like(J)
    jacobian(NET, given, alone)
    np.testing.assert_allclose(J, alone, rtol=0, atol=1e-13)


def test_the_sensitivities_of_a_free_run_are_central_differences() -> None:
    w, h, begin = NET.vector(), 1e-5, starts(0, 10)
    J, y = np.empty((8, w.size)), np.empty(len(Z))
    FUNCTIONS.nn_sensitivities(w, 5, 3, Z, LAGS, begin, SHIFT, GAIN, 3, y, J)
    np.testing.assert_array_equal(y, free_run(w, begin))
    numeric = np.column_stack(
        [(free_run(w + h * e, begin) - free_run(w - h * e, begin))[::3] / (2 * h) for e in np.eye(w.size)]
    )
    # h^2 times third derivatives of order ten along 14 steps, beside eps/h: 1e-9 and 2e-11.
    np.testing.assert_allclose(J, numeric, rtol=0, atol=1e-7)


def test_a_step_into_the_void_is_shortened() -> None:
    def errors(w: np.ndarray, J: np.ndarray | None) -> np.ndarray:
        if J is not None:
            J[:, 0] = -1.0 / w
        # log of a negative number is NaN, where the first full step leads.
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.log(w) - 3.0

    # d(errors)/dw = 1/w, and `errors` hands out the derivatives of what was subtracted: the negative.
    w = levenberg(errors, np.array([100.0]), np.ones(1), iterations=60, decay=1e-12, on_step=lambda _w, _c: True)
    assert w[0] == pytest.approx(np.exp(3.0), rel=1e-6)


def test_steps_in_single_precision_end_where_the_slope_is_zero_in_double() -> None:
    rng = np.random.default_rng(3)
    X, target, decay = rng.standard_normal((60, 20)), 7.0 * rng.standard_normal(60), 0.03
    # A weight of 0 leaves a row out, sqrt(2) counts it twice.
    weight = np.sqrt(np.arange(60) % 3)

    def errors(w: np.ndarray, J: np.ndarray | None) -> np.ndarray:
        if J is not None:
            J[:] = X
        return target - X @ w

    w = levenberg(errors, np.zeros(20), weight, iterations=60, decay=decay, on_step=lambda _w, _c: True)
    rows = np.repeat(np.arange(60), np.arange(60) % 3)
    # A step leaves about 1e-7 of the distance, until the cost no longer falls in double precision, which is its square.
    np.testing.assert_allclose(X[rows].T @ (target - X @ w)[rows], decay * w, rtol=0, atol=1e-9)


def test_the_correction_learns_a_bias_and_leaves_white_noise_alone() -> None:
    rng = np.random.default_rng(0)
    white = rng.standard_normal(5000)
    slow = 3.0 * np.cumsum(0.05 * rng.standard_normal(5000)) + 0.1 * white
    # 0.1 costs white noise 5 %, more than 0.3 costs more than the 40 % that may be paid.
    assert fit_correction([white], 0.02)[1] <= 0.5
    assert fit_correction([slow], 0.02)[1] >= 0.4
    assert fit_correction([np.full(10, NAN)], 0.02)[0] == pytest.approx(np.exp(-0.05))


def test_ctrl_c_keeps_the_best_so_far_and_says_so() -> None:
    calls = 0

    def impatient(done: float, _what: str) -> None:
        nonlocal calls
        calls += 1
        if calls == 1:
            raise KeyboardInterrupt

    model = Network(hidden=(4, 3), iterations=100_000).fit(short_neck(), progress=impatient)
    assert model.findings["interrupted"] == INTERRUPTED
    assert np.isfinite(model.simulate(neck_recording(100))).all()
    assert "interrupted" not in Network(hidden=(3, 3), iterations=3).fit(short_neck()).findings


def test_a_fault_in_progress_ends_the_training() -> None:
    def broken(done: float, what: str) -> None:
        raise RuntimeError("no terminal")

    with pytest.raises(RuntimeError, match="no terminal"):
        Network(hidden=(4, 3), iterations=100_000).fit(short_neck(), progress=broken)


def test_the_hold_out_given_is_said_and_without_one_a_remark_is_made() -> None:
    settings = Network(hidden=(3, 3), iterations=3, starts=1, refine=0)
    assert "remark" not in settings.fit(short_neck(), hold_out=neck_recording(300, seed=8)).findings
    assert "excitation it was trained on" in settings.fit(short_neck()).findings["remark"]


def test_no_free_run_diverges_on_bounded_inputs(models: dict[str, Model]) -> None:
    arrays = models["nn"].arrays
    # tanh is bounded: the middle plus the size times the sum of the last weights, and the start's disturbance.
    reach = np.abs(arrays["w3"]).sum(axis=1) + np.abs(arrays["b3"])
    bound = np.abs(arrays["output_scale"][:, 0]) + arrays["output_scale"][:, 1] * reach
    block, rng = models["nn"].block(), np.random.default_rng(6)
    for _ in range(100):
        U = np.full((300, 8), NAN)
        U[:, :3] = np.repeat(rng.uniform(-6, 6, (30, 3)), 10, axis=0)
        y = block.run(block.initial_state(pitch_start=0.4), U)[1][:, :2]
        assert (np.abs(y) <= bound + 2.0 * (0.4 + bound)).all()


def test_runs_shorter_than_the_memory_are_refused_in_one_line() -> None:
    short = neck_recording(400).rows(0, 30)
    with pytest.raises(DataError, match=r"a network remembers 30 samples of this robot, and the longest run .* has 30"):
        axis_data(short, short.set_points, 0, np.array([[0.0, 0.0, 30.0]]), True, None)
