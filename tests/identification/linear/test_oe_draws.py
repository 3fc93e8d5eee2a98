from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from softneck.core import DataError
from softneck.identification import OutputError, make_draws
from softneck.identification.linear._oe_draws import OutputErrorDraws
from softneck.robot import Robot
from softneck.signals import Recording
from softneck.verification import Scale, sources_of

TS = 0.02


def oscillating(damping: float, *, rows: int = 3000, noise: float = 0.005, seed: int = 0, unit: str = "A") -> Recording:
    """A robot of second order at 9 rad/s behind two samples, its output in mm with white noise (of its spread)."""
    robot = Robot.from_dict({
        "name": "rod", "motors": {"names": ["coil"], "unit": unit, "setpoint_min": -2.0, "setpoint_max": 2.0},
        "outputs": {"names": ["tip"], "unit": "mm"},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2.0, 2.0, rows // 25 + 1), 25)[:rows]
    root = 9.0 * TS * (-damping + np.emath.sqrt(damping**2 - 1.0) * np.array([1.0, -1.0]))
    F = np.poly(np.exp(root)).real
    y = np.asarray(lfilter([0.0, 0.0, 0.0, 0.4 * F.sum()], F, u))
    y += noise * y.std() * rng.standard_normal(rows)
    return Recording.from_arrays(u[:, None], 1e-3 * y[:, None], sample_time=TS, robot=robot)


def poles(arrays: dict[str, np.ndarray]) -> np.ndarray:
    return np.sort_complex(np.linalg.eigvals(arrays["A"]))


@pytest.mark.parametrize("damping", [0.2, 0.5, 0.8])
def test_a_robot_of_second_order_has_two_poles_by_default(damping: float) -> None:
    recording = oscillating(damping)
    model = OutputError().fit(recording)
    assert (model.settings["nf"], model.settings["nb"]) == (2, 2)
    root = np.exp(9.0 * TS * (-damping + np.emath.sqrt(damping**2 - 1.0) * np.array([1.0, -1.0])))
    # 3,000 rows with noise of half a percent: a pole is known to a few thousandths.
    np.testing.assert_allclose(poles(dict(model.arrays)), np.sort_complex(root), rtol=0, atol=5e-3)


def test_two_poles_that_oscillate_need_to_leave_less_than_two_that_do_not() -> None:
    """Noise of this size leaves both with half of the error that one pole leaves."""
    settings = {}
    for damping, noise in ((0.4, 0.15), (1.5, 0.015)):
        recording = oscillating(damping, noise=noise)
        left = []
        for nf in (1, 2):
            curve = OutputError(nf=nf, nb=nf).fit(recording).findings["delay_curve"]["tip"]
            left.append(100.0 - max(fit for _, fit, _ in curve))
        one, two = left
        assert 0.4 < two / one < 0.65, damping
        settings[damping] = OutputError().fit(recording).settings["nf"]
    assert settings == {0.4: 2, 1.5: 1}


def test_a_robot_of_first_order_keeps_one_pole_whatever_its_noise() -> None:
    recording = oscillating(0.5)
    u = recording.set_points[:, 0]
    rng = np.random.default_rng(1)
    for noise in (0.001, 0.3):
        y = np.asarray(lfilter([0.0, 0.0, 0.1], [1.0, -0.9], u))
        y += noise * y.std() * rng.standard_normal(y.size)
        model = OutputError().fit(recording.with_channels(tip=1e-3 * y))
        assert model.settings["nf"] == 1
    with pytest.raises(DataError, match="this one has one pole"):
        OutputErrorDraws.fit(recording.with_channels(tip=1e-3 * y))


def test_a_draw_without_deviations_is_the_model_and_every_draw_is_stable() -> None:
    source = OutputErrorDraws.fit(oscillating(0.05))
    rng = np.random.default_rng(0)
    draws = [source.draw(rng) for _ in range(40)]
    same = source.arrays(draws[0], 0.0)
    for name, values in same.items():
        # The same poles from another start of the search: its cost ends within 1e-10.
        np.testing.assert_allclose(values, source.model.arrays[name], rtol=1e-6, atol=1e-9, err_msg=name)
    # Far beyond what the recording tells, where free deviations of this rod do not decay.
    sizes = [np.abs(poles(source.arrays(draw, 100.0))).max() for draw in draws]
    assert max(sizes) < 1.0
    assert np.ptp(sizes) > 0.0


def test_with_white_noise_the_segments_tell_the_deviations_of_least_squares() -> None:
    """Both estimate the same covariance: White's from the segments, the other from the sum of squares."""
    ratios = []
    for seed in range(6):
        source = OutputErrorDraws.fit(oscillating(0.4, noise=0.05, seed=seed))
        (root,), (fit,) = source.roots, source.fits
        ratios.append(np.diag(root @ root.T) / np.diag(fit.covariance))
    # 30 segments tell a variance to a quarter, and the mean of six recordings to a tenth: three of these.
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.35)


@pytest.mark.parametrize("unit", ["A", "kPa"])
def test_draws_of_an_oscillating_robot_are_of_kind_oe_and_close(unit: str) -> None:
    made = make_draws(oscillating(0.3, unit=unit), count=2)
    assert made.model.kind == "oe"
    large = made.coverage[-1]
    # The rod is linear: what is left are the noise of 0.5 % and deviations of the fit below it.
    assert large["width"] < 0.1 * large["motion"]
    assert large["covered"] >= 0.9


@pytest.mark.parametrize("damping", [0.1, 0.4])
def test_requirements_in_seconds_follow_the_decay_of_an_oscillation(damping: float) -> None:
    recording = oscillating(damping)
    model = OutputError().fit(recording)
    (source,) = sources_of({"rod": model})
    # By the real part of its poles, known to a percent or so from 3,000 rows.
    assert source.decay == pytest.approx(1.0 / (9.0 * damping), rel=0.03)
    # A neck's time constant is 0.2 s.
    assert Scale.of(recording.robot, [source]).time == pytest.approx(source.decay / 0.2)
    (lag,) = sources_of({"rod": OutputError(nf=1).fit(recording)})
    assert lag.decay == 0.0
    # A pair of poles beyond a quarter of the sampling rate is no motion, however slowly it decays.
    known = model.findings["transfer_functions"]["tip"]
    found = {"tip": {**known, "a": np.poly(0.999 * np.exp([2.0j, -2.0j])).real[1:].tolist()}}
    (fast,) = sources_of({"rod": replace(model, findings={**model.findings, "transfer_functions": found})})
    assert fast.decay == 0.0
