"""Set membership against a literal transcription of the paper's Algorithm 1."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from softneck.core import DataError, SettingsError
from softneck.identification import PAPER_EQ21, Model, OutputError, SetMembership, is_extrapolating
from softneck.identification.models._regressors import regression
from softneck.identification.set_membership._regressor import (
    LEAF,
    all_pairs_gammas,
    is_frame,
    least_gammas,
    slant_frames,
    slant_nodes,
    slant_order,
    tree_nodes,
    tree_order,
    usual_width,
)
from softneck.identification.set_membership._set_membership import noise_level
from softneck.robot import Robot
from softneck.runtime import load_functions
from softneck.signals import Recording

from ...data import TS, neck_recording, recording_from, short_neck
from .hard_sets import algorithm_1, hard_sets

BOUNDS = load_functions("softneck.identification.set_membership._nlsm_runtime")
SLANT = load_functions("softneck.identification.set_membership._principal_tree_runtime")


@st.composite
def data_sets(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Small integers half of the time, so that ties and equal points are common."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    shape = (draw(st.integers(1, 30)), draw(st.integers(1, 4)))
    if draw(st.booleans()):
        return rng.integers(-2, 3, shape).astype(float), rng.integers(-2, 3, shape[0]).astype(float)
    return rng.standard_normal(shape), rng.standard_normal(shape[0])


@given(data=data_sets(), gamma=st.sampled_from([0.0, 0.1, 1.0, 7.0]), epsilon=st.sampled_from([0.0, 0.05, 1.0]))
def test_the_bounds_are_those_of_algorithm_1(data: tuple[np.ndarray, np.ndarray], gamma: float, epsilon: float) -> None:
    omega, y = data
    points = np.ascontiguousarray(omega.T)
    for x in (omega[0], omega.mean(axis=0), omega[-1] + 0.3):
        expected = algorithm_1(x, omega, y, gamma, epsilon)
        # Sums of four squares in one order or another: a few ulp of numbers of order ten.
        np.testing.assert_allclose(BOUNDS.nlsm_bounds(points, y, gamma, epsilon, x), expected, rtol=0, atol=1e-12)


def in_tree_order(omega: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    order = tree_order(np.ascontiguousarray(omega.T))
    points = np.ascontiguousarray(omega[order].T)
    return points, y[order], tree_nodes(points, y[order])


@given(data=hard_sets(), slope=st.sampled_from([0.0, 0.1, 1.0, 50.0]), epsilon=st.sampled_from([0.0, 0.05]))
def test_the_tree_gives_the_bounds_of_algorithm_1(
    data: tuple[np.ndarray, np.ndarray], slope: float, epsilon: float
) -> None:
    omega, y = data
    size = max(float(np.abs(omega).max()), 1e-300)
    gamma = slope / size
    frames, slopes = slant_frames([(np.ascontiguousarray(omega.T), y)], np.array([gamma]))
    order = slant_order(frames[0], np.ascontiguousarray(omega.T))
    points, values = np.ascontiguousarray(omega[order].T), y[order]
    nodes = slant_nodes(frames[0], slopes[0], points, values)
    assert is_frame(frames[0])
    assert 0.0 <= slopes[0] < gamma or slopes[0] == 0.0
    for x in (omega[0], omega.mean(axis=0), omega[-1] + 0.3 * size, -5.0 * omega[len(y) // 2], 1e6 * omega[-1] + size):
        x = np.ascontiguousarray(x)
        low, high = SLANT.slant_bounds(points, values, nodes, frames[0], gamma, x)
        expected = algorithm_1(x, omega, y, gamma, epsilon)
        # Squares by ** or *, roots by ** or sqrt: some ulp of cones up to 50 * 6 * sqrt(11) = 1,000.
        np.testing.assert_allclose((low - epsilon, high + epsilon), expected, rtol=1e-12, atol=1e-12)
        # And those of all points in one segment, to the bit: the tree leaves nothing out.
        best = np.array([-np.inf, np.inf])
        SLANT.slant_leaf(points, values, 0, len(y), gamma, x, np.empty(len(y)), best)
        assert tuple(best) == (low, high)
        # What moves the bounds: the cones that they are, gamma times the unit vector from the point.
        moves = np.zeros((2, x.size))
        looser = np.array([low - 1e-9 * (1.0 + abs(low)), high + 1e-9 * (1.0 + abs(high))])
        SLANT.slant_slopes(points, values, nodes, frames[0], gamma, x, looser, moves)
        distance = np.linalg.norm(points.T - x, axis=1)
        for sign, bound, moved in zip((-1.0, 1.0), (low, high), moves, strict=True):
            # Any cone that is the bound but for rounding may be the one.
            near = np.abs(values + sign * gamma * distance - bound) <= 1e-12 * (1.0 + abs(bound) + gamma * distance)
            unit = (x - points.T[near]) / np.maximum(distance[near], 1e-300)[:, None]
            assert np.abs(sign * gamma * unit - moved).max(axis=1).min() <= 1e-9 * gamma


def test_a_plane_among_the_values_is_followed_as_far_as_cones_allow() -> None:
    rng = np.random.default_rng(0)
    # Histories: two directions of width one, the others next to nothing.
    W = rng.standard_normal((2, 3000)).T @ rng.standard_normal((2, 6)) + 1e-3 * rng.standard_normal((3000, 6))
    slope = np.linalg.lstsq(W, W[:, 0] + 0.5 * W[:, 1], rcond=1e-2)[0]
    y = W @ slope + 0.01 * rng.standard_normal(3000)
    climb = float(np.linalg.norm(slope))
    data = [(np.ascontiguousarray(W.T), y)]
    frames, slopes = slant_frames(data, np.array([2.0 * climb]))
    # The noise of 0.01 over 3,000 points of width one hardly turns the plane.
    assert slopes[0] == pytest.approx(climb, rel=1e-3)
    np.testing.assert_allclose(frames[0, 0], slope / climb, atol=1e-3)
    assert frames.shape == (1, 5, 6)
    # Cones flatter than every plane: there is none to follow.
    assert slant_frames(data, np.array([0.0]))[1][0] == 0.0


@given(data=hard_sets())
def test_the_leaves_hold_every_point_once_and_are_neither_full_nor_empty(data: tuple[np.ndarray, np.ndarray]) -> None:
    omega, y = data
    points, _, nodes = in_tree_order(omega, y)
    assert sorted(map(tuple, points.T)) == sorted(map(tuple, omega))
    leaves = len(nodes) // 2
    sizes = np.diff(np.arange(leaves + 1) * len(y) // leaves)
    assert sizes.max() <= LEAF
    assert leaves == 1 or sizes.min() >= LEAF // 2


@given(data=hard_sets(), slack=st.sampled_from([0.0, 0.1, 1.0]))
def test_gamma_by_branch_and_bound_is_that_of_all_pairs(data: tuple[np.ndarray, np.ndarray], slack: float) -> None:
    omega, y = data
    points, slacks = np.ascontiguousarray(omega.T), np.array([slack, 0.3, 3.0])
    if len(y) < 2:
        return
    expected = all_pairs_gammas(points, y, slacks)[0]
    got, pairs = least_gammas(points, y, slacks)
    for m in range(3):
        if expected[m] > 1e200:
            assert got[m] > 1e200
            continue
        # rise - slack cancels: an ulp of the outputs over the distance of the pair that decides.
        (j, k), spread = pairs[m], float(np.linalg.norm(omega[pairs[m, 0]] - omega[pairs[m, 1]]))
        assert got[m] == pytest.approx(expected[m], rel=1e-12, abs=1e-15 / spread if spread > 0 else 0.0)
        if got[m] > 0:
            assert abs(y[j] - y[k]) - slacks[m] == pytest.approx(got[m] * spread, rel=1e-12, abs=1e-15)


def test_gamma_falls_with_epsilon_and_is_convex_in_it() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (2, 1500))
    sigma = 0.01
    values = np.sin(points[0]) + 0.5 * points[1] + sigma * rng.standard_normal(1500)
    epsilon = np.geomspace(3e-4, 0.5, 32) * np.ptp(values)
    gamma, pairs = least_gammas(points, values, epsilon)
    assert (np.diff(gamma) <= 0).all()
    slopes = np.diff(gamma) / np.diff(epsilon)
    # A maximum of falling straight lines; 1e-9 of the steepest slope is rounding.
    assert (np.diff(slopes) >= -1e-9 * np.abs(slopes).max()).all()
    # Where the noise ends the function's own slope is left, sqrt(1 + 0.25) = 1.118.
    assert 0.9 < np.interp(5 * sigma, epsilon, gamma) < 1.5
    # The pair that decides lies on its line.
    j, k = pairs[10]
    assert abs(values[j] - values[k]) - epsilon[10] == pytest.approx(
        gamma[10] * np.linalg.norm(points[:, j] - points[:, k]), rel=1e-12
    )


def test_the_pair_that_denies_gamma_is_named() -> None:
    points = np.array([[0.0, 1.0, 2.0, 3.0]])
    values = np.array([0.0, 1.0, 4.0, 4.5])
    gamma, pairs = least_gammas(points, values, np.array([0.0, 0.5]))
    # Of samples 1 and 2: |4 - 1| <= epsilon + gamma.
    assert gamma.tolist() == [3.0, 2.5]
    assert sorted(pairs[0].tolist()) == [1, 2]


@given(data=hard_sets(least=60), slope=st.sampled_from([0.0, 0.1, 1.0, 50.0]), near=st.sampled_from([0, 1, 25]))
def test_the_usual_width_is_that_of_algorithm_1_at_rows_that_are_left_out(
    data: tuple[np.ndarray, np.ndarray], slope: float, near: int
) -> None:
    omega, y = data
    gamma = slope / max(float(np.abs(omega).max()), 1e-300)
    halves = []
    for k in range(len(y)):
        counts = np.abs(np.arange(len(y)) - k) > near
        low, high = algorithm_1(omega[k], omega[counts], y[counts], gamma, 0.0)
        halves.append(0.5 * (high - low))
    found = usual_width(np.ascontiguousarray(omega.T), y, gamma, near, 0.99)
    # Squares by ** or *, roots by ** or sqrt: some ulp of cones up to 1,000.
    assert found == pytest.approx(np.quantile(halves, 0.99), rel=1e-12, abs=1e-12)


def test_without_the_compiler_gamma_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    points, values = rng.standard_normal((4, 300)), rng.standard_normal(300)
    slacks = np.array([0.5, 0.0, 1.0])
    fast, fast_pairs = least_gammas(points, values, slacks)
    monkeypatch.setattr("softneck.identification.set_membership._regressor.have_numba", lambda: False)
    slow, slow_pairs = least_gammas(points, values, slacks)
    np.testing.assert_allclose(fast, slow, rtol=1e-12)
    np.testing.assert_array_equal(np.sort(fast_pairs), np.sort(slow_pairs))


@given(data=data_sets(), slack=st.sampled_from([0.0, 0.1, 1.0]))
def test_gamma_is_the_least_over_all_pairs(data: tuple[np.ndarray, np.ndarray], slack: float) -> None:
    omega, y = data
    least = 0.0
    for i in range(len(y)):
        for k in range(len(y)):
            rise, distance = y[i] - y[k] - slack, np.linalg.norm(omega[i] - omega[k])
            if rise > 0:
                least = max(least, rise / distance if distance > 0 else np.inf)
    got = all_pairs_gammas(np.ascontiguousarray(omega.T), y, np.array([slack]))[0][0]
    if np.isinf(least):
        assert got > 1e200
    else:
        assert got == pytest.approx(least, rel=1e-12)


def test_the_fitted_set_contains_every_point_and_gamma_is_no_larger_than_it_must_be(models: dict) -> None:
    arrays = models["nlsm"].arrays
    for axis in range(2):
        W, y = arrays["points"][axis], arrays["values"][axis]
        gamma, epsilon = arrays["bounds"][axis]
        gap = np.inf
        for i in range(y.size):
            low, high = BOUNDS.nlsm_bounds(W, y, gamma, epsilon, np.ascontiguousarray(W[:, i]))
            # f_l <= y <= f_u at every point, to rounding of y itself.
            assert low - 1e-12 <= y[i] <= high + 1e-12
            gap = min(gap, high - y[i], y[i] - low)
        # The deciding pair touches its bound; 1e-12 as above.
        assert gap == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("form", ["nlsm", "residual"])
def test_the_estimate_lies_in_the_middle_of_its_bounds(models: dict, form: str) -> None:
    Y = models[form].simulate(short_neck())[25:]
    for axis in range(2):
        low, high = Y[:, 5 + 2 * axis], Y[:, 6 + 2 * axis]
        np.testing.assert_allclose(Y[:, axis], (low + high) / 2, rtol=0, atol=1e-14)
        assert (low <= high).all()


@pytest.mark.parametrize("form", ["nlsm", "residual"])
def test_a_motion_like_the_data_is_known_and_a_wilder_one_is_not(models: dict, form: str) -> None:
    model, trained = models[form], short_neck()
    # The training data themselves are as near as can be.
    assert is_extrapolating(model, model.predict(trained)).mean() < 0.05
    wild = trained.with_channels(**{f"motor_setpoint_{j}": 3 * trained.set_points[:, j - 1] for j in (1, 2, 3)})
    assert is_extrapolating(model, model.simulate(wild)[25:]).mean() > 0.5


def test_only_set_membership_knows_what_it_has_seen(models: dict) -> None:
    with pytest.raises(SettingsError, match="only a model of kind nlsm"):
        is_extrapolating(models["rls"], np.zeros((3, 10)))
    with pytest.raises(DataError, match=r"`outputs` must be \(rows, 10\).*got \(3, 5\)"):
        is_extrapolating(models["nlsm"], np.zeros((3, 5)))


def test_the_residual_form_is_its_base_and_a_set_over_its_signals(models: dict) -> None:
    """The free run again from its parts: the base's own free run, then Algorithm 1 on it, row by row."""
    arrays, recording = models["residual"].arrays, short_neck()
    Y = models["residual"].simulate(recording, warm_up=0)
    names = ("history", "drive", "redefinition", "a", "b", "delay")
    base = Model(kind="rls", sample_time=TS, arrays={name: arrays[name] for name in names}).simulate(
        recording, warm_up=0
    )
    sources = {2: base[:, 2:5], 3: base[:, :2]}
    # The base of the residual form starts from its outputs less what the set says there: by row 200 of 500
    # a pole of 0.92 leaves 1e-7 of that.
    for k in (200, 311, 499):
        x = np.array([sources[int(s)][k - int(lag), int(c)] for s, c, lag in arrays["table"]]) * arrays["scale"]
        for axis in range(2):
            gamma, epsilon = arrays["bounds"][axis]
            bounds = algorithm_1(x, arrays["points"][axis].T, arrays["values"][axis], gamma, epsilon)
            np.testing.assert_allclose(Y[k, 5 + 2 * axis : 7 + 2 * axis], base[k, axis] + np.array(bounds), atol=1e-7)


