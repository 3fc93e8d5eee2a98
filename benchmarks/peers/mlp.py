# pyright: reportMissingImports=false
"""scikit-learn's MLP in NARX form: lags and penalty chosen by free run, then trained on all rows."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
from exchange import HOLD_OUT, WARM_UP, FreeRun, Runs, answer, fit, heads_and_tails
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

LAGS, ALPHAS = (2, 5, 10), (1e-3, 1e-1)


def lagged(u: np.ndarray, y: np.ndarray, lags: int) -> np.ndarray:
    """Return the regressors of y(k): both outputs and three set-points, `lags` samples back."""
    both = np.column_stack([y, u])
    return np.column_stack([both[lags - i : len(both) - i] for i in range(1, lags + 1)])


def trained(runs: Runs, lags: int, alpha: float, seed: int):
    """Return the network of scaled outputs."""
    network = MLPRegressor(
        hidden_layer_sizes=(25, 25), activation="tanh", solver="lbfgs", alpha=alpha, max_iter=400, random_state=seed
    )
    model = make_pipeline(StandardScaler(), network)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that 400 iterations were not enough, if so
        model.fit(np.vstack([lagged(u, y, lags) for u, y in runs]), np.vstack([y[lags:] for _, y in runs]))
    return model


def free_run(model, u: np.ndarray, y: np.ndarray, lags: int) -> np.ndarray:
    """Return the free run (time, 2), kept within three times the training outputs' spread."""
    scaler, network = model[0], model[1]
    layers = list(zip(network.coefs_, network.intercepts_, strict=True))
    out = y.copy()
    for k in range(WARM_UP, len(u)):
        x = (np.column_stack([out[k - lags : k], u[k - lags : k]])[::-1].ravel() - scaler.mean_) / scaler.scale_
        for W, b in layers[:-1]:
            x = np.tanh(x @ W + b)
        out[k] = np.clip(x @ layers[-1][0] + layers[-1][1], -6.0, 6.0)
    return out


def train(runs: Runs, seed: int) -> tuple[FreeRun, str]:
    """Choose by free run on the last fifth of each run, then train on all rows."""
    scale = np.vstack([y for _, y in runs]).std(axis=0)
    scaled = [(u, y / scale) for u, y in runs]
    heads, tails = heads_and_tails(scaled, HOLD_OUT)
    tried = []
    for lags, alpha in itertools.product(LAGS, ALPHAS):
        model = trained(heads, lags, alpha, seed)
        tried.append((np.mean([fit(y, free_run(model, u, y, lags)) for u, y in tails]), lags, alpha))
    _, lags, alpha = max(tried)
    model = trained(scaled, lags, alpha, seed)

    def run(u: np.ndarray, y: np.ndarray) -> np.ndarray:
        return scale * free_run(model, u, y / scale, lags)

    return run, f"lags {lags}, alpha {alpha:g}"


if __name__ == "__main__":
    answer(train, "scikit-learn", "numpy")
