"""Disk margins, robust stability, worst-case gain and nu-gap against textbooks and python-control."""

from __future__ import annotations

import math
import sys
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import diskmargin, nugap, robstab, wcgain

from ..data import slow_but

TS = 0.02
POLE = math.exp(-5.293 * TS)
NECK = control.TransferFunction([math.radians(27.69) / 5.293 * (1.0 - POLE)], [1.0, -POLE, 0.0, 0.0, 0.0, 0.0], TS)


def test_the_example_of_the_disk_margin_paper() -> None:
    """Seiler, Packard and Gahinet 2020, L = 25/(s^3 + 10 s^2 + 10 s + 10): 0.46, gains 0.63 to 1.59, 25.8 deg."""
    found = diskmargin(control.TransferFunction([25.0], [1.0, 10.0, 10.0, 10.0]))
    # Two printed digits.
    assert found.margin == pytest.approx(0.46, abs=0.005)
    assert found.gain == pytest.approx((0.63, 1.59), abs=0.005)
    assert math.degrees(found.phase) == pytest.approx(25.8, abs=0.05)


def _satellite() -> Any:
    """The spinning satellite with cross feedback (Zhou, Doyle and Glover 1996): good alone, poor at once."""
    plant = control.StateSpace([[0.0, 10.0], [-10.0, 0.0]], np.eye(2), [[1.0, 10.0], [-10.0, 1.0]], np.zeros((2, 2)))
    return plant * control.StateSpace([], [], [], [[1.0, -2.0], [0.0, 1.0]])


@pytest.mark.parametrize("skew", slow_but([0.0, 1.0, -1.0], [0.0, 1.0]))
@pytest.mark.parametrize("loop", slow_but(["neck", "satellite"], ["satellite"]))
def test_disk_margins_are_those_of_python_control(loop: str, skew: float) -> None:
    pytest.importorskip("slycot")
    L: Any = 30.0 * NECK if loop == "neck" else _satellite()
    w = np.geomspace(0.01, math.pi / TS if loop == "neck" else 1e3, 3000)
    margin, gain, phase = (float(item) for item in control.disk_margins(L, w, skew=skew))
    found = diskmargin(L, skew=skew)
    # Its grid is 0.3 % wide, its mu is slycot's.
    assert found.margin == pytest.approx(margin, rel=2e-3)
    least = min(-20.0 * math.log10(found.gain[0]), 20.0 * math.log10(found.gain[1]))
    assert least == pytest.approx(gain, rel=3e-3)
    assert math.degrees(found.phase) == pytest.approx(phase, rel=3e-3)


def test_the_gains_of_a_disk_are_stood_and_more_is_not() -> None:
    """A gain at the end of a disk touches it; the true gain margin lies at or beyond it."""
    L = 10.0 * NECK
    found = diskmargin(L)
    margin = float(control.stability_margins(L)[0])
    assert found.gain[1] <= margin * (1.0 + 1e-9)
    assert diskmargin(margin * 1.001 * L).margin == 0.0
    assert diskmargin(margin * 0.999 * L).margin > 0.0


def test_one_sample_more_of_delay_costs_margin() -> None:
    late = control.TransferFunction([1.0], [1.0, 0.0], TS)
    margins = [diskmargin(20.0 * NECK * late**k).margin for k in range(4)]
    assert np.all(np.diff(margins) < 0.0)


def test_frequency_data_give_the_same_margin_on_its_grid() -> None:
    w = np.geomspace(0.01, math.pi / TS, 2000)
    data = control.frd(10.0 * NECK, w)
    # The data's own grid is 0.5 % wide.
    assert diskmargin(data).margin == pytest.approx(diskmargin(10.0 * NECK).margin, rel=1e-3)


@pytest.mark.parametrize("block", [(-1, 0), (1, 0)], ids=["real", "complex"])
def test_robust_stability_of_an_uncertain_pole(block: tuple[int, int]) -> None:
    """x' = -(1 - k delta) x is stable for delta < 1/k: by M = k/(s + 1), whose peak is at frequency zero."""
    k = 2.5
    found = robstab(control.TransferFunction([k], [1.0, 1.0]), [block])
    # The grid begins at a thousandth of the pole, where |M| is its peak to 1e-6; a purely real block gets a complex
    # part of 2 %.
    assert found.lower == pytest.approx(1.0 / k, rel=0.021 if block[0] < 0 else 1e-3)
    assert found.upper == pytest.approx(1.0 / k, rel=1e-2)
    assert found.lower <= found.upper * (1.0 + 1e-9)