def test_the_scale_is_of_the_lags_that_the_set_is_over() -> None:
    """It is chosen on fewer rows, which bound the lags of a slow robot: an oven's 72 s at 2 s."""
    heater = Robot.from_dict({
        "name": "oven", "motors": {"names": ["heater"], "unit": "A"},
        "outputs": {"names": ["plate"], "unit": "degC"}, "directions": {"kind": "identified"},
    })  # fmt: skip
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(0.0, 3.0, 24), 25)
    y = np.zeros_like(u)
    for k in range(1, len(u)):
        y[k] = y[k - 1] + (9.0 * u[max(k - 4, 0)] - y[k - 1]) / 36.0
    y += 0.05 * rng.standard_normal(len(y))
    recording = Recording.from_arrays(u[:, None], y[:, None], sample_time=2.0, robot=heater)
    model = SetMembership(form="residual").fit(recording)
    assert len(model.findings["scale"]) == len(model.arrays["table"])


def test_the_base_of_a_residual_has_one_pole_also_where_the_robot_resonates() -> None:
    """By itself `oe` takes two poles there, and the set's simulation has one: every kind is compared in that form."""
    robot = Robot.from_dict({
        "name": "arm", "motors": {"names": ["m"], "unit": "A"}, "outputs": {"names": ["tip"], "unit": "mm"},
        "directions": {"kind": "matrix", "matrix": [[1.0]]},
    })  # fmt: skip
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-2.0, 2.0, 60), 33)
    pole = np.exp(0.24 * (-0.003 + 1j))
    y = np.asarray(lfilter([0.0, 1e-3], np.poly([pole, pole.conj()]).real, u))
    y += 0.05 * y.std() * rng.standard_normal(y.size)
    recording = Recording.from_arrays(u[:, None], y[:, None], sample_time=0.02, robot=robot)
    assert OutputError().fit(recording).settings["nf"] == 2
    model = SetMembership(form="residual", output_weight=1.0, epsilon=5.0 * float(y.std())).fit(recording)
    assert model.arrays["a"].shape == (1, 1)
    assert np.isfinite(model.simulate(recording)).all()


