"""Result arrays that carry their time, channels and units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import DataError, Vector, require_package, resolve

if TYPE_CHECKING:
    import pandas as pd
    import xarray  # pyright: ignore[reportMissingImports]  an extra
    from matplotlib.figure import Figure


class Labelled(np.ndarray):
    """Channels over time (time, channels) in SI; a computed result or a slice has no labels.

    `time`: (time,) [s]. `units`: channel -> unit.
    """

    time: Vector
    units: Mapping[str, str]

    def __new__(cls, values: ArrayLike, time: Vector, units: Mapping[str, str]) -> Labelled:
        """Label `values` (time, channels); `units` names the channels in their order."""
        made = np.asarray(values, dtype=np.float64).view(cls)
        if made.shape != (len(time), len(units)):
            raise DataError(f"labels of {len(time)} times and {len(units)} channels do not fit {made.shape}.")
        made.time, made.units = time, dict(units)
        return made

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        plain = np.asarray(array)
        return plain[()] if return_scalar else plain

    def __getitem__(self, key: Any) -> Any:
        """Return rows and columns as of any array, or one channel (time,) by its name."""
        if isinstance(key, str):
            if key not in self.channels:
                raise DataError(f"no channel `{key}`; there are {', '.join(self.channels)}.")
            key = (slice(None), self.channels.index(key))
        return np.asarray(self)[key]

    def __reduce__(self) -> Any:
        return np.asarray(self).__reduce__()

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self.units) if hasattr(self, "units") else ()

    def to_pandas(self) -> pd.DataFrame:
        """Return a table over time [s] with a column in SI for each channel; `attrs["units"]` holds the units."""
        return table(*self._parts())

    def to_xarray(self) -> xarray.Dataset:
        """Return a Dataset over `time`, each channel with its unit; needs the extra `xarray`."""
        return dataset(*self._parts())

    def plot(self, title: str = "") -> Figure:
        """Return a matplotlib figure with one panel for each unit; angles in degrees."""
        # Plots are a layer above signals, so that they are resolved by name.
        return resolve("softneck.plots:signals_figure")(*self._parts(), title)

    def __repr__(self) -> str:
        if not self.channels:
            return repr(np.asarray(self))
        span = f"{self.time[0]:g} to {self.time[-1]:g} s" if len(self) else "no rows"
        text = ", ".join(f"{name} [{unit}]" for name, unit in self.units.items())
        return f"{len(self)} rows over {span}: {text if len(text) < 200 else f'{len(self.units)} channels'}"

    def _parts(self) -> tuple[Vector, dict[str, Vector], Mapping[str, str]]:
        if not self.channels:
            raise DataError("this is a part of a result, without its labels; use the whole result.")
        return self.time, {name: self[name] for name in self.channels}, self.units


def table(time: Vector, columns: Mapping[str, Vector], units: Mapping[str, str]) -> pd.DataFrame:
    """Return channels as a table over time [s]."""
    import pandas as pd

    frame = pd.DataFrame(dict(columns), index=pd.Index(time, name="time [s]"))
    frame.attrs["units"] = dict(units)
    return frame


def dataset(time: Vector, columns: Mapping[str, Vector], units: Mapping[str, str]) -> xarray.Dataset:
    """Return channels as a Dataset over `time`, each with its unit."""
    require_package("xarray")
    import xarray  # pyright: ignore[reportMissingImports]  an extra

    found = {name: ("time", values, {"units": units[name]}) for name, values in columns.items()}
    return xarray.Dataset(found, coords={"time": ("time", time, {"units": "s"})})