@pytest.mark.slow
def test_a_real_uncertainty_is_less_than_a_complex_one() -> None:
    """s^2 + (1 + delta) s + 1 loses stability at delta = -1 for real delta."""
    M = -control.TransferFunction([1.0, 0.0], [1.0, 1.0, 1.0])
    # 2 % is the complex part that a purely real uncertainty gets.
    assert 0.975 < robstab(M, [(-1, 0)]).lower <= 1.0
    stiffness = -control.TransferFunction([1.0], [1.0, 0.2, 1.0])
    # s^2 + 0.2 s + 1 + delta is stable for all real delta > -1, a complex one needs only 0.2 at the resonance.
    assert robstab(stiffness, [(1, 0)]).lower == pytest.approx(0.2, rel=1e-2)
    assert robstab(stiffness, [(-1, 0)]).lower > 0.8


def test_worst_gain_of_an_uncertain_gain() -> None:
    """(1 + delta/2)/(s + 1) has gain 1.5 at most."""
    G: Any = control.ss(control.TransferFunction([1.0], [1.0, 1.0]))
    M = control.StateSpace(G.A, G.B @ [[0.5, 1.0]], np.vstack([np.zeros((1, 1)), G.C]), [[0.0, 1.0], [0.0, 0.0]])
    found = wcgain(M, [(-1, 0)])
    # The bound is found by halves to 1 %.
    assert found.upper == pytest.approx(1.5, rel=1e-2)
    assert found.lower == pytest.approx(1.5, rel=1e-2)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        # Astrom and Murray, Feedback Systems, 2nd ed., examples 13.2 and 13.3 (from 12.1 and 12.2): alike in open
        # loop and far apart in closed loop, and the other way round. Two printed digits.
        (([100.0], [1.0, 1.0]), ([160000.0], np.poly([-1.0, -40.0, -40.0])), 0.89),
        (([100.0], [1.0, 1.0]), ([100.0], [1.0, -1.0]), 0.02),
        # 1/(s + 1) and -1/(s + 1): the winding number fails.
        (([1.0], [1.0, 1.0]), ([-1.0], [1.0, 1.0]), 1.0),
    ],
)
def test_nu_gaps_of_textbooks(first: Any, second: Any, expected: float) -> None:
    P1, P2 = control.TransferFunction(*first), control.TransferFunction(*second)
    assert nugap(P1, P2) == pytest.approx(expected, abs=0.005)
    assert nugap(P2, P1) == pytest.approx(nugap(P1, P2), abs=1e-6)  # it is a metric; 1e-6 is the refined peak


def test_a_plant_of_more_inputs_than_outputs_has_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three motors, two angles; python-control knows the zeros of such a plant with Slycot alone."""
    monkeypatch.setitem(sys.modules, "slycot", None)
    wide = [control.StateSpace(-p * np.eye(2), np.eye(2, 3), np.eye(2), np.zeros((2, 3))) for p in (1.0, 2.0)]
    square = [control.StateSpace(-p * np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2))) for p in (1.0, 2.0)]
    # The third motor moves nothing; grids may differ by the zeros.
    assert nugap(*wide) == pytest.approx(nugap(*square), rel=1e-4)


def test_the_gap_of_gains_is_the_chordal_distance() -> None:
    a, b = 0.7, 3.0
    expected = abs(a - b) / math.sqrt((1 + a * a) * (1 + b * b))
    gains = [control.StateSpace([], [], [], [[value]], TS) for value in (a, b)]
    assert nugap(*gains) == pytest.approx(expected, rel=1e-12)


def test_integrators_and_delays_have_gaps_too() -> None:
    integrator = control.TransferFunction([TS], [1.0, -1.0], TS)
    assert nugap(integrator, integrator) < 1e-7
    assert 0.0 < nugap(10.0 * NECK, 12.0 * NECK) < 0.1
    late = NECK * control.TransferFunction([1.0], [1.0, 0.0], TS)
    assert nugap(10.0 * NECK, 10.0 * late) < nugap(10.0 * NECK, 10.0 * late * control.TransferFunction([1], [1, 0], TS))


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: diskmargin(3.0), "needed; got float"),
        (lambda: diskmargin(control.StateSpace([], [], [], [[1.0, 2.0]])), "must be square"),
        (lambda: robstab(control.TransferFunction([1.0], [1.0, -1.0]), [(1, 0)]), "not stable without uncertainty"),
        (lambda: wcgain(control.TransferFunction([1.0], [1.0, 1.0]), [(1, 0)]), "more than 1 outputs"),
        (lambda: nugap(NECK, control.TransferFunction([1.0], [1.0, 1.0])), "one sample time"),
        (lambda: nugap(NECK, _satellite()), "same inputs and outputs"),
    ],
)
def test_what_has_no_answer_is_refused(call: Any, match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        call()
