"""N4SID (Van Overschee and De Moor 1996, combined algorithm 2): oblique projection, A and C by its shift.

Inputs and the start enter by least squares of the simulation, which is linear in them; horizon and order are chosen by
free run.
"""

from __future__ import annotations

import numpy as np
from exchange import HOLD_OUT, WARM_UP, FreeRun, Runs, answer, fit, heads_and_tails

HORIZONS, ORDERS = (10, 20, 30), (2, 3, 4, 5, 6, 8, 10)
# Poles that came out unstable are moved inside: the simulation has to stay finite.
LARGEST_POLE = 0.999
System = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def hankel(x: np.ndarray, rows: int) -> np.ndarray:
    """Return the block Hankel matrix (rows * channels, columns) of x (time, channels)."""
    columns = len(x) - rows + 1
    return np.vstack([x[i : i + columns].T for i in range(rows)])


def observability(runs: Runs, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Return left singular vectors and values of the oblique projection of future outputs along future inputs."""
    U = np.hstack([hankel(u, 2 * i) for u, _ in runs])
    Y = np.hstack([hankel(y, 2 * i) for _, y in runs])
    m, p = runs[0][0].shape[1], runs[0][1].shape[1]
    past = np.vstack([U[: m * i], Y[: p * i]])
    stacked = np.vstack([U[m * i :], past, Y[p * i :]])
    L = np.linalg.qr(stacked.T, mode="r").T
    a, b = m * i, m * i + len(past)
    # Future outputs are L[b:, :b] times inverse(L[:b, :b]) times future inputs and the past: the past's share is kept.
    theta = np.linalg.lstsq(L[:b, :b].T, L[b:, :b].T, rcond=None)[0].T
    projection = theta[:, a:] @ L[a:b, :b]
    vectors, values, _ = np.linalg.svd(projection, full_matrices=False)
    return vectors, values


def poles_inside(A: np.ndarray) -> np.ndarray:
    """Return A with unstable poles moved inside the unit circle."""
    values, vectors = np.linalg.eig(A)
    size = np.abs(values)
    values = np.where(size > LARGEST_POLE, values / np.maximum(size, 1e-12) * LARGEST_POLE, values)
    return np.real(vectors @ np.diag(values) @ np.linalg.inv(vectors))


def regressors(A: np.ndarray, C: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the outputs (time, p, n) that each entry of the start gives, and (time, p, n m + p m) of B and D."""
    (p, n), m = C.shape, u.shape[1]
    start, driven = np.eye(n), np.zeros((n, n * m))
    from_start, from_inputs = [], []
    for row in u:
        from_start.append(C @ start)
        from_inputs.append(np.hstack([C @ driven, np.kron(np.eye(p), row)]))
        start, driven = A @ start, A @ driven + np.kron(np.eye(n), row)
    return np.array(from_start), np.array(from_inputs)


def trained(runs: Runs, known: tuple[np.ndarray, np.ndarray], order: int) -> System:
    """Return A, B, C, D of an order."""
    p, m = runs[0][1].shape[1], runs[0][0].shape[1]
    gamma = known[0][:, :order] * np.sqrt(known[1][:order])
    A, C = poles_inside(np.linalg.lstsq(gamma[:-p], gamma[p:], rcond=None)[0]), gamma[:p]
    parts = [regressors(A, C, u) for u, _ in runs]
    starts = [np.zeros((len(u), p, order * len(runs))) for u, _ in runs]
    for number, (from_start, _) in enumerate(parts):
        starts[number][:, :, number * order : (number + 1) * order] = from_start
    X = np.vstack([np.concatenate(pair, axis=2).reshape(-1, order * len(runs) + m * (order + p))
                   for pair in zip(starts, (inputs for _, inputs in parts), strict=True)])  # fmt: skip
    y = np.concatenate([y.ravel() for _, y in runs])
    found = np.linalg.lstsq(X, y, rcond=None)[0][order * len(runs) :]
    return A, found[: order * m].reshape(order, m), C, found[order * m :].reshape(p, m)


def free_run(system: System, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the free run (time, outputs); the start is that which explains the given rows best."""
    A, B, C, D = system
    from_start, from_inputs = regressors(A, C, u[:WARM_UP])
    driven = from_inputs @ np.concatenate([B.ravel(), D.ravel()])
    x = np.linalg.lstsq(from_start.reshape(-1, len(A)), (y[:WARM_UP] - driven).ravel(), rcond=None)[0]
    out = []
    for row in u:
        out.append(C @ x + D @ row)
        x = A @ x + B @ row
    return np.array(out)


def train(runs: Runs, seed: int) -> tuple[FreeRun, str]:
    """Choose by free run on the last fifth of each run, then train on all rows; it has no random start."""
    del seed
    means, sizes = zip(*((x.mean(axis=0), x.std(axis=0)) for x in map(np.vstack, zip(*runs, strict=True))), strict=True)
    scaled = [((u - means[0]) / sizes[0], (y - means[1]) / sizes[1]) for u, y in runs]
    heads, tails = heads_and_tails(scaled, HOLD_OUT)
    tried = []
    for horizon in HORIZONS:
        known = observability(heads, horizon)
        for order in ORDERS:
            system = trained(heads, known, order)
            tried.append((np.mean([fit(y, free_run(system, u, y)) for u, y in tails]), horizon, order))
    _, horizon, order = max(tried)
    system = trained(scaled, observability(scaled, horizon), order)

    def run(u: np.ndarray, y: np.ndarray) -> np.ndarray:
        free = free_run(system, (u - means[0]) / sizes[0], (y - means[1]) / sizes[1])
        return means[1] + sizes[1] * free

    return run, f"horizon {horizon}, order {order}"


if __name__ == "__main__":
    answer(train, "numpy")
