"""Kind `play`: its operators, its echo, that training and free run are one, and what it reaches on the neck."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.identification import INFINITE, Model, Play, validate
from softneck.identification.models._drive import FUNCTIONS, NO_LOAD, LoadedDrive, fit_loaded_drive, fit_noise_model
from softneck.identification.structured._play import Data, PlayStructure, ridge, rising, scores, spread_of
from softneck.runtime import load_functions
from softneck.signals import Recording, redefinition_matrix
from softneck.signals.recording._channels import MOTOR_POSITIONS

from ...data import TRUTH, drive_positions, neck_recording, short_neck

EYE = np.eye(3)


def bank(motors: np.ndarray, widths: list[float], pole: float = 0.0, order: int = 1) -> np.ndarray:
    signals = np.empty((len(motors), 3 * (1 + len(widths)) * order))
    arguments = (EYE, np.array(widths, dtype=float), np.array([pole, float(order)]), motors, signals)
    load_functions(FUNCTIONS).bank_run(*arguments)
    return signals


def test_a_play_operator_is_idle_in_its_gap_and_independent_of_speed() -> None:
    v = np.concatenate([np.linspace(0, 1, 11), np.linspace(1, -1, 21)[1:], np.linspace(-1, 0, 11)[1:]])
    slow = np.repeat(v, 3)
    played = bank(np.tile(v[:, None], (1, 3)), [0.3])[1:, 1]
    # A filter with pole 0 is one sample late.
    expected, w = [], 0.0
    for x in v[:-1]:
        w = max(x - 0.3, min(x + 0.3, w))
        expected.append(w)
    np.testing.assert_allclose(played, expected, rtol=0, atol=1e-15)
    assert np.abs(played - v[:-1]).max() == pytest.approx(0.3)
    again = bank(np.tile(slow[:, None], (1, 3)), [0.3])[3::3, 1]
    np.testing.assert_allclose(again[: played.size], played, rtol=0, atol=1e-15)


def test_every_signal_of_the_bank_stays_between_its_inputs() -> None:
    rng = np.random.default_rng(0)
    motors = rng.uniform(-6, 6, (500, 3))
    signals = bank(motors, [0.1, 2.0], pole=0.8, order=4)
    for c in range(3):
        part = signals[:, 12 * c : 12 * (c + 1)]
        assert part.min() >= min(motors[:, c].min(), 0.0)
        assert part.max() <= max(motors[:, c].max(), 0.0)


def test_the_drives_of_a_neck_without_load_are_found() -> None:
    drive = fit_loaded_drive(neck_recording())
    np.testing.assert_array_equal(drive.load, NO_LOAD)
    np.testing.assert_array_equal(drive.drive[:, 1], TRUTH.drive_delay)
    # Logged without noise: least squares is exact to rounding.
    np.testing.assert_allclose(drive.drive[:, 0], TRUTH.drive_pole, rtol=0, atol=1e-9)


def test_a_drive_without_limit_is_the_plain_lag_and_one_with_it_never_leaves_its_set_points() -> None:
    u = neck_recording(400).set_points
    plain = LoadedDrive(np.column_stack([TRUTH.drive_pole, TRUTH.drive_delay]), NO_LOAD)
    # Sums in the same order but for one product: an ulp of 4 rad, carried along a stable lag.
    np.testing.assert_allclose(plain.simulate(u, u[0]), drive_positions(u), rtol=0, atol=1e-13)
    stalled = LoadedDrive(plain.drive, np.array([0.9, 0.3, 0.5, 0.2])).simulate(u, u[0])
    assert (stalled <= drive_positions(u) + 1e-12).all()
    assert (stalled >= u.min(axis=0) - 1e-12).all()
    assert (stalled <= u.max(axis=0) + 1e-12).all()


def test_the_limit_behind_stalled_drives_is_found() -> None:
    clean = neck_recording(2000)
    truth = LoadedDrive(np.column_stack([TRUTH.drive_pole, TRUTH.drive_delay]), np.array([0.95, 1.5, 0.4, -0.2]))
    positions = truth.simulate(clean.set_points, clean.set_points[0])
    found = fit_loaded_drive(clean.with_channels(**dict(zip(MOTOR_POSITIONS, positions.T, strict=True))))
    error = found.simulate(clean.set_points, clean.set_points[0]) - positions
    # A simplex of 500 evaluations ends near the truth, not at it; without a limit the error is 0.3 rad.
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_the_echo_finds_an_autoregression_and_is_always_stable() -> None:
    rng = np.random.default_rng(1)
    e = np.zeros(20_000)
    for k in range(2, e.size):
        e[k] = 1.2 * e[k - 1] - 0.4 * e[k - 2] + rng.standard_normal()
    # Standard error of an AR coefficient at 20,000 samples: below 0.007; five of those.
    np.testing.assert_allclose(fit_noise_model([e], 2), [1.2, -0.4], rtol=0, atol=0.035)
    holes = np.where(rng.random(300) < 0.4, np.nan, np.linspace(0, 1, 300) ** 3)
    c = fit_noise_model([holes, np.full(50, np.nan)], 6)
    assert np.abs(np.roots(np.concatenate([[1.0], -c]))).max() < 1.0
    np.testing.assert_array_equal(fit_noise_model([np.zeros(100)], 3), np.zeros(3))


def test_an_echo_for_larger_errors_follows_them_more_closely_and_is_as_stable() -> None:
    rng = np.random.default_rng(8)
    smooth = np.zeros(20_000)
    for k in range(2, smooth.size):
        smooth[k] = 1.8 * smooth[k - 1] - 0.81 * smooth[k - 2] + 0.05 * rng.standard_normal()
    noise = rng.standard_normal(smooth.size)
    plain, bold = (fit_noise_model([smooth + noise], 8, beyond=factor) for factor in (1.0, 3.0))

    def left(c: np.ndarray, size: float) -> float:
        e = size * smooth + noise
        return float(np.mean((e[8:] - sum(c[i] * e[7 - i : e.size - 1 - i] for i in range(8))) ** 2))

    # Each is the better one where its errors are.
    assert left(plain, 1.0) < left(bold, 1.0)
    assert left(bold, 3.0) < left(plain, 3.0)
    # It is the echo that larger errors would have given, but for the noise's estimate from three lags.
    assert left(bold, 3.0) < 1.05 * left(fit_noise_model([3.0 * smooth + noise], 8), 3.0)
    assert np.abs(np.roots(np.concatenate([[1.0], -bold]))).max() < 1.0


def test_ridge_without_weight_is_least_squares_and_a_heavy_one_is_the_mean() -> None:
    rng = np.random.default_rng(2)
    X = np.column_stack([np.ones(200), rng.standard_normal((200, 4)) + 3.0])
    Y = X @ rng.standard_normal((5, 2)) + 0.1 * rng.standard_normal((200, 2))
    # The jitter of 1e-12 beside eigenvalues of order one.
    np.testing.assert_allclose(ridge(X, Y, 0.0).T, np.linalg.lstsq(X, Y)[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(X @ ridge(X, Y, 1e9).T, np.tile(Y.mean(axis=0), (200, 1)), rtol=0, atol=1e-6)


def shares(weights: np.ndarray, form: PlayStructure) -> np.ndarray:
    """The static gain of each chain over that of its input (outputs, inputs, chains)."""
    sums = np.moveaxis(form.chains @ weights.T, -1, 0)
    return sums / sums.sum(axis=-1, keepdims=True)


def test_the_spread_of_a_ridge_is_the_covariance_of_its_weights() -> None:
    rng = np.random.default_rng(5)
    X = np.column_stack([np.ones(300), rng.standard_normal((300, 3)) @ rng.standard_normal((3, 3)) + 2.0])
    truth = X @ rng.standard_normal((4, 1))
    found = ridge(X, truth + rng.standard_normal((300, 4000)), 0.0)
    # 4,000 draws tell a covariance to 1 / sqrt(2000) = 2 % of the variances; the largest of 16 by four of these.
    scale = np.sqrt(np.diag(spread_of(X, 0.0)))
    np.testing.assert_allclose(
        np.cov(found.T) / np.outer(scale, scale), spread_of(X, 0.0) / np.outer(scale, scale), atol=0.09
    )


def test_weights_rise_with_every_chain_and_are_the_nearest_that_do() -> None:
    rng, form = np.random.default_rng(3), PlayStructure(15.0, 2, (0.3, 0.9), 2, inputs=2, tilts=2)
    n = len(form.table)
    assert form.chains.sum() == 2 * 3 * 2, "each linear term is of one chain"
    root = rng.standard_normal((n, n))
    spread, moved = root @ root.T + 0.1 * np.eye(n), 0
    for W in rng.standard_normal((200, 1, n)):
        found = rising(W, spread, form.chains)
        if (shares(W, form) >= 0.0).all():
            np.testing.assert_array_equal(found, W)
            continue
        # What is held has a share of rounding alone.
        assert (shares(found, form) > -1e-9).all()
        held = form.chains[np.abs(form.chains @ found[0]) < 1e-9].astype(float)
        # The nearest with these chains at zero, in the null space of their sums.
        free = np.linalg.svd(held)[2][len(held) :].T
        metric = np.linalg.inv(spread)
        expected = free @ np.linalg.solve(free.T @ metric @ free, free.T @ metric @ W[0])
        np.testing.assert_allclose(found[0], expected, rtol=1e-6, atol=1e-9)
        moved += 1
    assert moved > 50


def test_a_backlash_wider_than_the_plays_has_no_small_gain_of_the_other_sign() -> None:
    """Less of the input and more of a narrow play is a wider play: a loop with an integrator would swing within it."""
    rng, widths = np.random.default_rng(1), (0.3,)
    v = np.cumsum(0.05 * rng.choice([-1.0, 1.0], 200).repeat(20))
    v = 3.0 * np.sin(0.8 * v)
    form = PlayStructure(15.0, 2, widths, 1, inputs=1, tilts=1)
    wide = bank(np.tile(v[:, None], (1, 3)), [0.6])[:, 1]
    data = Data([v[:, None]], [v[:, None]], wide[:, None], np.arange(v.size) > 50, [], 0.02, np.ones((1, 1)))
    X = data.terms(form)[data.settled]
    plain = ridge(X, data.outputs[data.settled], 1e-6)
    assert shares(plain, form).min() < -0.1, "otherwise this tells nothing"
    assert shares(ridge(X, data.outputs[data.settled], 1e-6, form.chains), form).min() > -1e-9


@pytest.mark.parametrize("widths", [(), (0.3,), (0.1, 0.3, 0.9)])
@pytest.mark.parametrize("degree", [2, 3])
def test_products_are_of_what_passes_the_widest_play(widths: tuple[float, ...], degree: int) -> None:
    """A motor that moves within the gap of the widest play moves no product: the curve is behind the hysteresis."""
    form = PlayStructure(15.0, 5, widths, degree)
    # To 2 rad, back by the whole gap, then about its middle: no play is left at an edge by less than 1e-9.
    gap = 2.0 * max(widths, default=0.0)
    path = np.concatenate(
        [np.full(300, 2.0), np.full(300, 2.0 - gap / 2), 2.0 - gap / 2 + 0.4 * gap * np.sin(np.arange(300.0))]
    )
    signals = bank(np.tile(path[:, None], (1, 3)), list(widths), float(form.chain(0.02)[0]), 5)
    table = form.table.astype(int)
    products = table[(table >= 0).sum(axis=1) > 1]
    assert len(products) == 6 + 4 * (degree == 3)
    signals = np.column_stack([signals, np.ones(len(signals))])
    values = signals[590:, products[:, 0]] * signals[590:, products[:, 1]] * signals[590:, products[:, 2]]
    # Five filters of 15 1/s have forgotten a step after 5.8 s: exp(-87) of it and powers of 87 are left.
    assert np.ptp(values, axis=0).max() < 1e-9
    if widths:
        assert np.ptp(signals[590:, 4]) > 1e-3  # the plain chain moves


def test_training_sees_what_the_free_run_computes() -> None:
    recording = short_neck()
    model = Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4).fit(recording)
    drive = LoadedDrive(model.arrays["drive"], model.arrays["load"])
    terms = Data.of(recording, drive, redefinition_matrix()).terms(PlayStructure(15.0, 5, (0.2,), 3))
    f = np.clip(terms @ model.arrays["weights"].T, *model.arrays["range"].T)
    free = model.simulate(recording, warm_up=1)[:, :2]
    # The echo of the one measured sample and its motors has died out after 200 samples.
    np.testing.assert_allclose(free[200:], f[200:], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_model_is_found_behind_clean_data() -> None:
    train, test = neck_recording(2400, noise=1e-4), neck_recording(1000, seed=9, noise=1e-4)
    fits = validate(Play().fit(train), test, horizons=(1, INFINITE)).fits
    # The truth is a lag with dead time; five filters approach it.
    assert min(fit or 0.0 for fit in fits[INFINITE].values()) > 97.0


def test_no_free_run_diverges_on_bounded_inputs() -> None:
    model = Play().fit(short_neck())
    limits = model.arrays["range"]
    rng = np.random.default_rng(4)
    for _ in range(100):
        held = np.repeat(rng.uniform(-6, 6, (40, 3)), rng.integers(1, 12), axis=0)
        U = np.full((len(held), 8), np.nan)
        U[:, :3] = held
        start = model.block().initial_state(pitch_start=0.5, roll_start=-0.5)
        y = model.block().run(start, U)[1][:, :2]
        # f is clipped; the echo of the start adds at most what the start was off, and dies.
        assert (y >= limits[:, 0] - 2.0).all()
        assert (y <= limits[:, 1] + 2.0).all()


def test_bad_settings_and_little_data_are_refused() -> None:
    with pytest.raises(SettingsError, match="`widths` must be positive"):
        Play(widths=(0.1, -0.2))
    with pytest.raises(SettingsError, match="`degree` must be a whole number"):
        Play(degree=4)
    with pytest.raises(DataError, match="are too few for 466 terms; record longer"):
        Play(order=31, widths=(0.1, 0.2, 0.3, 0.4), degree=1).fit(neck_recording(400))


def test_of_a_few_seconds_rows_are_held_out_too() -> None:
    """A fifth of 5 s is fewer than the rows that are asked for elsewhere: a mean of nothing chose between forms."""
    data = Data.of(recording := neck_recording(250), fit_loaded_drive(recording), redefinition_matrix())
    assert np.isfinite(scores(data, None, PlayStructure(15.0, 5, (0.2,), 2), (1e-3,))).all()


def test_the_hold_out_given_decides_and_without_one_the_model_says_so() -> None:
    recording = short_neck()
    assert "excitation it was trained on" in Play(widths=()).fit(recording).findings["remark"]
    assert "remark" not in Play(widths=()).fit(recording, hold_out=neck_recording(400, seed=8)).findings


# Measured: 97.9/97.4, 93.9/92.3, 97.6/97.3, 98.3/98.6; the least of issue 7.
LEAST = {"validation": 95.0, "steps": 85.0, "sine": 85.0, "rotation": 85.0}


@pytest.fixture(scope="module")
def model(recordings: dict[str, Recording]) -> Model:
    return Play().fit(recordings["train"])


@pytest.mark.slow
@pytest.mark.parametrize("name", LEAST)
def test_the_figures_of_the_issue_on_the_virtual_neck(
    recordings: dict[str, Recording], model: Model, name: str
) -> None:
    judged = validate(model, recordings[name], horizons=(1, INFINITE))
    assert min(fit or 0.0 for fit in judged.fits[INFINITE].values()) >= LEAST[name]
    for axis, fit in judged.fits["1"].items():
        assert (fit or 0.0) >= 99.0
        assert (fit or 0.0) > (judged.persistence["1"][axis] or 0.0)
