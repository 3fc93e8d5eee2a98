"""Output error: the optimum of its cost, unbiased under noise, runs apart, missed samples, and the real neck."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import control
import numpy as np
import pytest
import scipy.signal as dsp
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.signal import lfilter

from softneck.core import DataError, SettingsError, load
from softneck.identification import OutputError, Rls, choose, validate
from softneck.identification.linear._oe import fit_output_error
from softneck.identification.models._fitting import best_delay
from softneck.identification.models._linear_systems import axis_functions, continuous_parameters
from softneck.robot import Robot
from softneck.signals import Recording, concatenate, import_log, read_layout, redefine, signal

from ...data import LAYOUTS, TRUTH, TS, first_order, neck_recording, recording_from

RESONANT = ([-1.6, 0.7], [0.02, 0.03])


def simulated(a: list[float], b: list[float], d: int, rows: int, noise: float, seed: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(rows // 10 + 1), 10)[:rows]
    u[0] = 0.0
    y = lfilter([0.0] * (d + 1) + b, [1.0, *a], u)
    return u, y + noise * rng.standard_normal(rows)


@pytest.mark.parametrize(("a", "b"), [([-0.9], [0.1]), RESONANT], ids=["lag", "resonant"])
def test_a_clean_record_gives_the_system_behind_it(a: list[float], b: list[float]) -> None:
    fit = fit_output_error([simulated(a, b, 3, 800, 0.0, 0)], len(a), len(b), 3, [np.poly([0.5] * len(a))[1:]])
    assert fit is not None
    # Gauss-Newton ends where a step gains less than 1e-10 of the cost, which is itself rounding.
    np.testing.assert_allclose([*fit.f, *fit.b], [*a, *b], rtol=0, atol=1e-8)


@pytest.mark.parametrize("missing", [False, True])
def test_it_ends_where_a_general_optimiser_does(missing: bool) -> None:
    """scipy's least squares over poles, numerator and start together, from the truth."""
    a, b = RESONANT
    runs = [simulated(a, b, 2, 300, 0.05, seed) for seed in (1, 2)]
    if missing:
        runs[0][1][40:60] = np.nan
    fit = fit_output_error(runs, 2, 2, 2, [np.array([-1.5, 0.6])])
    assert fit is not None

    def residual(x: np.ndarray) -> np.ndarray:
        parts = []
        for k, (u, y) in enumerate(runs):
            start = np.zeros(y.size)
            start[:2] = x[4 + 2 * k : 6 + 2 * k]
            F = [1.0, *x[:2]]
            e = y - lfilter([0.0, 0.0, 0.0, *x[2:4]], F, u) - lfilter([1.0], F, start)
            parts.append(e[np.isfinite(y)])
        return np.concatenate(parts)

    other = least_squares(residual, [*a, *b, 0, 0, 0, 0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose([*fit.f, *fit.b], other.x[:4], rtol=0, atol=1e-6)  # scipy's derivatives are differences
    assert fit.cost == pytest.approx(2 * other.cost, rel=1e-9)
    J = other.jac
    rows = sum(int(np.isfinite(y).sum()) for _, y in runs)
    covariance = 2 * other.cost / (rows - 8) * np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(fit.covariance, covariance[:4, :4], rtol=1e-3)  # derivatives by differences again


def test_under_noise_least_squares_is_biased_and_output_error_is_not() -> None:
    """Facts: at 1 deg of noise the ARX pole is 5.7 instead of 3."""
    noise = np.radians(1.0)
    seeds = range(5)
    records = [recording_from(signal("aprbs", duration=60.0, seed=s).set_points, noise=noise, seed=s) for s in seeds]
    models = [OutputError(delay=0.06).fit(r) for r in records]
    r, model = records[-1], models[-1]
    found = [continuous_parameters(TS, each.arrays, 0) for each in models]
    p = np.array([entry[1] for entry in found if entry is not None])
    truth = -np.log(TRUTH.pole[0]) / TS
    std = model.findings["parameter_std"][0][0] / TRUTH.pole[0] / TS
    assert abs(p.mean() - truth) < 3.0 * std / np.sqrt(5)  # three standard errors
    beside = model.findings["least_squares_beside"]["pitch"]
    arx = continuous_parameters(TS, Rls(delay=0.06).fit(r).arrays, 0)
    assert arx is not None
    assert beside["slowest_pole_1_per_s"] == pytest.approx(arx[1], rel=1e-6)
    assert arx[1] > 1.3 * truth


def test_the_dead_time_is_the_least_of_its_whole_curve() -> None:
    model = OutputError(max_delay=0.2).fit(neck_recording(1200))
    for axis, name in enumerate(("pitch", "roll")):
        curve = np.array(model.findings["delay_curve"][name])
        np.testing.assert_allclose(curve[:, 0], np.arange(11) * TS, atol=1e-12)
        assert curve[:, 1].argmax() == model.arrays["delay"][axis] == TRUTH.delay[axis]


@given(st.integers(1, 3000), st.integers(0, 2999), st.floats(0.3, 3.0))
def test_of_many_dead_times_the_best_is_found_by_few_trials(count: int, best: int, power: float) -> None:
    """A cost with one minimum; up to 32 all are tried, in their order."""
    best %= count
    tried: list[int] = []

    def cost(d: int) -> float:
        tried.append(d)
        return abs(d - best) ** power

    assert best_delay(range(count), cost) == best
    assert len(tried) == len(set(tried)) <= 100  # a grid of 32, then twice as many finer ones at most
    if count <= 32:
        assert tried == list(range(count))


def test_of_equal_dead_times_the_first_is_taken_and_one_without_a_cost_never() -> None:
    costs = [math.nan, 2.0, 1.0, math.inf, 1.0, math.nan]
    assert best_delay(range(6), costs.__getitem__) == 2
    assert best_delay([4], lambda _: math.inf) == 4


def test_runs_have_starts_of_their_own() -> None:
    P = signal("aprbs", duration=12.0, seed=2).set_points
    first, second = recording_from(P), recording_from(4.0 - P)
    late = second.rows(100, 500)  # begins in the middle of a motion
    model = OutputError(delay=0.06).fit([first, late])
    # Nothing but rounding is left where no run is joined to another and each start is estimated.
    assert model.arrays["a"][0, 0] == pytest.approx(-TRUTH.pole[0], abs=1e-7)
    assert model.findings["delay_curve"]["pitch"][0][1] > 100.0 - 1e-4
    with pytest.raises(DataError, match="different sample times"):
        OutputError().fit([first, Recording(first.time * 2, 2 * TS, first.channels)])


@pytest.mark.slow
@pytest.mark.parametrize("source", ["set_points", "positions"])
def test_what_drives_it_is_what_was_asked(source: str) -> None:
    r = neck_recording(1500, noise=0.0)
    model = OutputError(nb=2, source=source, max_delay=0.2).fit(r)
    U = redefine(r.motor_positions if source == "positions" else r.set_points)[:, 0]
    a, b, d = model.arrays["a"][0], model.arrays["b"][0], int(model.arrays["delay"][0])
    y = lfilter([0.0] * (d + 1) + b.tolist(), [1.0, *a], U)
    free = model.simulate(r, motors="measured" if source == "positions" else "simulated", warm_up=1)
    # From rest; the model's first sample is the measured one, zero as well.
    np.testing.assert_allclose(free[:, 0], y, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [OutputError(), OutputError(nf=2, nb=2, max_delay=0.12)], ids=["one", "two"])
def test_tf_ss_free_run_and_file_are_one_system(settings: OutputError, tmp_path: Path) -> None:
    model = settings.fit(neck_recording(1500, noise=1e-3))
    model.save(tmp_path / "m.npz")
    model = load(tmp_path / "m.npz")
    P = signal("aprbs", duration=6.0, seed=8).set_points.copy()
    P[:12] = 0.0  # from rest: control's systems start there
    free = model.simulate(recording_from(P), warm_up=0)
    U, t = cast(Any, redefine(P)[:, :2]), np.arange(len(P)) * TS
    joint = control.forced_response(model.ss(), t, U.T).outputs
    for axis, name in enumerate(("pitch", "roll")):
        G = model.tf(name)
        # Realisations of one system: rounding.
        np.testing.assert_allclose(control.forced_response(G, t, U[:, axis]).outputs, free[:, axis], atol=1e-9)
        np.testing.assert_allclose(joint[axis], free[:, axis], atol=1e-9)
        assert name in model.summary()


def test_predictions_start_again_from_what_was_measured() -> None:
    """No noise model: k steps ahead is a free run of k steps from the measured output."""
    r = neck_recording(300)
    model = OutputError(delay=0.06).fit(neck_recording(1500, seed=4))
    a, b, d = model.arrays["a"][0, 0], model.arrays["b"][0, 0], int(model.arrays["delay"][0])
    U = redefine(r.set_points)[:, 0]
    ahead = model.predict(r, 5)[:, 0]
    for k in (50, 120, 299):
        y = r.outputs[k - 5, 0]
        for i in range(5):
            y = -a * y + b * U[k - 5 + i - d]
        assert ahead[k] == pytest.approx(y, abs=1e-12)  # rounding


def test_in_continuous_time_it_is_the_papers_form() -> None:
    model = OutputError(delay=0.06).fit(neck_recording(1500))
    K, p, L = continuous_parameters(TS, model.arrays, 0) or (0, 0, 0)
    w = np.array([0.5, 3.0, 12.0])
    G = cast(Any, model.tf("pitch", continuous=True, pade=4))(1j * w)
    # A Pade approximation of order 4 is within 1e-6 up to w L = 0.7.
    np.testing.assert_allclose(G, K / (1j * w + p) * np.exp(-1j * w * L), rtol=1e-6)
    np.testing.assert_allclose(cast(Any, model.tf("pitch", continuous=True, pade=0))(1j * w), K / (1j * w + p))
    back = control.sample_system(model.tf("pitch", continuous=True, pade=0), TS)
    np.testing.assert_allclose(np.asarray(back.den[0][0]), [1.0, model.arrays["a"][0, 0]], rtol=1e-9)
    with pytest.raises(SettingsError, match="`pade` must be a whole number"):
        model.tf("pitch", continuous=True, pade=-1)


def test_what_cannot_be_fitted_is_named() -> None:
    with pytest.raises(DataError, match="no motor positions were logged"):
        OutputError(source="positions").fit(neck_recording(200, positions=False))
    with pytest.raises(DataError, match="a dead time of 2 s is longer than the longest run"):
        OutputError(delay=2.0).fit([neck_recording(80), neck_recording(80)])
    u = signal("aprbs", duration=4.0, seed=1).set_points
    drift = recording_from(u).with_channels(pitch=np.cumsum(redefine(u)[:, 0]) * 1e-3)
    assert "its slowest pole is at the bound" in OutputError(delay=0.0).fit(drift).findings["warnings"][0]


def _real(shared_data: Path, name: str) -> Recording:
    folder, log = {
        "open": ("neck_openloop", "spring_test_0gr.csv"), "closed": ("neck_closedloop", "frontier_test_000gr.csv"),
    }[name]  # fmt: skip
    return import_log(shared_data / folder / log, read_layout(LAYOUTS / f"{folder}.toml")).recording


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "source", "least"), [("open", "set_points", (93.0, 89.5)), ("closed", "positions", (85.0, 0.0))]
)
def test_the_real_neck(shared_data: Path, name: str, source: str, least: tuple[float, float]) -> None:
    """Issue 6: fitted and judged on the whole recording, as the facts' figures were."""
    r = _real(shared_data, name)
    motors = "measured" if source == "positions" else "simulated"
    fit = validate(OutputError(source=source).fit(r), r, motors=motors, include_training=True).fits["inf"]
    assert (fit["pitch"] or 0.0) >= least[0]
    assert (fit["roll"] or 0.0) >= least[1]


