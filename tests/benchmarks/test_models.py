"""Training of the kinds that run free, beside peers: `pytest tests/benchmarks/test_models.py --benchmark-only`.

The same data for all: Eq. 22 on the virtual neck `paper`, 7,000 rows to identify; judged in free run from set-points
alone on the paper's three tests. The peers get what they are fed in their own examples (lagged inputs and outputs) and
a choice of lags by free run on the last fifth of the training rows.
"""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from softneck.core import KINDS, resolve
from softneck.identification import INFINITE, nrmse_fit, validate
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal

TESTS = ("steps", "sine", "rotation")
# Seconds on two idle cores (issue 7) and the least free-run fit of each axis of each test.
LIMITS = {"play": (20.0, 85.0), "nn": (20.0, 50.0), "greybox": (60.0, 90.0)}


@cache
def recordings() -> dict[str, Recording]:
    neck = VirtualNeck(NeckParameters.paper())
    made = {n: record(signal(n), neck, seed=s) for s, n in enumerate(("eq22", *TESTS), start=1)}
    made["train"], made["validation"] = made.pop("eq22").split(0.7)
    return made


@pytest.mark.benchmark(group="train on 7,000 rows")
@pytest.mark.parametrize("kind", LIMITS)
def test_training(benchmark: BenchmarkFixture, kind: str) -> None:
    settings = resolve(KINDS[kind].settings)()
    model = benchmark.pedantic(settings.fit, args=(recordings()["train"],), rounds=1, warmup_rounds=0)
    lowest = []
    for name in ("validation", *TESTS):
        fits = validate(model, recordings()[name], horizons=(INFINITE,)).fits[INFINITE]
        benchmark.extra_info[name] = "/".join(f"{fit:.1f}" for fit in fits.values() if fit is not None)
        lowest.append(min(fit or 0.0 for fit in fits.values()))
    assert min(lowest) >= LIMITS[kind][1]


def lagged(u: np.ndarray, y: np.ndarray, lags: int) -> np.ndarray:
    """Regressors of y(k): both outputs and three set-points, `lags` samples back."""
    both = np.column_stack([y, u])
    return np.column_stack([both[lags - i : len(both) - i] for i in range(1, lags + 1)])


def narx_free_run(predict, u: np.ndarray, y: np.ndarray, lags: int) -> np.ndarray:
    out = y.copy()
    for k in range(25, len(u)):
        past = np.column_stack([out, u])[k - lags : k][::-1]
        # What a peer does outside its data is no fault of numpy's.
        out[k] = np.clip(predict(past.reshape(1, -1))[0], -3.0, 3.0)
    return out


@pytest.mark.benchmark(group="train on 7,000 rows")
def test_scikit_learn_mlp_in_narx_form(benchmark: BenchmarkFixture) -> None:
    pytest.importorskip("sklearn", reason="scikit-learn is no dependency; it is a peer here")
    from sklearn.neural_network import MLPRegressor
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    train = recordings()["train"]
    scale = train.outputs.std(axis=0)

    def fit():
        found = []
        head, tail = train.split(0.8)
        for lags in (2, 5):
            net = make_pipeline(
                StandardScaler(),
                MLPRegressor(
                    hidden_layer_sizes=(25, 25),
                    activation="tanh",
                    solver="lbfgs",
                    alpha=1e-3,
                    max_iter=400,
                    random_state=0,
                ),
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that 400 iterations were not enough, if so
                net.fit(lagged(head.set_points, head.outputs / scale, lags), (head.outputs / scale)[lags:])
            free = narx_free_run(net.predict, tail.set_points, tail.outputs / scale, lags)
            score = min(nrmse_fit((tail.outputs / scale)[25:, i], free[25:, i]) for i in range(2))
            found.append((score, lags, net))
        return max(found, key=lambda one: one[0])

    _, lags, net = benchmark.pedantic(fit, rounds=1)
    free = np.zeros((0, 2))
    for name in ("validation", *TESTS):
        test = recordings()[name]
        free = narx_free_run(net.predict, test.set_points, test.outputs / scale, lags)
        fits = [nrmse_fit((test.outputs / scale)[25:, i], free[25:, i]) for i in range(2)]
        benchmark.extra_info[name] = "/".join(f"{fit:.1f}" for fit in fits)
    assert np.isfinite(free).all()
