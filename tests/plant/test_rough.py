"""The preset `rough` is as hard for a line to follow as the paper's neck was."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softneck.core import Matrix
from softneck.identification import INFINITE, Rls, validate
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, redefine, signal

from ..oracles.one_pole import PAPER_FITS, PAPER_GAINS, fits, least_squares

pytestmark = pytest.mark.slow  # four records of minutes
# How near each of the eight figures is to the paper's [points].
CLOSE = 5.0


@pytest.fixture(scope="module")
def records() -> tuple[Recording, list[Recording]]:
    neck = VirtualNeck(NeckParameters.rough())
    # Seeds of the demo and of `reproduce-paper`.
    eq22, *tests = (
        record(signal(name), neck, seed=n) for n, name in enumerate(("eq22", "steps", "sine", "rotation"), 1)
    )
    train, validation = eq22.split(0.7)
    assert validation is not None
    return train, [validation, *tests]


def test_one_pole_by_scipy_has_the_papers_fits_and_gains(records: tuple[Recording, list[Recording]]) -> None:
    train, judged = records
    U, Y = redefine(train.set_points), train.outputs
    models = (least_squares(U[:, 0], Y[:, 0]), least_squares(U[:, 1], Y[:, 1]))
    assert np.abs(fits(models, [(redefine(r.set_points), r.outputs) for r in judged]) - PAPER_FITS).max() <= CLOSE
    assert [math.degrees(model.gain) for model in models] == pytest.approx(PAPER_GAINS, rel=0.1)


def test_rls_has_the_papers_fits(records: tuple[Recording, list[Recording]]) -> None:
    train, judged = records
    model = Rls().fit(train)
    found: Matrix = np.array([list(validate(model, r, horizons=(INFINITE,)).fits[INFINITE].values()) for r in judged])
    assert np.abs(found - PAPER_FITS).max() <= CLOSE
