"""Offset and scale of channels: taken from data once, stored, and undone exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, FileFormatError, Matrix
from softneck.core._shown import Shown


@dataclass(frozen=True, slots=True, repr=False)
class Scaling(Shown):
    """`z = (x - offset) / scale`, column by column.

    Attributes:
        offset: (columns,) in the unit of x.
        scale: (columns,) in the unit of x, positive.
    """

    offset: tuple[float, ...]
    scale: tuple[float, ...]

    def __post_init__(self) -> None:
        numbers = np.array([*self.offset, *self.scale])
        if len(self.offset) != len(self.scale) or not np.isfinite(numbers).all() or min(self.scale, default=1) <= 0:
            raise DataError(f"a scaling needs as many finite offsets as positive scales; got {self}.")

    @classmethod
    def of(cls, values: Matrix) -> Scaling:
        """Return mean and standard deviation of `values` (time, columns); missed samples are left out.

        Raises:
            DataError: a column is empty or constant.
        """
        values = np.asarray(values, dtype=np.float64)
        for column in range(values.shape[1]):
            seen = values[np.isfinite(values[:, column]), column]
            if seen.size == 0 or seen.min() == seen.max():
                raise DataError(f"column {column} is constant or has no samples, so that it has no scale; drop it.")
        return cls(tuple(np.nanmean(values, axis=0).tolist()), tuple(np.nanstd(values, axis=0).tolist()))

    def apply(self, values: Matrix) -> Matrix:
        """Return z (time, columns) of x."""
        return (np.asarray(values) - np.array(self.offset)) / np.array(self.scale)

    def invert(self, values: Matrix) -> Matrix:
        """Return x (time, columns) of z."""
        return np.asarray(values) * np.array(self.scale) + np.array(self.offset)

    def as_dict(self) -> dict[str, list[float]]:
        """Return what a JSON header holds."""
        return {"offset": list(self.offset), "scale": list(self.scale)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Scaling:
        """Return the scaling that `as_dict` wrote; raise FileFormatError for anything else."""
        try:
            return cls(tuple(map(float, content["offset"])), tuple(map(float, content["scale"])))
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"holds no scaling ({error}).") from error
