"""A design keeps its bounds on the worst sample of its family, and what is no number keeps none."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest
import scipy.linalg

from softneck.core import SettingsError
from softneck.design import PidSettings
from softneck.design.linear import _pid, _settings
from softneck.design.linear._axis_loop import conditioning_candidates, error_feedback
from softneck.design.linear._pid import PidGains, _cost, _WorstCase

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
    for sizes, keeps in (((1.6, 1.0, 1.2), True), ((1.0, 1.61, 1.2), False), ((1.0, 1.2, math.inf), False),
                         ((math.nan, 1.0, 1.0), False)):  # fmt: skip
        monkeypatch.setattr(_settings, "sensitivities", lambda *_, sizes=sizes: np.array(sizes))
        assert SETTINGS._keeps_sensitivity(None, axis) is keeps  # pyright: ignore[reportArgumentType]
    for lost in ([], [2], [0, 1, 2]):
        monkeypatch.setattr(_settings, "unstable_samples", lambda *_, lost=lost: lost)
        if not lost:
            SETTINGS._require_stable(None, axis)  # pyright: ignore[reportArgumentType]
            continue
        with pytest.raises(SettingsError, match=rf"around {len(lost)} of 3 samples \(the first is sample {lost[0]}\)"):
            SETTINGS._require_stable(None, axis)  # pyright: ignore[reportArgumentType]


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
