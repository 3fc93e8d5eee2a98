"""A design keeps its bounds on the worst sample of its family, and what is no number keeps none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from softneck.core import SettingsError
from softneck.design import PidSettings
from softneck.design.linear import _pi, _pid, _settings
from softneck.design.linear._axis_loop import (
    LAG,
    check_rise,
    closed_poles,
    coarse_frequencies,
    conditioning_candidates,
    conditioning_gain,
    delayed_form,
    error_feedback,
    feedback_response,
    filter_for,
    filter_for_lag,
    frequencies,
    innovations_gain,
    leading_filter,
    least_rise,
    make_sweep,
    rise_time,
    sensitivities,
    unstable_samples,
)
from softneck.design.linear._controller import AxisController, ReferenceFilter
from softneck.design.linear._pid import PidGains, _cost, _WorstCase
from softneck.design.linear._settings import last_kept
from softneck.design.plants._uncertain import StepAndLoad, UncertainAxis
from softneck.estimation import AxisPlant

DT = 0.02
GAINS = PidGains(2.0, 0.5, 0.05, 0.1)
W = np.geomspace(0.1, math.pi / DT, 60)
Z = np.exp(1j * W * DT)
SETTINGS = PidSettings(max_sensitivity=1.6, noise_gain=5.0)


def case(loops: Any, settings: PidSettings = SETTINGS, *, static_gain: float = 0.1) -> _WorstCase:
    return _WorstCase(settings, (), None, Z, np.asarray(loops, complex), DT, static_gain, 1.0)  # pyright: ignore[reportArgumentType]


def with_sensitivity(*sizes: float) -> np.ndarray:
    """Return plants whose loop with `GAINS` has these peaks of |S|: 1 + K P = 1/size at one frequency, else large."""
    K = GAINS.response(Z, DT)
    rows = np.full((len(sizes), W.size), 0.0 + 9.0j)
    for row, size in zip(rows, sizes, strict=True):
        row[20] = 1.0 / size - 1.0
    return rows / K


def test_the_worst_sample_must_keep_the_sensitivity() -> None:
    for sizes in ((1.2, 1.5), (1.5, 1.2), (1.6 - 1e-9, 1.0)):
        assert case(with_sensitivity(*sizes)).excess(GAINS) == 0.0
    for sizes in ((1.2, 2.0), (2.0, 1.2), (1.2, 2.0, 1.3)):
        assert case(with_sensitivity(*sizes)).excess(GAINS) == pytest.approx(2.0 / 1.6 - 1.0)
    for place in (0, 1):
        loops = with_sensitivity(1.2, 1.2)
        loops[place, 30] = math.nan
        assert math.isnan(case(loops).excess(GAINS))


def test_the_noise_is_bound_as_well_and_both_excesses_add_up() -> None:
    quiet = with_sensitivity(1.2)
    # At Nyquist: K (1 + Ti term + Td/(Tf + Ts/2)), by hand.
    high = GAINS.gain * (1.0 + DT / GAINS.integral_time / 2.0 + 2.0 * GAINS.derivative_time / (DT + 2.0 * 0.1))
    for sign in (-1.0, 1.0):
        bound = high
        for share, expected in ((1.0001, 0.0), (0.5, 1.0), (0.25, 3.0)):
            settings = replace(SETTINGS, noise_gain=share * bound)
            assert case(quiet, settings, static_gain=sign).excess(GAINS) == pytest.approx(expected, abs=1e-9)
    loud = case(with_sensitivity(3.2), replace(SETTINGS, noise_gain=0.5 * high), static_gain=1.0)
    assert loud.excess(GAINS) == pytest.approx(1.0 + 1.0)
    assert math.isnan(case(quiet, static_gain=math.nan).excess(GAINS))


def test_gains_are_scaled_back_until_all_bounds_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    def scaled(*, excess: Any, load: float = 1.0, peak: Any = lambda _: 1.6) -> PidGains | None:
        monkeypatch.setattr(_WorstCase, "excess", lambda _, gains: excess(gains.gain))
        monkeypatch.setattr(_WorstCase, "_peak", lambda _, gains: peak(gains.gain))
        monkeypatch.setattr(_WorstCase, "load", lambda *_: load)
        return case(with_sensitivity(1.2)).scale_to_bounds(GAINS)

    assert scaled(excess=lambda _: 0.0) == GAINS
    found = scaled(excess=lambda gain: max(gain - 1.9, 0.0))
    assert found is not None
    assert 0.995 * 1.9 < found.gain <= 1.9
    assert found == scaled(excess=lambda _: 0.0, peak=lambda gain: 1.6 if gain <= 1.9 else 1.61)
    assert replace(found, gain=GAINS.gain) == GAINS
    for unknown in (lambda _: math.nan, lambda _: 1e-9, lambda _: math.inf):
        assert scaled(excess=unknown) is None
        assert scaled(excess=lambda _: 0.0, peak=lambda gain, unknown=unknown: 1.6 + unknown(gain)) is None
    for load in (1e3, math.nan, 1e6):
        assert scaled(excess=lambda _: 0.0, load=load) is None


def test_the_load_is_that_of_the_worst_sample_and_no_number_is_the_worst(monkeypatch: pytest.MonkeyPatch) -> None:
    judged = replace(case(with_sensitivity(1.2)), sweep=SimpleNamespace(test=SimpleNamespace(size=2.0)))

    def load(values: list[float]) -> float:
        monkeypatch.setattr(_WorstCase, "_loads", lambda *_: np.array(values))
        return judged.load(GAINS)

    assert load([1.0, 3.0, 2.0]) == load([3.0, 2.0, 1.0]) == 6.0
    assert load([1.0, math.nan]) == load([math.inf, 1.0]) == 1e6
    monkeypatch.setattr(_WorstCase, "excess", lambda *_: 0.5)
    units = np.array([1.0, 1.0, 1.0, 1.0])
    load([1.0, 3.0])
    assert _cost(judged, units, np.zeros(4)) == pytest.approx(6.0 + 10.0 * 0.5)

    def refuses(*_: Any) -> float:
        raise SettingsError("no")

    monkeypatch.setattr(_WorstCase, "excess", refuses)
    assert _cost(judged, units, np.zeros(4)) == 1e6


def test_a_search_keeps_the_hardest_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_pid, "_SEARCH_SAMPLES", 3)
    loads = np.array([1.0, 5.0, math.nan, 4.0, 2.0])
    monkeypatch.setattr(_WorstCase, "_loads", lambda *_: loads)
    monkeypatch.setattr(_pid, "replace", lambda thing, **more: SimpleNamespace(**{**vars(thing), **more}))
    sweep: Any = SimpleNamespace(plants=np.arange(5.0), delays=np.arange(5.0) + 10.0)
    judge: Any = SimpleNamespace(sweep=sweep, _loads=lambda _: loads)
    few: Any = _WorstCase.select_hardest(judge, GAINS)
    assert set(few.sweep.plants.tolist()) == {1.0, 2.0, 3.0}
    assert (few.sweep.delays - few.sweep.plants).tolist() == [10.0] * 3


@pytest.mark.parametrize("seed", range(12))
def test_the_largest_pi_keeps_both_bounds_at_every_size_up_to_it_and_none_beyond(seed: int) -> None:
    """By the bounds themselves on a grid of sizes; the loops turn far enough to meet either bound first."""
    rng = np.random.default_rng(seed)
    w, angle = np.geomspace(0.05, 150.0, 200), rng.uniform(0.3, 1.4)
    lag, delay = np.exp(rng.normal(-1.0, 0.5, (2, 2, 1)))
    shape = np.exp(-0.3j * w * delay) / (1.0 + 1j * w * lag) * (1.0 + 1.0 / (1j * w * lag * rng.uniform(0.3, 3.0)))
    limit = rng.uniform(1.1, 2.5)
    largest = _pi._largest_size(shape, limit, angle)
    assert all(_pi._keeps(size * shape, limit, angle) for size in np.geomspace(_pi._LEAST_SIZE, largest, 400))
    # One part in a thousand, less than a step between two frequencies turns or grows the loop.
    assert not _pi._keeps(1.001 * largest * shape, limit, angle)
    # A further loop or a stricter bound never allows more.
    assert _pi._largest_size(np.vstack([shape, 1.3 * shape[:1]]), limit, angle) <= largest
    assert _pi._largest_size(shape, 0.95 * limit, angle) <= largest
    assert _pi._largest_size(shape, limit, 1.05 * angle) <= largest


def test_a_pi_whose_loop_meets_no_bound_ends_at_the_largest_size_and_one_that_always_does_has_none() -> None:
    shape = np.full((1, 5), 1e-4 + 0.0j)
    assert _pi._largest_size(shape, 1.5, 1.0) == pytest.approx(_pi._LARGEST_SIZE, rel=1e-8)
    assert _pi._largest_size(-1e6 * shape, 1.5, 1.0) == 0.0


# -- filters and conditioning -----------------------------------------------------------------------------------------


def sweep_of(overshoots: Any, **test: float) -> Any:
    """A sweep whose overshoots are `overshoots(filter, L, test)`."""

    class Sweep(SimpleNamespace):
        def run(self, controller: Any, led: Any, L: Any) -> Any:
            del controller
            return SimpleNamespace(overshoot=np.array(overshoots(led, L, self.test)))

    return Sweep(test=SimpleNamespace(**test))


@pytest.mark.parametrize("order", [(0.5, 1.0), (1.0, 0.5)])
def test_the_filter_is_the_fastest_with_which_every_sample_keeps_the_overshoot(
    order: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    axis: Any = SimpleNamespace(sample_time=DT, nominal=None)
    controller: Any = SimpleNamespace(conditioning=lambda: None)
    monkeypatch.setattr(_settings, "_fastest_filter", lambda _: 2)
    monkeypatch.setattr(_settings, "_slowest_filter", lambda _: 64)
    limit = PidSettings.OVERSHOOT_PCT

    def least(border: float) -> float:
        """Return the filter time where the worst sample overshoots by the limit at `border` samples."""
        sweep = sweep_of(lambda led, *_: [share * limit * border * DT / led for share in order])
        monkeypatch.setattr(PidSettings, "_sweep", lambda *_: sweep)
        return SETTINGS._least_filter_time(controller, axis)

    for border in (3, 17, 63, 64):
        assert least(border) == pytest.approx(border * DT)
    assert least(1.0) == least(2.0) == pytest.approx(2 * DT)
    assert least(2.5) == pytest.approx(3 * DT)
    with pytest.raises(SettingsError, match="keeps the overshoot below"):
        least(64.1)
    with pytest.raises(SettingsError, match="keeps the overshoot below"):
        least(math.nan)


def test_a_conditioning_is_taken_for_its_worst_test_and_worst_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    limit = PidSettings.OVERSHOOT_PCT

    def chosen(table: dict[str, tuple[list[float], list[float], list[float]]]) -> str:
        """`table`: L -> overshoots within the limits, in the large step, and with half the slew."""

        def run(led: Any, L: Any, test: Any) -> list[float]:
            del led
            return table[L][1 if test.reference == 2.0 else 2 if test.slew_limit == 0.5 else 0]

        monkeypatch.setattr(PidSettings, "_sweep", lambda *_: sweep_of(run, reference=1.0, slew_limit=1.0))
        monkeypatch.setattr(_settings, "conditioning_candidates", lambda _: [name for name in table if name != "usual"])
        monkeypatch.setattr(_settings, "replace", lambda thing, **more: type(thing)(**{**vars(thing), **more}))
        controller: Any = SimpleNamespace(conditioning=lambda: "usual", L="usual")
        return SETTINGS._choose_conditioning(controller, None, None).L  # pyright: ignore

    good, usual = [0.0, 0.0], ([0.0], [20.0], [10.0])
    assert chosen({"usual": usual, "b": (good, [5.0, 6.0], [7.0, 1.0])}) == "b"
    # One sample, or one of the two tests, that is worse than the usual one.
    for bad in (
        (good, [0.0, 21.0], [0.0]), (good, [21.0, 0.0], [0.0]), (good, [0.0], [21.0]), (good, [math.nan], [0.0]),
        (good, [0.0], [0.0, math.nan]), ([0.0, limit + 1e-9], [0.0], [0.0]), ([math.nan], [0.0], [0.0]),
    ):  # fmt: skip
        assert chosen({"usual": usual, "b": bad}) == "usual"
    assert chosen({"usual": usual, "b": ([limit], [9.0], [3.0]), "c": (good, [8.0], [3.0])}) in ("b", "c")


def test_every_sample_must_be_stable_and_keep_its_sensitivity(monkeypatch: pytest.MonkeyPatch) -> None:
    axis: Any = SimpleNamespace(samples=(0, 1, 2))
    for sizes, largest in (((1.6, 1.0, 1.2), 1.6), ((1.0, 1.2, math.inf), math.inf), ((math.nan, 1.0, 1.0), math.nan)):
        monkeypatch.setattr(_settings, "sensitivities", lambda *_, sizes=sizes: np.array(sizes))
        found = SETTINGS._sensitivity(None, axis)  # pyright: ignore[reportArgumentType]
        assert found == largest or math.isnan(largest) is math.isnan(found) is True
    for lost in ([], [2], [0, 1, 2]):
        monkeypatch.setattr(_settings, "unstable_samples", lambda *_, lost=lost: lost)
        if not lost:
            SETTINGS._require_stable(None, axis)  # pyright: ignore[reportArgumentType]
            continue
        with pytest.raises(SettingsError, match=rf"around {len(lost)} of 3 samples \(the first is sample {lost[0]}\)"):
            SETTINGS._require_stable(None, axis)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "curve",
    [
        lambda x: x, lambda x: x**3, lambda x: math.expm1(6.0 * x), lambda x: -math.expm1(-6.0 * x),
        lambda x: min(x, 0.01), lambda x: max(x, -1e-9), lambda x: math.copysign(1.0, x),
        lambda x: x if x < 0.0 else 1.0, lambda x: x if x <= 0.0 else math.inf,
    ],
)  # fmt: skip
def test_the_last_kept_is_that_of_all_halvings_by_fewer_tries(curve: Callable[[float], float]) -> None:
    low, high, halvings, counts = 0.05, 5.0, 8, []
    ends = np.geomspace(low, high, 2**halvings + 1)
    for crossing in (*(ends[1:-1:9] * 1.001), *(ends[1:-1:9] * 0.999), 1.0001 * low, 0.9999 * high, 2.0 * high):
        tried: list[float] = []

        def excess(x: float, tried: list[float] = tried, crossing: float = crossing) -> float:
            tried.append(x)
            return curve(math.log(x / crossing))

        found = last_kept(excess, low, high, halvings=halvings)
        a, b = low, high
        for _ in range(halvings):
            middle = math.sqrt(a * b)
            a, b = (middle, b) if middle <= crossing else (a, middle)
        assert found == a
        assert len(tried) == len(set(tried))
        # The lowest is tried only where the first halving is not kept.
        assert (low in tried) == (math.sqrt(low * high) > crossing)
        assert low <= min(tried)
        assert max(tried) < high
        counts.append(len(tried))
    # Beside the lowest, four tries may have followed nothing. Of a line in log(x) two halvings and both ends of an
    # interval are tried.
    assert max(counts) <= halvings + 5
    assert (curve(-2.0), curve(2.0)) != (-2.0, 2.0) or np.mean(counts) < 0.6 * halvings


def test_a_riccati_equation_without_a_solution_gives_no_conditioning(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = error_feedback(control.ss(control.TransferFunction([3.0, -2.9], [1.0, -1.0], 0.02)))
    assert conditioning_candidates(controller)
    solve, calls = scipy.linalg.solve_discrete_are, list[int]()

    def second_fails(*args: Any) -> np.ndarray:
        calls.append(1)
        if len(calls) > 1:
            raise np.linalg.LinAlgError
        return solve(*args)

    monkeypatch.setattr(scipy.linalg, "solve_discrete_are", second_fails)
    assert len(conditioning_candidates(controller)) == 1
    assert len(calls) > 2


def riccati(A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return the gain of the Kalman predictor by its recursion (Anderson and Moore 1979, sec. 4.1), to convergence."""
    P, L, before = np.eye(len(A)), np.zeros((len(A), len(C))), np.full((len(A), len(C)), np.inf)
    while np.abs(L - before).max() > 1e-14 * np.abs(L).max():
        before, L = L, (A @ P @ C.T + S) / (C @ P @ C.T + R)
        P = A @ P @ A.T + Q - L @ (A @ P @ C.T + S).T
    return L


