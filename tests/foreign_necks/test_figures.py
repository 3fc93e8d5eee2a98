"""Each foreign neck is worth having: what it shows lies where real necks do."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.signals import SAMPLE_TIME, redefine, signal

from .figures import RANGES, best_line, figures
from .necks import NECKS, ForeignNeck, record


def test_the_best_line_finds_a_line() -> None:
    u = redefine(signal("eq22", duration=20.0).set_points)[:, 0]
    y = np.zeros(u.size)
    pole = np.exp(-5.0 * SAMPLE_TIME)
    for k in range(u.size - 1):
        y[k + 1] = pole * y[k] + (1.0 - pole) * u[max(k - 3, 0)]
    # The grid of poles is 11 % apart.
    assert best_line(u, 0.1 * y + 0.3) > 95.0


@pytest.mark.slow
@pytest.mark.parametrize("name", NECKS)
def test_a_neck_is_in_the_ranges_of_real_ones(name: str) -> None:
    neck = ForeignNeck(name=name, noise=False)
    found = figures(lambda excitation: record(excitation, neck))
    for figure, (low, high) in RANGES.items():
        values = np.atleast_1d(getattr(found, figure))
        assert (low <= values).all(), (figure, values)
        assert (values <= high).all(), (figure, values)


@pytest.mark.slow
@pytest.mark.parametrize("name", NECKS)
def test_specimens_differ_and_stay_plausible(name: str) -> None:
    lines = []
    for seed in (1, 2):
        neck = ForeignNeck(name=name, seed=seed, noise=False)
        eq22 = record(signal("eq22", duration=60.0), neck)
        axes = zip(redefine(eq22.set_points)[:, :2].T, eq22.outputs.T, strict=True)
        lines.append([best_line(u, y) for u, y in axes])
    # Tolerances of 10 % may move it out of the range of the nominal ones by a little.
    assert 60.0 < np.min(lines) < np.max(lines) < 95.0
    assert np.abs(np.subtract(*lines)).max() > 0.1
