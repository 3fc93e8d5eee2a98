"""What stands beside every model: persistence, the best linear one, and the noise ceiling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.signals import Recording

from ..models._scores import nrmse_fit
from ._best_linear import best_linear
from ._noise_ceiling import noise_ceiling
from ._persistence import persistence
from ._scored_rows import Rows, ScoredStretch

_AXES = ("pitch", "roll")


@dataclass(frozen=True, slots=True, eq=False)
class Baselines:
    """Fits [%] of persistence and the best linear model, horizon -> axis -> fit; of a perfect one, axis -> fit."""

    persistence: dict[str, dict[str, float | None]]
    best_linear: dict[str, dict[str, float | None]]
    noise_ceiling: dict[str, float | None]


def baselines(
    recording: Recording, stretches: Sequence[ScoredStretch], rows: Rows, horizons: Sequence[int | str]
) -> Baselines:
    """Return the baselines of the stretches judged; repeats are looked for in all of the recording."""
    names = [str(h) for h in horizons]
    steps = [None if h == "inf" else int(h) for h in horizons]
    bounds = best_linear(stretches, rows, steps)
    held: dict[str, dict[str, float | None]] = {}
    for name, k in zip(names, steps, strict=True):
        if k is not None:
            predicted = np.concatenate([persistence(stretch.recording, k) for stretch in stretches])
            pairs = zip(rows.judged(k).T, predicted.T, strict=True)
            held[name] = _by_axis([nrmse_fit(y, yhat) for y, yhat in pairs])
    return Baselines(
        persistence=held,
        best_linear={name: _by_axis(fits) for name, fits in zip(names, bounds, strict=True)},
        noise_ceiling=_by_axis(noise_ceiling(recording, rows.measured)),
    )


def _by_axis(fits: Sequence[float | None]) -> dict[str, float | None]:
    return {a: f if f is not None and np.isfinite(f) else None for a, f in zip(_AXES, fits, strict=True)}