B = np.array([[1.0], [0.5]])


@pytest.mark.parametrize(
    ("b", "c", "direct"),
    [
        (B, [0.3, 0.2], 0.0), (B, [-0.14, -0.56], 1.0), (B, [-0.14, -0.56], -2.0), (3.0 * B, [0.3, 0.2], 1e-4),
        # What r does at once is next to nothing, and what it does to the state does not show one sample later.
        (B, [1.0, -2.0], 0.0), (1e-3 * B, [0.3, 0.2], 0.0),
    ],
)  # fmt: skip
def test_the_innovations_are_those_of_a_state_driven_by_the_reference(b: np.ndarray, c: list, direct: float) -> None:
    """State noise of a thousandth of what r does beside r itself; output noise of D, or of a thousandth of C B."""
    A, C, D = np.array([[0.9, 0.1], [0.0, 0.5]]), np.array([c]), np.array([[direct]])
    size, v = float(np.linalg.norm(b)), max(abs(direct), 1e-3 * abs(float((C @ b)[0, 0])), 1e-9)
    Q = b @ b.T + (1e-3 * size) ** 2 * np.eye(2)
    expected = riccati(A, C, Q, np.array([[v * v * 1.001]]), b @ D.T)
    np.testing.assert_allclose(innovations_gain(A, b, C, D), expected, rtol=1e-6, atol=1e-9)
    axis = AxisController(A=A, Br=b, By=-b, C=C, Dr=direct, Dy=-direct)
    found = conditioning_candidates(axis)
    gains = [riccati(A, C, Q, np.array([[noise * v * v]]), np.zeros((2, 1))) for noise in (1e-4, 1e-3, 1e-2, 0.1, 1.0)]
    kept = [L for L in gains if np.abs(np.linalg.eigvals(A - L @ C)).max() < 0.98]
    assert kept
    assert len(found) == len(kept)
    for one, other in zip(found, kept, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("pole", "hanus"), [(0.979, True), (0.98, True), (0.981, False), (-0.979, True), (1.1, False)])