def test_first_order_truth_is_what_the_filter_says() -> None:
    u = np.random.default_rng(0).standard_normal(50)
    u[0] = 0.0
    np.testing.assert_allclose(first_order(u, 0.9, 0.1, 2), lfilter([0, 0, 0, 0.1], [1, -0.9], u), atol=1e-14)


def test_concatenated_and_listed_recordings_are_the_same() -> None:
    one, two = neck_recording(400), neck_recording(400, seed=5)
    a = OutputError(delay=0.06).fit([one, two]).arrays["a"]
    np.testing.assert_array_equal(a, OutputError(delay=0.06).fit(concatenate([one, two])).arrays["a"])


@pytest.mark.parametrize(("sample_time", "unit"), [(0.001, "kPa"), (0.02, "rad"), (4.0, "V")])
def test_a_lightly_damped_mode_has_two_poles_by_default(sample_time: float, unit: str) -> None:
    """Its decay lasts longer than the run, which bounds the poles of a drift and not those of a mode."""
    robot = Robot.from_dict({
        "name": "arm", "motors": {"names": ["m"], "unit": unit}, "outputs": {"names": ["tip"], "unit": "mm"},
        "directions": {"kind": "matrix", "matrix": [[1.0]]},
    })  # fmt: skip
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-2.0, 2.0, 60), rng.integers(20, 60, 60))[:2000, None]
    pole = np.exp(0.24 * (-0.003 + 1j))
    y = np.asarray(dsp.lfilter([0.0, 1e-3], np.poly([pole, pole.conj()]).real, u[:, 0]))
    y += 0.05 * y.std() * rng.standard_normal(y.size)
    r = Recording.from_arrays(u, y[:, None], sample_time=sample_time, robot=robot)
    model = OutputError(delay=0.0).fit(r)
    assert (model.settings["nf"], model.settings["nb"]) == (2, 2)
    # Noise of a twentieth of the motion leaves a fit of 95 %.
    fit = validate(model, r, include_training=True).fits["inf"]["tip"]
    assert fit is not None
    assert fit > 90.0
    assert OutputError(delay=0.0, nf=1).fit(r).settings["nf"] == 1


