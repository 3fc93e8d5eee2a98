# pyright: reportMissingImports=false
"""jax-sysid (Bemporad 2024): neural state space, Adam, then L-BFGS-B, started from its own linear model.

Number of states and penalty are chosen by free run on the last fifth of the rows.
"""

from __future__ import annotations

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_thunk_runtime=false")

import jax.numpy as jnp
import numpy as np
from exchange import HOLD_OUT, WARM_UP, FreeRun, Runs, answer, fit, heads_and_tails
from jax_sysid.models import LinearModel, Model

STATES, PENALTIES = (4, 6), (1e-5, 1e-4)
NEURONS = 10
ADAM, LBFGS = 200, 600


def trained(u: list[np.ndarray], y: list[np.ndarray], states: int, penalty: float, seed: int) -> Model:
    """Return a model of scaled data: `x+ = A x + B u + E tanh(F x + G u + h)`, `y = C x + c`."""
    linear = LinearModel(states, 2, 3, feedthrough=False)
    linear.loss(rho_x0=1e-4, rho_th=1e-5)
    linear.optimization(adam_epochs=0, lbfgs_epochs=500, iprint=-1)
    linear.fit(y, u)
    A, B, C = (np.asarray(part) for part in linear.params[:3])

    # jax-sysid calls them by these names.
    def state(x, u, params):
        A, B, E, F, G, h = params[:6]
        return A @ x + B @ u + E @ jnp.tanh(F @ x + G @ u + h)

    def output(x, u, params):
        del u
        return params[6] @ x + params[7]

    rng = np.random.default_rng(seed)
    model = Model(states, 2, 3, state_fcn=state, output_fcn=output)
    model.init(params=[
        A, B, 0.01 * rng.standard_normal((states, NEURONS)), 0.3 * rng.standard_normal((NEURONS, states)),
        0.3 * rng.standard_normal((NEURONS, 3)), 0.3 * rng.standard_normal(NEURONS), C, np.zeros(2),
    ])  # fmt: skip
    model.loss(rho_x0=1e-4, rho_th=penalty)
    model.optimization(adam_eta=1e-3, adam_epochs=ADAM, lbfgs_epochs=LBFGS, memory=20, iprint=-1)
    model.fit(y, u)
    return model


def separate(runs: Runs) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the inputs and the outputs of all runs: jax-sysid takes a list of each."""
    return [u for u, _ in runs], [y for _, y in runs]


def free_run(model: Model, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the free run (time, 2); its start is found from the given rows by jax-sysid's smoother."""
    x0 = model.learn_x0(u[:WARM_UP], y[:WARM_UP], RTS_epochs=10, verbosity=False)
    return np.asarray(model.predict(np.asarray(x0), u)[0])


def train(runs: Runs, seed: int) -> tuple[FreeRun, str]:
    """Choose by free run on the last fifth of each run, then train on all rows."""
    U, Y = (np.vstack(part) for part in zip(*runs, strict=True))
    spread, middle, size = U.std(axis=0), Y.mean(axis=0), Y.std(axis=0)
    scaled = [(u / spread, (y - middle) / size) for u, y in runs]
    heads, tails = heads_and_tails(scaled, HOLD_OUT)
    tried = []
    for states in STATES:
        for penalty in PENALTIES:
            model = trained(*separate(heads), states, penalty, seed)
            fits = [fit(y, np.nan_to_num(free_run(model, u, y), nan=1e3)) for u, y in tails]
            tried.append((np.mean(fits), states, penalty))
    _, states, penalty = max(tried)
    model = trained(*separate(scaled), states, penalty, seed)

    def run(u: np.ndarray, y: np.ndarray) -> np.ndarray:
        return middle + size * free_run(model, u / spread, (y - middle) / size)

    return run, f"{states} states, {NEURONS} neurons, penalty {penalty:g}"


if __name__ == "__main__":
    answer(train, "jax-sysid", "jax", "numpy")