def test_hanus_gain_is_taken_where_it_forgets(pole: float, hanus: bool) -> None:
    """x+ = 0.5 x + r + L (v_limited - v), v = C x + 2 r: with L = 1/2 the state forgets by 0.5 - C/2."""
    A, b, C = np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0 - 2.0 * pole]])
    found = conditioning_gain(A, b, C, 2.0)
    assert (float(found[0, 0]) == 0.5) is hanus
    assert abs(0.5 - float(found[0, 0]) * float(C[0, 0])) < 1.0
    # Next to no direct gain is none.
    for direct in (1e-9, -1e-9, 0.0):
        np.testing.assert_array_equal(
            conditioning_gain(A, b, C, direct), innovations_gain(A, b, C, np.array([[direct]]))
        )


def test_a_controller_of_the_error_has_equal_ways_for_reference_and_output() -> None:
    K: Any = control.ss(control.TransferFunction([3.0, -2.9], [1.0, -1.0], DT))
    axis = error_feedback(K)
    np.testing.assert_array_equal(axis.Br, -axis.By)
    assert axis.Dr == -axis.Dy == 3.0
    np.testing.assert_array_equal(axis.L, conditioning_gain(axis.A, axis.Br, axis.C, 3.0))
    np.testing.assert_allclose(feedback_response(axis, Z), K(Z), rtol=1e-9)


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("extra", [0, 2])
def test_a_delay_is_a_line_of_inputs_and_poles_and_margins_count_it(delay: int, extra: int) -> None:
    lag = AxisPlant(np.array([0.02, 0.01]), np.array([1.0, -1.5, 0.56]), delay, DT)
    A, b, C = delayed_form(lag, extra)
    assert len(A) == 2 + delay + extra
    form = np.array([C @ np.linalg.solve(z * np.eye(len(A)) - A, b) for z in Z[::7]])
    np.testing.assert_allclose(form, lag.response(W[::7], extra_delay=extra), rtol=1e-9)
    axis = error_feedback(control.ss(control.TransferFunction([0.6, -0.55], [1.0, -1.0], DT)))
    other = AxisPlant(np.array([0.03]), np.array([1.0, -0.9]), 1, DT)
    for plants in ([lag, other], [other, lag]):
        poles = closed_poles(axis, plants, extra)
        for row, plant in zip(poles, plants, strict=True):
            loop: Any = control.feedback(
                control.TransferFunction([0.6, -0.55], [1.0, -1.0], DT) * plant.tf(extra_delay=extra)
            )
            expected = np.abs(loop.poles())
            assert np.abs(row).max() == pytest.approx(expected.max(), rel=1e-6)
        # The largest |S| over a dense sweep; its own grid refines until the peak is known to 0.1 %.
        dense = np.geomspace(1e-3, math.pi / DT, 20_000)
        K = feedback_response(axis, np.exp(1j * dense * DT))
        peaks = [np.abs(1.0 / (1.0 + K * plant.response(dense, extra_delay=extra))).max() for plant in plants]
        np.testing.assert_allclose(sensitivities(axis, plants, extra), peaks, rtol=2e-3)
        assert unstable_samples(axis, plants, extra) == []


