"""What a peer reads and writes: recordings in, free runs out, its choices made by the last fifth of the training rows.

`python PEER.py DATA.npz RESULT.npz SEED` runs in the peer's own environment; DATA holds `u_NAME` (time, 3) and `y_NAME`
(time, 2) for `train_1`, `train_2`, .. and what to run free on. The first 25 outputs of each are given, as to every kind
of ours.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version

import numpy as np

WARM_UP = 25
HOLD_OUT = 0.2
FARTHEST = 1e3

FreeRun = Callable[[np.ndarray, np.ndarray], np.ndarray]
Runs = list[tuple[np.ndarray, np.ndarray]]


def heads_and_tails(runs: Runs, share: float) -> tuple[Runs, Runs]:
    """Return the first part of each run, and its last `share`."""
    cuts = [round((1.0 - share) * len(u)) for u, _ in runs]
    heads = [(u[:cut], y[:cut]) for (u, y), cut in zip(runs, cuts, strict=True)]
    return heads, [(u[cut:], y[cut:]) for (u, y), cut in zip(runs, cuts, strict=True)]


def fit(y: np.ndarray, free: np.ndarray) -> float:
    """Return the mean of both axes' fits [%] behind the given rows."""
    y, free = y[WARM_UP:], free[WARM_UP:]
    return float(np.mean(100.0 * (1.0 - np.linalg.norm(y - free, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0))))


def finite(free: np.ndarray) -> np.ndarray:
    """Return a free run whose divergence is a large number."""
    return np.clip(np.nan_to_num(free, nan=FARTHEST), -FARTHEST, FARTHEST)


def answer(train: Callable[[Runs, int], tuple[FreeRun, str]], *packages: str) -> None:
    """Train the peer, run it free on everything, and write the outputs.

    Args:
        train: from runs of set-points and outputs, and a seed, to a free run and a word on what was chosen.
        packages: whose versions to state.
    """
    source, target, seed = sys.argv[1:4]
    data = np.load(source)
    names = [name[2:] for name in data.files if name.startswith("u_")]
    runs = [(data[f"u_{name}"], data[f"y_{name}"]) for name in names if name.startswith("train_")]
    run, chosen = train(runs, int(seed))
    names = [name for name in names if not name.startswith("train_")]
    outputs = {name: finite(run(data[f"u_{name}"], data[f"y_{name}"])) for name in names}
    about = ", ".join(f"{package} {version(package)}" for package in packages)
    outputs["chosen"] = np.array(f"{about}: {chosen}")
    np.savez(target, **outputs)  # pyright: ignore[reportArgumentType]
