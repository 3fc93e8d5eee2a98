"""Continuous-time models: exact between samples, the optimum of their cost, intervals that hold the truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import control
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from softneck.core import SettingsError, Vector, load
from softneck.identification import OutputError
from softneck.identification.linear._srivc_fit import Continuous, SrivcFitOptions
from softneck.signals import SET_POINTS, Recording, motors_from, redefine, signal

from ...data import TS, neck_recording

# Eq. 31 in SI, its dead time between two samples.
NECK = Continuous(a=np.array([5.293]), b=np.array([0.483]), delay=0.087)
SECOND = Continuous(a=np.array([6.0, 25.0]), b=np.array([3.0]), delay=0.043)
ZERO = Continuous(a=np.array([6.0, 25.0]), b=np.array([0.5, 3.0]), delay=0.043)
# The paper's inclinometer.
NOISE = np.radians(0.05)


def response(model: Continuous, u: Vector) -> Vector:
    """From rest, on a grid 20 times finer and by python-control alone."""
    n, fine = model.a.size, 20
    G = control.TransferFunction(model.b, np.concatenate([[1.0], model.a]))
    late = round(model.delay / TS * fine)
    held = np.concatenate([np.zeros(late), np.repeat(u, fine)])[: u.size * fine]
    t = np.arange(held.size) * TS / fine
    system = control.sample_system(control.ss(G), TS / fine)
    assert n == system.nstates
    return np.asarray(control.forced_response(system, t, cast(Any, held)).outputs)[::fine]


def steps(rows: int, seed: int) -> Vector:
    u = np.repeat(np.random.default_rng(seed).uniform(-3, 3, rows // 25 + 1), 25)[:rows]
    u[:15] = 0.0
    return u


def coverage(seeds: Iterable[int], colour: float, rows: int) -> dict[str, float]:
    """Part of noise seeds whose 95 % intervals hold the true K, pole and dead time of `NECK`."""
    u = redefine(signal("aprbs", duration=rows * TS, seed=1).set_points)[:, 0]
    u[:15] = 0.0
    clean = response(NECK, u)
    truth = {"K": NECK.b[0], "pole": NECK.a[0], "delay_s": NECK.delay, "static_gain": NECK.b[0] / NECK.a[0]}
    held = dict.fromkeys(truth, 0)
    seeds = list(seeds)
    for seed in seeds:
        e = lfilter([1.0], [1.0, -colour], NOISE * np.random.default_rng(seed).standard_normal(rows))
        found = OutputError(delay=None, max_delay=0.12, intervals=True).fit(_as_recording(u, clean + e))
        bounds = found.findings["intervals"]["pitch"]
        for name, value in truth.items():
            held[name] += bounds[name][0] <= value <= bounds[name][1]
    return {name: count / len(seeds) for name, count in held.items()}


def _as_recording(u: Vector, y: Vector) -> Recording:
    """Both axes the same."""
    P = motors_from(np.column_stack([u, u, np.zeros(u.size)]))
    channels = dict(zip(SET_POINTS, P.T, strict=True)) | {"pitch": y, "roll": y}
    return Recording(np.arange(u.size) * TS, TS, channels)


@pytest.mark.parametrize("model", [NECK, ZERO], ids=["one pole", "two poles and a zero"])
def test_the_sampled_form_is_exact_also_between_samples(model: Continuous) -> None:
    u = steps(600, seed=0)
    a, b, d = model.discretize(TS)
    # Two computations of one response: rounding over 12,000 fine steps.
    np.testing.assert_allclose(
        lfilter(np.concatenate([np.zeros(1 + d), b]), np.concatenate([[1.0], a]), u), response(model, u), atol=1e-11
    )


@pytest.mark.parametrize("model", [NECK, pytest.param(SECOND, marks=pytest.mark.slow)], ids=["one pole", "two poles"])
@pytest.mark.parametrize(("pole", "delay"), [(2.0, 0.02), pytest.param(15.0, 0.16, marks=pytest.mark.slow)])
def test_a_clean_record_gives_the_system_behind_it(model: Continuous, pole: float, delay: float) -> None:
    u = steps(1500, seed=1)
    n = model.a.size
    fit = SrivcFitOptions(sample_time=TS, order=n).start([(u, response(model, u))], pole, delay)
    assert fit is not None
    np.testing.assert_allclose(fit.model.theta, model.theta, rtol=1e-6)  # Gauss-Newton: quadratic near its end


def test_it_ends_where_the_output_error_is_least() -> None:
    """With white noise the instruments are the derivatives of the output, so scipy finds no better (Young 2015)."""
    u = steps(1500, seed=2)
    y = response(NECK, u) + 10 * NOISE * np.random.default_rng(0).standard_normal(1500)
    fit = SrivcFitOptions(sample_time=TS).start([(u, y)], 5.0, 0.08)
    assert fit is not None

    def residual(x: Vector) -> Vector:
        a, b, d = Continuous(a=x[:1], b=x[1:2], delay=x[2]).discretize(TS)
        free = x[3] * np.exp(-x[0] * TS * np.arange(1500))
        return y - free - lfilter(np.concatenate([np.zeros(1 + d), b]), np.concatenate([[1.0], a]), u)

    other = least_squares(residual, [5.0, 0.5, 0.085, 0.0], x_scale=[1, 0.1, 0.01, 0.01], xtol=1e-12, ftol=1e-12)
    assert fit.cost == pytest.approx(2 * other.cost, rel=1e-7)
    # scipy's derivatives are differences, and the cost is flat to 1e-7 of itself.
    np.testing.assert_allclose(fit.model.theta, other.x[:3], rtol=2e-3)


def test_an_offset_a_start_in_motion_and_missed_samples_do_no_harm() -> None:
    u = steps(3000, seed=3)
    y = response(NECK, u) + 0.3
    y[700:760] = np.nan
    lead = 20  # rows before the window, whose outputs are not judged: they give its delayed inputs
    window = y[900 - lead : 1800].copy()
    window[:lead] = np.nan
    fit = SrivcFitOptions(sample_time=TS, offset=True).start(
        [(u[900 - lead : 1800], window), (u[:800], y[:800])], 5.0, 0.08
    )
    assert fit is not None
    np.testing.assert_allclose(fit.model.theta, NECK.theta, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_intervals_hold_the_truth_as_often_as_they_say(colour: float) -> None:
    """Of one linear system with a dead time between two samples, under white noise and under noise that lasts."""
    held = coverage(range(10), colour, rows=1500)
    # 10 seeds at 95 %: fewer than 7 hits of 10 have a chance of 1e-3, and the seeds are fixed.
    assert min(held.values()) >= 0.7
    assert np.mean(list(held.values())) >= 0.85


def test_intervals_are_around_the_model_and_in_its_file(tmp_path: Path) -> None:
    recording = neck_recording(900, noise=1e-3)
    model = OutputError(max_delay=0.12, intervals=True).fit(recording)
    for axis, name in enumerate(("pitch", "roll")):
        bounds, a, b = model.findings["intervals"][name], model.arrays["a"][axis, 0], model.arrays["b"][axis, 0]
        low, high = bounds["static_gain"]
        assert low < b / (1.0 + a) < high
        # The truth's dead time is whole samples, of which the first is the hold's.
        assert bounds["delay_s"][0] - 1e-3 < model.arrays["delay"][axis] * TS < bounds["delay_s"][1] + 1e-3
    assert "of a nonlinear neck vary more" in model.summary()
    model.save(tmp_path / "m.npz")
    assert load(tmp_path / "m.npz").findings["intervals"] == model.findings["intervals"]
    plain = OutputError(max_delay=0.12).fit(recording)
    assert "intervals" not in plain.findings
    assert all(plain.arrays[name].tobytes() == model.arrays[name].tobytes() for name in plain.arrays)
    given = OutputError(delay=0.06, intervals=True).fit(recording).findings["intervals"]["pitch"]
    assert set(given) == {"K", "pole", "static_gain"}, "a dead time that was given is not estimated"
    with pytest.raises(SettingsError, match="`intervals` are those of one pole"):
        OutputError(nf=2, intervals=True)