def test_a_residual_cannot_drift(models: dict) -> None:
    """Wherever the free run starts, it forgets it at the base's own pace: the set feeds nothing back."""
    model, U = models["residual"], np.zeros((600, 8))
    U[:, :3], U[:, 3:] = neck_recording(600, seed=9).set_points, np.nan
    runs = [model.block().run(model.initial_state(pitch_start=p, roll_start=-p), U)[1] for p in (0.0, 0.7)]
    # A pole of 0.92 leaves 0.7 * 0.92^550 < 1e-20; the sums round.
    np.testing.assert_allclose(runs[0][-10:], runs[1][-10:], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_residual_form_is_reached_by_its_name_and_says_so(models: dict) -> None:
    assert models["residual"].kind == "nlsm"
    assert models["residual"].settings["form"] == "residual"
    assert models["nlsm"].settings["form"] == "paper_eq21"
    with pytest.raises(DataError, match="every run is too short for form `residual`"):
        SetMembership(form="residual").fit([neck_recording(78, seed=s) for s in (1, 2, 3)])


def test_the_regressor_is_eq21() -> None:
    r = neck_recording(60)
    X, target = regression(r, PAPER_EQ21, axis=1)
    y, u, M = r.outputs[:, 1], r.set_points, r.motor_positions
    for k in (3, 17, 59):
        row = [y[k - 1], u[k - 2, 0], u[k - 3, 0], u[k - 2, 1], u[k - 3, 1], u[k - 2, 2], u[k - 3, 2], *M[k - 3]]
        np.testing.assert_array_equal(X[k - 3], row)
        assert target[k - 3] == y[k]
    assert len(X) == 57


def test_no_regressor_crosses_a_run() -> None:
    from softneck.signals import concatenate

    parts = [neck_recording(60), neck_recording(50, seed=5), neck_recording(3, seed=6)]
    X, y = regression(concatenate(parts), PAPER_EQ21, 0)
    single = [regression(part, PAPER_EQ21, 0) for part in parts[:2]]
    np.testing.assert_array_equal(X, np.vstack([x for x, _ in single]))
    np.testing.assert_array_equal(y, np.concatenate([t for _, t in single]))


def test_the_noise_level_is_that_of_the_noise() -> None:
    for sigma in (1e-4, 1e-3):
        r = recording_from(np.zeros((4000, 3)), noise=sigma)
        # The median's standard error over 4,000 correlated differences is near 3 %; three of those.
        assert noise_level(r, 0) == pytest.approx(sigma, rel=0.1)


def test_an_epsilon_below_the_noise_is_refused() -> None:
    """At rest regressors repeat to the bit while the noisy output does not: no function passes both."""
    r = neck_recording(400)
    quiet = np.round(r.channels["pitch"], 2)
    quiet[1:] += np.where(np.arange(399) % 2, 0.0, 0.005)
    rest = {f"motor_{what}_{j}": np.where(np.arange(400) < 300, 0.0, r.channels[f"motor_{what}_{j}"])
            for what in ("setpoint", "position") for j in (1, 2, 3)}  # fmt: skip
    pitch = np.where(np.arange(400) < 300, np.where(np.arange(400) % 3 == 0, 0.01, 0.0), quiet)
    resting = r.with_channels(pitch=pitch, **rest)
    with pytest.raises(DataError, match=r"epsilon \[.*\] deg is below the noise: equal regressors") as caught:
        SetMembership(epsilon=1e-4, output_weight=1.0).fit(resting)
    # The two rows that it names have equal regressors and pitches as far apart as it says.
    named = re.findall(r"row (\d+) \(run (\d+), ([\d.]+) s\)", str(caught.value))
    rows = [int(row) for row, _, _ in named]
    assert [f"{resting.time[row]:.6g}" for row in rows] == [seconds for _, _, seconds in named]
    X, _ = regression(resting, PAPER_EQ21, 0)
    np.testing.assert_array_equal(X[rows[0] - 3], X[rows[1] - 3])
    assert f"differ by {np.degrees(abs(pitch[rows[0]] - pitch[rows[1]])):.4g} deg in pitch" in str(caught.value)


def test_epsilon_and_weight_are_chosen_on_the_data_and_told() -> None:
    model = SetMembership().fit(neck_recording(700))
    assert model.findings["output_weight"] in (3.0, 10.0, 30.0, 57.29577951308232)
    ratio = np.array(model.findings["epsilon_deg"]) / np.array(model.findings["noise_deg"])
    assert ratio[0] == pytest.approx(ratio[1])
    assert round(ratio[0], 9) in (3, 5, 8, 12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"epsilon": 0.0}, "`epsilon` must be positive"), ({"output_weight": -1.0}, "`output_weight` must be positive"),
     ({"form": "magic"}, "`form` must be one of paper_eq21, residual; got 'magic'")],
)  # fmt: skip
def test_wrong_settings_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        SetMembership(**settings)