def one_motor(u: np.ndarray, y: np.ndarray, sample_time: float, name: str = "plate") -> Recording:
    robot = Robot.from_dict({
        "name": name, "motors": {"names": ["heater"], "unit": "V"}, "outputs": {"names": ["height"], "unit": "mm"},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    return Recording.from_arrays(u[:, None], 1e-3 * y[:, None], sample_time=sample_time, robot=robot)


def levels(rows: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(0.0, 5.0, rows), rng.integers(40, 150, rows))[:rows]


def late(u: np.ndarray, samples: int) -> np.ndarray:
    return np.concatenate([np.full(samples, u[0]), u])[: u.size]


def test_a_run_that_starts_far_from_equilibrium_has_its_gain_pole_and_dead_time() -> None:
    """The mean of the outputs is off by the start's transient, of 80 samples: as an offset it cost a sample."""
    u, pole = levels(2000, 4), np.exp(-1.0 / 80.0)
    y = 21.0 + np.asarray(lfilter([9.0 * (1.0 - pole)], [1.0, -pole], late(u, 6)))
    [(a, b, dead)] = axis_functions(OutputError(max_delay=20.0).fit(one_motor(u, y, 2.0))).values()
    assert dead == 5
    # Gauss-Newton ends where a step gains less than 1e-10 of the cost, which is itself rounding.
    np.testing.assert_allclose([*a, *b], [-pole, 9e-3 * (1.0 - pole)], rtol=1e-6)


@pytest.mark.parametrize("kind", [OutputError(), Rls()], ids=["oe", "rls"])
def test_a_dead_time_of_three_time_constants_is_found(kind: Any) -> None:
    u = levels(1500, 8)
    y = np.asarray(lfilter([0.1], [1.0, -0.9], late(u, 31)))
    [(_, _, dead)] = axis_functions(kind.fit(one_motor(u, y, 0.02))).values()
    assert dead == 30  # the search used to end at one and a half time constants, 15 samples


@pytest.mark.parametrize("few", [[0.0, 2.0], [0.0, 1.0, 0.0, 2.0, 0.0, 3.0]], ids=["two levels", "four levels"])
def test_kinds_are_compared_on_steps_of_few_levels(few: list[float]) -> None:
    """No row is larger than the largest level: that part was empty, and every kind `diverged` on it."""
    u = np.repeat(np.resize(few, 150), np.random.default_rng(1).integers(4, 12, 150))[:1000]
    y = lfilter([0.0, 1.0], [1.0, -0.5], u) + 0.01 * np.random.default_rng(2).standard_normal(1000)
    head, tail = one_motor(u, y, 0.1).split(0.7)
    # The noise is a hundredth of the motion.
    assert choose(head, tail, kinds=["oe", "rls"]).chosen.fit > 95.0
