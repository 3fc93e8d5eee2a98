"""Labelled results are arrays that know their time, channels and units."""

from __future__ import annotations

import pickle
from importlib.util import find_spec
from typing import Any

import numba
import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.identification import Model
from softneck.signals import Recording
from softneck.signals.recording._labelled import Labelled


@pytest.fixture(scope="module")
def free(models: dict[str, Model], neck: Recording) -> Labelled:
    return models["rls"].simulate(neck.rows(0, 300))


def test_it_is_the_array_that_it_was(free: Labelled, models: dict[str, Model], neck: Recording) -> None:
    plain = np.asarray(free)
    assert type(plain) is np.ndarray
    for cut in (free[0], free[:, 0], free[10:20], free[free[:, 0] > 0], free[..., :2], free[3, 1]):
        assert not isinstance(cut, Labelled)
    np.testing.assert_array_equal(free[10:20, 1], plain[10:20, 1])
    for made in (free - plain, free.mean(axis=0), np.abs(free), 2 * free, free == plain, np.sqrt(free**2)):
        assert getattr(made, "channels", ()) == () or made.shape == free.shape
    assert float(np.abs(free - plain).max()) == 0.0
    assert isinstance(np.add.reduce(free, axis=None), np.float64)
    assert isinstance(free.max(), np.float64)
    assert free.T.shape == plain.T.shape
    assert np.concatenate([free, free]).shape == (2 * len(plain), plain.shape[1])
    again = pickle.loads(pickle.dumps(free))  # noqa: S301  as workers are sent it: a plain array
    np.testing.assert_array_equal(again, plain)
    ahead = models["rls"].predict(neck.rows(0, 300), 5)
    assert ahead.channels == free.channels


def test_compiled_functions_take_it(free: Labelled) -> None:
    total: Any = numba.njit(lambda a: a[:, 0].sum())
    assert total(free) == total(np.asarray(free))


def test_channels_are_found_by_name_and_what_is_cut_out_has_none(free: Labelled) -> None:
    assert free.channels[:2] == ("pitch", "roll")
    assert free.units["pitch"] == "rad"
    np.testing.assert_array_equal(free["roll"], free[:, 1])
    assert free.T.channels == free[:, :2].view(Labelled).channels == ()
    with pytest.raises(DataError, match="no channel `yaw`; there are pitch, roll"):
        free["yaw"]


def test_tables_hold_every_channel_over_its_time(free: Labelled, neck: Recording) -> None:
    frame = free.to_pandas()
    assert tuple(frame.columns) == free.channels
    np.testing.assert_array_equal(frame.index, neck.time[:300])
    np.testing.assert_array_equal(frame.to_numpy(), free)
    assert frame.attrs["units"] == dict(free.units)


def test_xarray_has_units_or_is_asked_for_in_a_line(free: Labelled) -> None:
    if find_spec("xarray") is None:
        with pytest.raises(SettingsError, match=r"pip install 'softneck\[xarray\]'"):
            free.to_xarray()
        return
    data = free.to_xarray()
    assert data["pitch"].attrs["units"] == "rad"
    np.testing.assert_array_equal(data["pitch"].values, free["pitch"])
    assert data["pitch"].dims == ("time",)


def test_a_figure_has_a_panel_for_each_unit_and_shows_degrees(free: Labelled) -> None:
    axes = free.plot("free run").axes
    assert len(axes) == len(set(free.units.values()))
    assert "[deg]" in axes[0].get_ylabel()
    (pitch,) = [line for line in axes[0].lines if line.get_label() == "pitch"]
    np.testing.assert_allclose(np.asarray(pitch.get_ydata(), dtype=float), np.degrees(free["pitch"]), rtol=1e-12)


def test_it_shows_itself_in_a_line(free: Labelled) -> None:
    assert repr(free).startswith("300 rows over 0 to 5.98 s: pitch [rad], roll [rad]")
    assert len(repr(free).splitlines()) <= 3
    assert repr(free.T).startswith("array(")
    assert repr(Labelled(np.zeros((0, 1)), np.zeros(0), {"x": "m"})) == "0 rows over no rows: x [m]"
    # A text of 199 characters is told, of 200 the channels are counted.
    for letters, told in ((94, f"{'x' * 95} [m], {'y' * 94} [m]"), (95, "2 channels")):
        units = {"x" * 95: "m", "y" * letters: "m"}
        text = repr(Labelled(np.zeros((2, 2)), np.array([1.0, 2.5]), units))
        assert text == f"2 rows over 1 to 2.5 s: {told}"
    with pytest.raises(DataError, match="without its labels"):
        free.T.to_pandas()


def test_labels_that_do_not_fit_are_refused() -> None:
    with pytest.raises(DataError, match="do not fit"):
        Labelled(np.zeros((3, 2)), np.zeros(3), {"pitch": "rad"})
    with pytest.raises(DataError, match=r"labels of 2 times and 2 channels do not fit \(3, 2\)"):
        Labelled(np.zeros((3, 2)), np.zeros(2), {"pitch": "rad", "roll": "rad"})