def test_samples_whose_loop_is_not_stable_are_numbered() -> None:
    axis = error_feedback(control.ss(control.TransferFunction([0.6, -0.55], [1.0, -1.0], DT)))
    plants = [AxisPlant(np.array([gain]), np.array([1.0, -0.9]), 1, DT) for gain in (0.03, 3.0, 0.02, 5.0)]
    assert unstable_samples(axis, plants, 0) == [1, 3]
    assert np.isinf(sensitivities(axis, plants, 0)).tolist() == [False, True, False, True]
    # A pole on the circle is not stable.
    assert unstable_samples(replace(axis, C=0.0 * axis.C), plants[:1], 0) == [0]


@pytest.mark.parametrize("second", [1.0, 5.0])
@pytest.mark.parametrize("Ts", [1e-3, 0.02, 0.5])
def test_loops_are_judged_up_to_nyquist_a_percent_apart_and_on_every_fourth_frequency(Ts: float, second: float) -> None:
    w = frequencies(Ts, lowest=0.05 / second)
    assert (w[0], w[-1]) == pytest.approx((0.05 / second, math.pi / Ts))
    ratio = w[1:] / w[:-1]
    assert ratio.min() == pytest.approx(ratio.max())
    assert math.exp(0.0099) < ratio.max() < math.exp(0.01 * (1.0 + 2.0 / w.size))
    np.testing.assert_array_equal(frequencies(Ts), frequencies(Ts, lowest=0.05))
    coarse = coarse_frequencies(AxisPlant(np.array([0.1]), np.array([1.0, -0.9]), 1, Ts, second))
    assert set(coarse) <= set(w)
    assert (coarse[-1], coarse[-2]) == (w[-1], w[-5])
    assert coarse[0] < w[4]
    assert (np.diff(coarse) > 0.0).all()


