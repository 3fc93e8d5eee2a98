"""Times beyond any log are refused in one line, before memory is taken for them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from softneck.core import DataError, SettingsError
from softneck.signals.importing.formats._text import seconds
from softneck.signals.recording._resampling import resampled

from ..data import neck_recording


def test_dates_of_any_year_are_seconds_and_a_span_beyond_nanoseconds_is_refused() -> None:
    late = pd.Series([f"9999-12-31 23:59:{0.02 * k:09.6f}" for k in range(50)])
    np.testing.assert_array_equal(seconds(late, "t"), np.arange(50) * 20_000_000 / 1e9)
    with pytest.raises(DataError, match="`t` spans more than 292 years"):
        seconds(pd.Series(["0001-01-01 00:00:00", *late]), "t")


@pytest.mark.parametrize("step", [1e-300, 5e-324, 1e-9])
def test_too_many_rows_are_refused(step: float) -> None:
    with pytest.raises(SettingsError, match=r"`time` of 5\.98 s at .* s a step would be .* rows; at most "):
        resampled(neck_recording(300), step)
