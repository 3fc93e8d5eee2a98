"""A scaling is undone, and survives its storage."""

from __future__ import annotations

import json

import numpy as np
import pytest

from softneck.core import DataError, FileFormatError
from softneck.signals import Scaling

X = np.random.default_rng(0).normal([5.0, -0.1], [2.0, 0.01], (200, 2))


def test_apply_and_invert_are_inverse_and_storage_keeps_every_bit() -> None:
    scaling = Scaling.of(X)
    z = scaling.apply(X)
    # 200 summands: rounding of a few eps, 1e-12 leaves a factor of 100.
    np.testing.assert_allclose([z.mean(axis=0), z.std(axis=0)], [[0, 0], [1, 1]], atol=1e-12)
    np.testing.assert_allclose(scaling.invert(z), X, rtol=1e-13)
    assert Scaling.from_dict(json.loads(json.dumps(scaling.as_dict()))) == scaling


def test_missed_samples_stay_missed_and_count_for_nothing() -> None:
    gaps = np.vstack([X, [[np.nan, np.nan]]])
    assert Scaling.of(gaps) == Scaling.of(X)
    assert np.isnan(Scaling.of(X).apply(gaps)[-1]).all()


@pytest.mark.parametrize("bad", [np.ones((9, 1)), np.full((9, 1), np.nan), np.zeros((0, 1))])
def test_a_column_without_scale_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(DataError, match="column 0 is constant or has no samples"):
        Scaling.of(bad)


def test_what_is_no_scaling() -> None:
    with pytest.raises(DataError, match="as many finite offsets as positive scales"):
        Scaling((0.0,), (-1.0,))
    for content in ({}, {"offset": 1, "scale": [1]}, {"offset": ["x"], "scale": [1]}):
        with pytest.raises(FileFormatError, match="holds no scaling"):
            Scaling.from_dict(content)
