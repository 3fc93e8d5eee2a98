"""Margins of one loop are those of a dense sweep, however light the damping, long the delay and short the sample."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import SettingsError
from softneck.design import Margins, PiSettings, margins_of_loops, uncertain_plant
from softneck.design.linear._margins import frequency_grid, sensitivities_of_loops
from softneck.estimation import LinearNeck

from .loops import loop_margins


def response(L: Any, w: np.ndarray) -> np.ndarray:
    z = np.exp(1j * w * L.dt)
    return np.polyval(L.num[0][0], z) / np.polyval(L.den[0][0], z)


def zoomed(L: Any, w: np.ndarray, score: Any, places: np.ndarray) -> np.ndarray:
    """Return the frequency of the largest `score(L(w))` near each of `places`, in four grids of 41 points."""
    low, high = w[np.maximum(places - 1, 0)], w[np.minimum(places + 1, w.size - 1)]
    at = w[places]
    for _ in range(4):
        grid = low + (high - low) * np.linspace(0.0, 1.0, 41)[:, None]
        best = np.argmax(score(response(L, grid)), axis=0)
        at, step = grid[best, np.arange(places.size)], (high - low) / 40.0
        low, high = np.maximum(at - step, low), np.minimum(at + step, high)
    return at


def sweep(L: Any, wn: float, damping: float) -> dict[str, float]:
    """Return the margins of a dense sweep, denser around the mode, its crossings and peaks refined."""
    nyquist = math.pi / L.dt
    near = wn * (1.0 + damping * np.sinh(np.linspace(-8.0, 8.0, 2001)))
    w = np.unique(np.concatenate([np.geomspace(1e-8 * nyquist, nyquist, 8_000), np.linspace(0.0, nyquist, 4_001)[1:],
                                  near[(near > 0.0) & (near < nyquist)]]))  # fmt: skip
    H = response(L, w)
    found: dict[str, float] = {}
    for name, size in (("sensitivity", lambda H: 1 / np.abs(1 + H)), ("complementary", lambda H: np.abs(H / (1 + H)))):
        v = size(H)
        places = np.flatnonzero(v >= 0.8 * v.max())
        inner = places[(places > 0) & (places < w.size - 1)]
        tops = inner[(v[inner] >= v[inner - 1]) & (v[inner] >= v[inner + 1])]
        found[name] = max(float(v.max()), *(size(response(L, zoomed(L, w, size, tops)))), 0.0)
    real = np.flatnonzero((np.imag(H)[1:] > 0.0) != (np.imag(H)[:-1] > 0.0))
    at = response(L, zoomed(L, w, lambda H: -np.abs(np.imag(H)), real))
    # At the Nyquist frequency a loop is real; at zero without an integrator as well.
    ends = [np.real(H[-1])] + ([np.real(H[0])] if abs(np.imag(H[0])) < 1e-3 * abs(np.real(H[0])) else [])
    factors = np.array([-1.0 / x for x in (*np.real(at), *ends) if x < 0.0])
    found["gain"] = float(np.min(factors[factors > 1.0], initial=math.inf))
    found["gain_down"] = float(np.max(factors[factors < 1.0], initial=0.0))
    one = np.flatnonzero((np.abs(H[1:]) > 1.0) != (np.abs(H[:-1]) > 1.0))
    crossed = zoomed(L, w, lambda H: -np.abs(np.abs(H) - 1.0), one)
    late = (np.angle(response(L, crossed)) + math.pi) % (2.0 * math.pi)
    found["phase"] = float(np.min(np.minimum(late, 2.0 * math.pi - late), initial=math.inf))
    found["delay"] = float(np.min(late / crossed, initial=math.inf))
    return found


def mode(wn: float, damping: float, lag: float, Ts: float, delay: int) -> Any:
    """Return a lightly damped mode behind a lag (0: none) and a dead time, of gain 1 at its frequency."""
    s: Any = control.tf("s")
    G: Any = wn**2 / (s**2 + 2.0 * damping * wn * s + wn**2)
    if lag:
        G = G / (s / lag + 1.0)
    G = control.c2d(G, Ts) * control.TransferFunction([1.0], [1.0, *[0.0] * delay], Ts)
    return G / float(np.abs(response(G, np.array([wn]))[0]))


@settings(max_examples=12, deadline=None)
@given(
    Ts=st.floats(-3.0, 0.0).map(lambda x: 10.0**x),
    turn=st.floats(-2.0, 0.3).map(lambda x: 10.0**x),
    damping=st.floats(-3.0, math.log10(0.05)).map(lambda x: 10.0**x),
    gain=st.floats(0.02, 3.0),
    lag=st.sampled_from([0.0, 0.02, 1.0]),
    delay=st.integers(0, 80),
    integral=st.booleans(),
)
def test_margins_are_those_of_a_dense_sweep(
    Ts: float, turn: float, damping: float, gain: float, lag: float, delay: int, integral: bool
) -> None:
    wn = turn / Ts
    L = gain * mode(wn, damping, lag * wn, Ts, delay)
    if integral:
        L = L * control.TransferFunction([1.0, 0.5 * turn - 1.0], [1.0, -1.0], Ts)
    poles = np.roots(np.polyadd(L.den[0][0], L.num[0][0]))
    if np.abs(poles).max() >= 1.0:
        with pytest.raises(SettingsError, match="not stable"):
            loop_margins(L)
        return
    expected, found = sweep(L, wn, damping), loop_margins(L)
    for name, value in expected.items():
        # The issue asks for 0.5 %; a factor beyond 1e6 is none.
        value = math.inf if name == "gain" and value > 1e6 else value
        assert getattr(found, name) == pytest.approx(value, rel=5e-3, abs=1e-6), name


def infinity_norm(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: float) -> float:
    """Return the peak of |C (zI - A)^-1 B + D| by bisection on the symplectic pencil (Bruinsma, Steinbuch 1990)."""
    from scipy.linalg import eigvals

    n = len(A)

    def reached(level: float) -> bool:
        R, eye, none = level**2 - D * D, np.eye(n), np.zeros((n, n))
        own = A + B @ C * (D / R)
        above = np.block([[own, none], [-C.T @ C * (1.0 + D * D / R), eye]])
        below = np.block([[eye, -B @ B.T / R], [none, own.T]])
        z = eigvals(above, below)
        return bool(np.min(np.abs(np.abs(z) - 1.0)) < 1e-7)

    low, high = max(abs(D), 1e-2) * (1.0 + 1e-9), 1e4
    while high / low > 1.0002:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if reached(middle) else (low, middle)
    return low


@pytest.mark.parametrize("damping", [0.05, 0.01, 0.001])
def test_the_peak_of_the_sensitivity_is_its_infinity_norm(damping: float) -> None:
    L: Any = control.ss(0.3 * mode(20.0, damping, 6.0, 0.02, 3))
    A, B, C = (np.asarray(part) for part in (L.A, L.B, L.C))
    found = loop_margins(L)
    # S = 1 - C (zI - A + B C)^-1 B, as L is strictly proper; the bisection ends at 0.02 %.
    assert found.sensitivity == pytest.approx(infinity_norm(A - B @ C, B, -C, 1.0), rel=1e-3)
    assert found.complementary == pytest.approx(infinity_norm(A - B @ C, B, C, 0.0), rel=1e-3)


def test_poles_and_zeros_on_the_circle_and_unstable_plants_have_margins() -> None:
    """k (z - 0.5)/(z - 1.2), closed, has its pole at (1.2 + 0.5 k)/(1 + k): at 1 with k = 0.4, never at -1."""
    unstable = control.TransferFunction([1.0, -0.5], [1.0, -1.2], 0.1)
    found = loop_margins(unstable)
    assert (found.gain, found.gain_down) == pytest.approx((math.inf, 0.4))
    # k (z - 1)/(z^2 - 2 cos(0.3) z + 1): infinite at 3 rad/s; closed, the product of the poles is 1 - k.
    undamped = control.TransferFunction([0.2, -0.2], [1.0, -2.0 * math.cos(0.3), 1.0], 0.1)
    expected, found = sweep(undamped, 3.0, 0.01), loop_margins(undamped)
    # What the sweep takes for a crossing from below is the pole itself.
    assert found.gain_down == 0.0
    for name in ("gain", "phase", "delay", "sensitivity", "complementary"):
        assert getattr(found, name) == pytest.approx(expected[name], rel=5e-3), name


@pytest.mark.parametrize("k", [0.5, 1.0, 2.5])
@pytest.mark.parametrize(("Ts", "delay"), [(0.02, 20), (0.1, 3), (0.5, 0)])
def test_margins_of_an_integrator_with_delay_are_the_textbooks(k: float, Ts: float, delay: int) -> None:
    """|k Ts/(z - 1)| = k Ts/(2 sin(w Ts/2)), its phase with d samples more -pi/2 - (d + 1/2) w Ts."""
    found = loop_margins(control.TransferFunction([k * Ts], [1.0, -1.0, *[0.0] * delay], Ts))
    crossover = 2.0 / Ts * math.asin(0.5 * k * Ts)
    left = math.pi / 2.0 - (delay + 0.5) * crossover * Ts
    assert (found.crossover, found.phase, found.delay) == pytest.approx((crossover, left, left / crossover), rel=1e-5)
    assert found.gain == pytest.approx(2.0 * math.sin(math.pi / (4.0 * delay + 2.0)) / (k * Ts), rel=1e-5)
    assert found.gain_down == 0.0


def test_a_loop_without_crossing_has_no_margin_to_lose() -> None:
    found = loop_margins(control.TransferFunction([0.05], [1.0, -0.9], 0.1))
    # |L| <= 0.5 and the loop is negative at the Nyquist frequency alone: -0.05/1.9.
    assert found.gain == pytest.approx(38.0)
    assert (found.gain_down, found.phase, found.delay) == (0.0, math.inf, math.inf)
    assert math.isnan(found.crossover)
    assert found.sensitivity == pytest.approx(1.0 / (1.0 - 0.05 / 1.9))
    # At zero frequency a positive feedback of 0.5 becomes unstable with twice the gain.
    assert loop_margins(control.TransferFunction([-0.05], [1.0, -0.9], 0.1)).gain == pytest.approx(2.0, rel=1e-6)


def test_margins_at_once_are_those_of_each_alone_and_an_unstable_loop_has_none() -> None:
    loops = [0.6 * mode(20.0, damping, 6.0, 0.02, 3) for damping in (0.001, 0.3)]
    loops.append(10.0 * loops[1])
    rows = np.array([np.roots(np.polyadd(L.den[0][0], L.num[0][0])) for L in loops])

    def evaluate(which: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        L = np.array([response(loops[k], x) for k, x in zip(which, w, strict=True)])
        return 1.0 / (1.0 + L)[:, None], np.abs(L)[:, None]

    found = margins_of_loops(evaluate, rows, 0.02, 3)
    for k in (0, 1):
        alone = loop_margins(loops[k])
        assert found.of(k).sensitivity == pytest.approx(alone.sensitivity, rel=1e-6)
        assert found.of(k).gain == pytest.approx(alone.gain, rel=1e-6)
    lost = found.of(2)
    assert (lost.gain, lost.gain_down, lost.phase, lost.delay) == (1.0, 1.0, 0.0, 0.0)
    assert lost.sensitivity == lost.complementary == found.more[2, 0] == math.inf
    worst = found.worst()
    assert (worst.gain, worst.phase, worst.sensitivity) == (1.0, 0.0, math.inf)
    np.testing.assert_array_equal(sensitivities_of_loops(evaluate, rows, 0.02, 3), found.sensitivity)
    # A loop whose poles are no numbers is not stable.
    rows[0] = np.nan
    assert margins_of_loops(evaluate, rows, 0.02, 3).of(0).sensitivity == math.inf


def test_the_worst_of_some_loops_is_never_better_than_one_of_them() -> None:
    values = np.array([[2.0], [3.0], [1.5]])
    nan = np.array([[math.nan], [4.0], [2.0]])
    from softneck.design import LoopMargins

    made = LoopMargins(values, 1.0 / values, values, values, nan, values, values, values, values)
    assert made.worst() == Margins(1.5, 1.5, 3.0, 4.0, 1.5, 1.0 / 1.5, 3.0)


CONTINUOUS, SQUARE = control.TransferFunction([1.0], [1.0, 1.0]), control.StateSpace([], [], [], np.eye(2), 0.1)


@pytest.mark.parametrize("loop", [CONTINUOUS, SQUARE, 3.0], ids=["s", "2x2", "number"])
def test_a_loop_that_is_not_discrete_and_scalar_is_refused(loop: Any) -> None:
    with pytest.raises(SettingsError, match=r"discrete|scalar"):
        loop_margins(loop)


def test_the_grid_turns_little_between_two_frequencies() -> None:
    w = frequency_grid(0.02, 80)
    assert (w[-1], w[0]) == pytest.approx((math.pi / 0.02, 1e-8 * math.pi / 0.02))
    assert np.diff(w).max() * 0.02 * 81 <= 0.51
    inner = w[w > 2e-3 * w[-1]]
    assert (inner[1:] / inner[:-1]).max() < 1.026


@pytest.mark.parametrize("tuning", ["nominal", "samples"])
def test_a_design_keeps_its_bounds_exactly_and_its_worst_is_no_better_than_the_nominal(
    tuning: str,
) -> None:
    plants = []
    for wn, damping in ((12.0, 0.05), (12.5, 0.06), (11.5, 0.07)):
        mode: Any = control.tf([wn**2], [1.0, 2.0 * damping * wn, wn**2])
        G = 0.1 * mode
        plants.append(control.c2d(G, 0.005) * control.TransferFunction([1.0], [1.0, 0.0, 0.0], 0.005))
    found = PiSettings(tuning=tuning).design({"pitch": plants, "roll": plants}).design["pitch"]
    assert found["family"] == 3
    nominal, worst = found["margins"], found["margins_family"]
    assert nominal["sensitivity"] <= found["worst_sensitivity"] == worst["sensitivity"]
    assert all((worst[key] or math.inf) <= (nominal[key] or math.inf) for key in ("gain", "phase", "delay"))
    kept = nominal if tuning == "nominal" else worst
    assert kept["sensitivity"] <= 1.005 * 1.5


def test_a_design_says_what_its_margins_are_of() -> None:
    G: Any = control.TransferFunction([0.01], [1.0, -0.9, 0.0, 0.0], 0.02)
    for plants, lines in (
        (G, ["nominal model only: "]),
        ([G, 1.1 * G], ["worst of its 2 plants: ", "nominal model only: "]),
    ):
        text = PiSettings().design({"pitch": plants, "roll": plants}).summary().splitlines()
        margins = [line.strip() for line in text if "gain margin" in line and "small moves" not in line]
        assert len(margins) == 2 * len(lines)
        assert all(line.startswith(start) for line, start in zip(margins, 2 * lines, strict=True))


def test_margins_of_a_family_come_with_the_band_of_its_recordings() -> None:
    """A loop that crosses above what the recordings support has margins of the models alone, and says so."""
    G: Any = control.TransferFunction([0.01], [1.0, -0.9, 0.0, 0.0], 0.02)
    plain = uncertain_plant({"pitch": [G, 1.1 * G], "roll": [G, 1.1 * G]})
    assert "the band of its recordings is not known" in PiSettings().design(plain).summary()
    crossover = PiSettings().design(plain).design["pitch"]["margins_family"]["crossover"]
    for high, above in ((1.001 * crossover, False), (0.999 * crossover, True)):
        axes = {name: replace(axis, band=(0.1, high)) for name, axis in plain.axes.items()}
        text = PiSettings().design(replace(plain, axes=axes)).summary()
        assert text.count(f"its recordings support 0.1 to {high:.3g} rad/s") == 2
        assert text.count("the crossover is above: these margins are of the models alone") == 2 * above


def test_a_family_gives_its_band_to_each_axis() -> None:
    class Known(LinearNeck):
        def band(self, output: str) -> tuple[float, float]:
            return {"pitch": (0.1, 20.0), "roll": (0.2, 30.0)}[output]

    G: Any = control.TransferFunction([0.01], [1.0, -0.9, 0.0, 0.0], 0.02)
    assert {name: axis.band for name, axis in uncertain_plant(Known(pitch=G, roll=G)).axes.items()} == {
        "pitch": (0.1, 20.0), "roll": (0.2, 30.0)}  # fmt: skip
