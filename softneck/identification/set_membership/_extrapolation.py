"""Whether a model of kind `nlsm` is asked for what it has never seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector

from ..models._model import WARM_UP, Model
from ._cones import usual_width
from ._forest import all_cores, plant

_FINDING = "usual_half_width_deg"
# As `Cones.usual`.
_QUANTILE = 0.99


def usual_widths(data: Sequence[tuple[Matrix, Vector]], gamma: Vector, epsilon: Vector) -> dict[str, list[float]]:
    """Return the finding: each axis' half-width [deg] that 99 % of the training rows stay below, see `Cones.usual`.

    Args:
        data: scaled regressors (n, N) and targets (N,) of each axis, in order of time.
        gamma: (2,).
        epsilon: (2,) [rad].
    """
    widths = []
    for axis, (points, values) in enumerate(data):
        tree = plant(np.array(points, order="C"), values[None].copy(), np.arange(values.size, dtype=np.float64))
        # Half a second on either side is the same motion; less where there is hardly more than that.
        usual = (min(WARM_UP, values.size // 8), _QUANTILE)
        widths.append(epsilon[axis] + usual_width(tree, 0, gamma[axis : axis + 1], usual, all_cores()))
    return {_FINDING: np.degrees(widths).tolist()}


def knows_what_it_saw(model: Model) -> bool:
    """Return whether `outside_seen` can judge by this model."""
    return _FINDING in model.findings


def outside_seen(model: Model, outputs: Matrix) -> np.ndarray:
    """Return (rows, 2) whether the bounds of pitch and of roll are wider than the training data's usually are.

    Args:
        model: of kind `nlsm`.
        outputs: (rows, 9) what `model.simulate` or `model.predict` returned.

    Raises:
        SettingsError: a model without bounds, or one identified before this was learned.
    """
    if not knows_what_it_saw(model):
        raise SettingsError("only a model of kind nlsm knows what it has seen; identify one (again).")
    if outputs.ndim != 2 or outputs.shape[1] != 9:
        raise DataError(f"`outputs` must be (rows, 9), as a model of kind nlsm returns; got {outputs.shape}.")
    half = 0.5 * (outputs[:, [6, 8]] - outputs[:, [5, 7]])
    return half > np.radians(model.findings[_FINDING])
