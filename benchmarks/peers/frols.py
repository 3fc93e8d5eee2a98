# pyright: reportMissingImports=false
"""SysIdentPy's FROLS: polynomial NARX, terms chosen by error reduction ratio; degree, lags and number by free run."""

from __future__ import annotations

import warnings

import numpy as np
from exchange import HOLD_OUT, WARM_UP, FreeRun, Runs, answer, finite, fit, heads_and_tails
from sysidentpy.basis_function import Polynomial
from sysidentpy.model_structure_selection import FROLS
from sysidentpy.parameter_estimation import LeastSquares

# Degree, lags of the inputs, terms.
FORMS = ((1, 5, 15), (2, 3, 15), (2, 5, 15), (2, 5, 25), (2, 3, 40))


def fitted(u: np.ndarray, y: np.ndarray, form: tuple[int, int, int]) -> FROLS:
    """Return one axis' model, y (time, 1). It takes one run: several are joined."""
    degree, lag, terms = form
    model = FROLS(
        order_selection=False,
        n_terms=terms,
        ylag=2,
        xlag=[list(range(1, lag + 1))] * 3,
        basis_function=Polynomial(degree=degree),
        estimator=LeastSquares(),
    )
    model.fit(X=u, y=y)
    return model


def free_run(model: FROLS, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the free run (time,) behind the given rows."""
    begin = WARM_UP - model.max_lag
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of overflow where it diverges
        out = model.predict(X=u[begin:], y=y[begin:WARM_UP])
    return np.concatenate([y[:WARM_UP, 0], out[model.max_lag :, 0]])


def train(runs: Runs, seed: int) -> tuple[FreeRun, str]:
    """Choose by free run on the last fifth of each run, then fit on all rows; it has no random start."""
    del seed
    heads, tails = heads_and_tails(runs, HOLD_OUT)
    (u, y), (u_head, y_head) = (tuple(map(np.vstack, zip(*part, strict=True))) for part in (runs, heads))
    scale = y.std(axis=0)
    models, chosen = [], []
    for axis in range(2):
        z = y[:, [axis]] / scale[axis]
        tried = []
        for form in FORMS:
            model = fitted(u_head, y_head[:, [axis]] / scale[axis], form)
            free = [(w[:, [axis]] / scale[axis], v) for v, w in tails]
            tried.append((np.mean([fit(w, finite(free_run(model, v, w))[:, None]) for w, v in free]), form))
        best = max(tried)[1]
        chosen.append(f"degree {best[0]}, lags {best[1]}, {best[2]} terms")
        models.append(fitted(u, z, best))

    def run(u: np.ndarray, y: np.ndarray) -> np.ndarray:
        parts = [free_run(model, u, y[:, [a]] / scale[a]) * scale[a] for a, model in enumerate(models)]
        return np.column_stack(parts)

    return run, "; ".join(chosen)


if __name__ == "__main__":
    answer(train, "sysidentpy", "numpy")