# -- the rise ---------------------------------------------------------------------------------------------------------

LAG_PLANT = AxisPlant(np.array([0.1]), np.array([1.0, -0.9]), 3, DT)


@pytest.mark.parametrize(
    ("y", "rise"),
    [
        ([0.0, 0.1, 0.5, 0.9, 1.0], 2.0), ([0.0, 0.2, 0.5, 0.8, 1.0], 3.0), ([0.5, 0.7, 1.1], 2.3),
        ([0.0, 1.0], 0.8), ([1.0], 0.8), ([0.0, 0.05, 0.5, 0.95, 0.2, 1.0], 1.777777777), ([0.0, 0.5, 0.89], math.inf),
        ([0.0, 0.05], math.inf), ([], math.inf), ([math.nan, math.nan], math.inf),
    ],
)  # fmt: skip
@pytest.mark.parametrize("dt", [1.0, 0.02])
def test_a_rise_is_between_samples_from_rest(y: list[float], rise: float, dt: float) -> None:
    assert rise_time(np.array(y), dt) == pytest.approx(rise * dt, rel=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_least_rise_is_that_of_an_input_led_as_fast_as_it_may(sign: float) -> None:
    plant = replace(LAG_PLANT, numerator=sign * LAG_PLANT.numerator)
    for slew, limit, reference, size in ((0.25, 6.0, 0.2, None), (0.1, 0.3, 0.2, None), (0.1, 6.0, 0.2, 2.0)):
        test = StepAndLoad(reference=reference, slew_limit=slew, position_limit=limit)
        y, u, rows = 0.0, 0.0, [0.0]
        for _ in range(2000):
            u = min(u + slew, limit)
            y = 0.9 * y + 0.1 * u
            rows.append(y)
        # The first input acts from the sample after it on.
        assert least_rise(plant, test, size) == pytest.approx(rise_time(np.array(rows) / (size or reference), DT))
    # Its static gain is 1: 90 % of a step of 0.2 need 0.18 rad.
    assert math.isfinite(least_rise(plant, StepAndLoad(reference=0.2, position_limit=0.185)))
    assert least_rise(plant, StepAndLoad(reference=0.2, position_limit=0.179)) == math.inf
    least = least_rise(plant, StepAndLoad())
    check_rise(least, plant, StepAndLoad())
    with pytest.raises(SettingsError, match="no step of two ninths of their range rises in less than"):
        check_rise(math.nextafter(least, 0.0), plant, StepAndLoad())
    with pytest.raises(SettingsError, match="rises in less than inf s"):
        check_rise(1e6, plant, StepAndLoad(reference=0.2, position_limit=0.179))


SLOW_LOOP = error_feedback(control.ss(control.TransferFunction([3.0, -2.9], [1.0, -1.0], DT)))


def loop_rise(extra: int = 0) -> float:
    """Return the rise of the loop by itself, by python-control."""
    K, G = control.TransferFunction([3.0, -2.9], [1.0, -1.0], DT), LAG_PLANT.tf(extra_delay=extra)
    y = control.step_response(control.feedback(0.2 * K * G, 1), np.arange(2000) * DT).outputs
    return rise_time(np.asarray(y), DT)


@pytest.mark.parametrize("extra", [0, 3])
@pytest.mark.parametrize("part", [0.5, 2.0])
def test_a_lead_is_a_part_of_the_lag_of_the_loop_itself(part: float, extra: int) -> None:
    plant = replace(LAG_PLANT, numerator=0.2 * LAG_PLANT.numerator)
    led = leading_filter(0.3, part, SLOW_LOOP, plant, extra)
    assert (led.time, led.lead) == pytest.approx((0.3, part * loop_rise(extra) / math.log(9.0)), rel=1e-6)
    assert leading_filter(0.3, 0.0, SLOW_LOOP, plant, extra) == ReferenceFilter(0.3)
    wild = error_feedback(control.ss(control.TransferFunction([-1.0, 0.9], [1.0, -1.0], DT)))
    with pytest.raises(SettingsError, match="the loop does not rise by itself; raise `max_sensitivity`"):
        leading_filter(0.3, part, wild, plant, extra)


@pytest.mark.parametrize("extra", [0, 3])
@pytest.mark.parametrize("ratio", [0.5, 0.9, 1.0, 1.5, 4.0])
def test_the_filter_for_a_rise_gives_it_on_the_loop(ratio: float, extra: int) -> None:
    plant = replace(LAG_PLANT, numerator=0.2 * LAG_PLANT.numerator)
    asked = ratio * loop_rise(extra)
    led = filter_for(asked, SLOW_LOOP, plant, extra)
    # Where the loop has the rise by itself, a lead that cancels the lag does as well as no filter.
    assert ratio == 1.0 or (led.lead > 0.0) is (ratio < 1.0)
    K, G = control.TransferFunction([3.0, -2.9], [1.0, -1.0], DT), plant.tf(extra_delay=extra)
    a = led.pole(DT)
    # rf+ = a rf + (1 - a) r, of which T1/T2 of r passes beside: rf + T1/T2 (r - rf).
    r, x, rows = 1.0, 0.0, []
    for _ in range(3000):
        x = a * x + (1.0 - a) * r
        rows.append((1.0 - led.jump) * x + led.jump * r)
    u: Any = np.array(rows)
    y = control.forced_response(control.feedback(K * G, 1), np.arange(3000) * DT, u).outputs
    assert rise_time(np.asarray(y), DT) == pytest.approx(asked, rel=1e-4)


@pytest.mark.parametrize(("ratio", "led"), [(0.5, True), (0.999, True), (1.001, False), (3.0, False)])
def test_the_filter_of_a_lag_cancels_its_pole_or_lags_it(ratio: float, led: bool) -> None:
    asked = ratio * LAG * 0.2
    found = filter_for_lag(asked, 0.2)
    assert (found.lead == 0.2) is led
    expected = asked / LAG if led else math.sqrt((asked / LAG) ** 2 - 0.2**2)
    assert found.time == pytest.approx(expected)


# -- the search of a PID ----------------------------------------------------------------------------------------------


def test_a_search_begins_at_two_speeds_and_the_best_that_keeps_the_bounds_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Skogestad's rule: K = T/(2 k theta), Ti = T + theta/2, for a closed loop as slow as the dead time, and faster."""
    plant = replace(LAG_PLANT, numerator=-0.5 * LAG_PLANT.numerator, second=2.0)
    axis: Any = SimpleNamespace(nominal=plant, samples=(plant,) * 3)
    settings = PidSettings(order="jacobi")
    starts: list[PidGains] = []

    class Judge:
        def __init__(self, loads: Sequence[float | None]) -> None:
            self.sweep, self.loads = SimpleNamespace(test=SimpleNamespace(gain_unit=4.0)), loads

        def select_hardest(self, gains: PidGains) -> Judge:
            starts.append(gains)
            return self

        def scale_to_bounds(self, gains: PidGains) -> PidGains | None:
            return None if self.loads[len(starts) - 1] is None else replace(gains, filter_time=float(len(starts)))

        def load(self, gains: PidGains) -> float:
            value = self.loads[round(gains.filter_time) - 1]
            assert value is not None
            return value

    monkeypatch.setattr(scipy.optimize, "minimize", lambda _cost, start, **_: SimpleNamespace(x=start))
    for loads, best in (([2.0, 1.0], 2), ([1.0, 2.0], 1), ([1.0, 1.0], 1), ([None, 5.0], 2), ([5.0, None], 1)):
        starts.clear()
        monkeypatch.setattr(_WorstCase, "of", lambda *_, loads=loads: Judge(loads))
        assert settings._search_gains(axis, DT).filter_time == best
    T, dead = plant.time_constant, (3 + 1 + 2) * DT
    for gains, speed in zip(starts, (1.0, 2.0), strict=True):
        found = (gains.gain, gains.integral_time, gains.derivative_time, gains.filter_time)
        assert found == pytest.approx((-T / (2.0 * speed * dead) / 0.5, T + 0.5 * dead, 0.3 * dead, 0.3 * DT))
    monkeypatch.setattr(_WorstCase, "of", lambda *_: Judge([None, None]))
    starts.clear()
    with pytest.raises(SettingsError, match=r"no PID keeps Ms <= 2 and a noise gain of 5 on all 3 samples; raise one"):
        settings._search_gains(axis, DT)


def test_gains_of_logarithms_are_in_their_units_and_bounded() -> None:
    units = np.array([-2.0, 3.0, 4.0, 5.0])
    found = _pid._gains(np.log([1.0, 2.0, 3.0, 4.0]), units)
    assert found == PidGains(*(pytest.approx(value) for value in (-2.0, 6.0, 12.0, 20.0)))  # pyright: ignore[reportArgumentType]
    far = _pid._gains(np.array([1e3, -1e3, 20.0, -20.0]), units)
    assert far.gain == pytest.approx(-2.0 * math.exp(20.0))
    assert (far.integral_time, far.filter_time) == pytest.approx((3.0 * math.exp(-20.0), 5.0 * math.exp(-20.0)))


def test_the_worst_case_of_an_axis_is_seen_through_its_own_delay_and_second() -> None:
    plants = (replace(LAG_PLANT, second=3.0), replace(LAG_PLANT, delay=5, second=3.0))
    axis = UncertainAxis(plants[0], plants)
    made = _WorstCase.of(PidSettings(order="jacobi"), axis)
    w = np.angle(made.z) / DT
    np.testing.assert_allclose(w, coarse_frequencies(plants[0]), rtol=1e-9)
    for row, plant in zip(made.loops, plants, strict=True):
        np.testing.assert_allclose(row, plant.response(w, extra_delay=2), rtol=1e-9)
    assert (made.second, made.sample_time, made.static_gain) == (3.0, DT, pytest.approx(1.0))
    assert made.sweep.delays.tolist() == [5.0, 7.0]
    seen: list[Any] = []
    judged = replace(
        made, sweep=SimpleNamespace(run=lambda *args: seen.append(args) or SimpleNamespace(load_rms=[1.0]))
    )
    judged._loads(GAINS)
    # The reference is filtered by 0.3 scaled seconds: only the load is judged.
    assert seen[0][1] == pytest.approx(0.9)
    np.testing.assert_array_equal(seen[0][2], GAINS.axis(DT).conditioning())
    assert made._peak(GAINS) == sensitivities(GAINS.axis(DT), plants, 2).max()


@pytest.mark.parametrize("value", [0.0999, 1.0001e4, math.nan, math.inf])
def test_a_bound_on_the_noise_is_a_number_that_may_be(value: float) -> None:
    with pytest.raises(SettingsError, match="`noise_gain` must"):
        PidSettings(noise_gain=value)
    assert [PidSettings(noise_gain=bound).noise_gain for bound in (0.1, 1e4)] == [0.1, 1e4]


def test_plants_of_unequal_order_are_swept_each_as_it_is() -> None:
    second_order = AxisPlant(np.array([0.02, 0.01]), np.array([1.0, -1.5, 0.56]), 1, DT)
    axis = error_feedback(control.ss(control.TransferFunction([0.6, -0.55], [1.0, -1.0], DT)))
    for plants in ([LAG_PLANT, second_order], [second_order, LAG_PLANT]):
        sweep = make_sweep(plants, extra_delay=2)
        assert sweep.delays.tolist() == [plant.delay + 2.0 for plant in plants]
        assert (sweep.test, sweep.nominal) == (StepAndLoad(sample_time=DT), 0)
        whole = sweep.run(axis, 0.2, axis.conditioning()).angles
        for row, plant in zip(whole, plants, strict=True):
            alone = make_sweep([plant], extra_delay=2).run(axis, ReferenceFilter(0.2), axis.conditioning()).angles[0]
            np.testing.assert_allclose(row, alone, atol=1e-12)
            assert not row[: plant.delay + 3].any()
            assert row[plant.delay + 3 + 1] != 0.0
    asked = StepAndLoad(reference=0.3)
    assert make_sweep([LAG_PLANT], test=asked).test is asked
    assert make_sweep([replace(LAG_PLANT, sample_time=0.5)]).test.sample_time == 0.5
