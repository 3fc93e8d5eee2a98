# pyright: reportMissingImports=false
"""SysIdentPy's FROLS: polynomial NARX, terms chosen by error reduction ratio; degree, lags and number by free run."""

from __future__ import annotations

import warnings

import numpy as np
from exchange import HOLD_OUT, WARM_UP, FreeRun, answer, finite, fit
from sysidentpy.basis_function import Polynomial
from sysidentpy.model_structure_selection import FROLS
from sysidentpy.parameter_estimation import LeastSquares

# Degree, lags of the inputs, terms.
FORMS = ((1, 5, 15), (2, 3, 15), (2, 5, 15), (2, 5, 25), (2, 3, 40))


def fitted(u: np.ndarray, y: np.ndarray, form: tuple[int, int, int]) -> FROLS:
    """Return one axis' model, y (time, 1)."""
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


def train(u: np.ndarray, y: np.ndarray, seed: int) -> tuple[FreeRun, str]:
    """Choose by free run on the last fifth, then fit on all rows; it has no random start."""
    del seed
    scale, cut = y.std(axis=0), round((1.0 - HOLD_OUT) * len(u))
    models, chosen = [], []
    for axis in range(2):
        z = y[:, axis : axis + 1] / scale[axis]
        tried = []
        for form in FORMS:
            free = finite(free_run(fitted(u[:cut], z[:cut], form), u[cut:], z[cut:]))
            tried.append((fit(z[cut:], free[:, None]), form))
        best = max(tried)[1]
        chosen.append(f"degree {best[0]}, lags {best[1]}, {best[2]} terms")
        models.append(fitted(u, z, best))

    def run(u: np.ndarray, y: np.ndarray) -> np.ndarray:
        parts = [free_run(model, u, y[:, [a]] / scale[a]) * scale[a] for a, model in enumerate(models)]
        return np.column_stack(parts)

    return run, "; ".join(chosen)


if __name__ == "__main__":
    answer(train, "sysidentpy", "numpy")
