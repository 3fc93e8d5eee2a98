"""EDMD with inputs (Korda and Mezic 2018): monomials of delayed outputs and inputs, advanced by ridge regression.

The lifted state is computed anew from its own outputs in each sample; delays, degree and ridge are chosen by free run.
"""

from __future__ import annotations

import itertools

import numpy as np
from exchange import HOLD_OUT, WARM_UP, FreeRun, Runs, answer, fit, heads_and_tails

DELAYS, DEGREES, RIDGES = ((1, 2, 4), (1, 2, 4, 8), (1, 2, 3, 5, 8, 13)), (1, 2), (1e-4, 1e-2, 1.0)


def lifted(w: np.ndarray, degree: int) -> np.ndarray:
    """Return 1, w and, of degree 2, all products of two entries; `w` (..., n)."""
    parts = [np.ones((*w.shape[:-1], 1)), w]
    if degree == 2:
        i, j = np.triu_indices(w.shape[-1])
        parts.append(w[..., i] * w[..., j])
    return np.concatenate(parts, axis=-1)


def delayed(u: np.ndarray, y: np.ndarray, delays: tuple[int, ...]) -> np.ndarray:
    """Return outputs and inputs some samples before each row behind the warm-up (time - WARM_UP, n)."""
    return np.hstack([x[WARM_UP - d : len(x) - d] for d in delays for x in (y, u)])


def trained(runs: Runs, form: tuple) -> np.ndarray:
    """Return the map (lifted, outputs) of ridge regression to the change of the outputs."""
    delays, degree, ridge = form
    X = np.vstack([lifted(delayed(u, y, delays), degree) for u, y in runs])
    D = np.vstack([y[WARM_UP:] - y[WARM_UP - 1 : -1] for _, y in runs])
    return np.linalg.solve(X.T @ X + ridge * np.eye(X.shape[1]), X.T @ D)


def free_run(K: np.ndarray, form: tuple, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the free run (time, outputs) behind the given rows."""
    out = y.copy()
    for k in range(WARM_UP, len(u)):
        w = np.concatenate([x[k - d] for d in form[0] for x in (out, u)])
        out[k] = np.clip(out[k - 1] + lifted(w, form[1]) @ K, -10.0, 10.0)
    return out


def train(runs: Runs, seed: int) -> tuple[FreeRun, str]:
    """Choose by free run on the last fifth of each run, then train on all rows; it has no random start."""
    del seed
    sizes = [np.vstack(part).std(axis=0) for part in zip(*runs, strict=True)]
    scaled = [(u / sizes[0], y / sizes[1]) for u, y in runs]
    heads, tails = heads_and_tails(scaled, HOLD_OUT)
    tried = []
    for form in itertools.product(DELAYS, DEGREES, RIDGES):
        K = trained(heads, form)
        tried.append((np.mean([fit(y, free_run(K, form, u, y)) for u, y in tails]), form))
    form = max(tried)[1]
    K = trained(scaled, form)

    def run(u: np.ndarray, y: np.ndarray) -> np.ndarray:
        return sizes[1] * free_run(K, form, u / sizes[0], y / sizes[1])

    return run, f"delays {form[0]}, degree {form[1]}, ridge {form[2]:g}"


if __name__ == "__main__":
    answer(train, "numpy")
