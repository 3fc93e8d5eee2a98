"""What form `residual` reaches on the virtual neck, from set-points alone (issue 5)."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.identification import INFINITE, Model, SetMembership, validate
from softneck.signals import Recording

# Measured: 97.6/97.6, 94.8/93.9, 96.9/94.2, 95.9/95.7. The least are what issue 5 asks for.
LEAST = {"validation": 90.0, "steps": 80.0, "sine": 80.0, "rotation": 80.0}


@pytest.fixture(scope="module")
def model(recordings: dict[str, Recording]) -> Model:
    return SetMembership(form="residual").fit(recordings["train"])


@pytest.mark.slow
@pytest.mark.parametrize("name", LEAST)
def test_the_free_run_fits_and_stays_within_its_bounds(
    recordings: dict[str, Recording], model: Model, name: str
) -> None:
    free = validate(model, recordings[name], horizons=(INFINITE,)).fits[INFINITE]
    assert min(fit or 0.0 for fit in free.values()) >= LEAST[name]
    y, Y = recordings[name].outputs[25:], model.simulate(recordings[name])[25:]
    inside = (Y[:, [5, 7]] <= y) & (y <= Y[:, [6, 8]])
    assert inside.mean() >= 0.97


@pytest.mark.slow
def test_bounds_widen_where_nothing_was_seen(recordings: dict[str, Recording], model: Model) -> None:
    known, new = (model.simulate(recordings[name])[25:] for name in ("validation", "rotation"))
    widths = [np.mean(Y[:, [6, 8]] - Y[:, [5, 7]]) for Y in (known, new)]
    assert widths[1] > 3.0 * widths[0]
