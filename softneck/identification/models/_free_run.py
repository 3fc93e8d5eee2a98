"""The free run of one output, by which dead times are chosen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import DataError, Matrix, Vector

from ._model import WARM_UP
from ._scores import nrmse_fit


def delay_samples(
    delay: float | None, max_delay: float, sample_time: float, runs: Sequence[tuple[Matrix, Matrix]]
) -> list[int]:
    """Return the dead times to try, in samples.

    Raises:
        DataError: a given one is longer than every run.
    """
    longest = max(len(Y) for Y, _ in runs)
    if delay is None:
        return list(range(max(min(round(max_delay / sample_time), longest - 3), 0) + 1))
    samples = round(delay / sample_time)
    if samples >= longest:
        raise DataError(
            f"a dead time of {delay:g} s is longer than the longest run, {longest * sample_time:g} s; "
            "lower `delay` or record longer."
        )
    return [samples]


def free_run_fit(runs: Sequence[tuple[Matrix, Matrix]], a: Vector, B: Matrix, d: int) -> float:
    """Return the simulation fit [%] of the first output over all runs; -inf where the model is unstable.

    Args:
        runs: outputs (time, ny) and inputs (time, nu).
        a: (na,) denominator without its leading one.
        B: (nu, nb) numerators.
        d: dead time in samples.
    """
    from scipy.signal import lfilter, lfiltic

    denominator = np.concatenate([[1.0], a])
    if np.abs(np.roots(denominator)).max(initial=0.0) >= 1.0:
        return -np.inf
    measured, simulated = [], []
    for Y, U in runs:
        y = Y[:, 0]
        there = np.isfinite(y)
        total = np.zeros(len(U))
        # The first input carries the start from the first measured output, the others start as if held before.
        for j, b in enumerate(B):
            numerator = np.concatenate([np.zeros(1 + d), b])
            y0 = y[np.argmax(there)] if j == 0 and there.any() else 0.0
            zi = lfiltic(numerator, denominator, np.full(a.size, y0), np.full(numerator.size, U[0, j]))
            total += lfilter(numerator, denominator, U[:, j], zi=zi)[0]
        measured.append(y[WARM_UP:])
        simulated.append(total[WARM_UP:])
    return nrmse_fit(np.concatenate(measured), np.concatenate(simulated))
