"""How many of its past angles a model remembers: found by asking it."""

from __future__ import annotations

import numpy as np

from softneck.identification import Model

LONGEST = 12
# What of an angle is left in the prediction, relative to its largest effect, that no longer counts.
_FORGOTTEN = 1e-3
_BEFORE = 25


def angle_memory(model: Model) -> int:
    """Return how many measured angles, the newest first, the model's prediction depends on: 1 to 12.

    One angle is moved by 0.01 rad while all before and after stay; the predictions that change tell. The motion is
    random, within what necks do, since a nonlinear model may be insensitive at rest.
    """
    rng = np.random.default_rng(0)
    rows = np.full((_BEFORE + LONGEST, 8), np.nan)
    # Set-points that stand for 5 samples, of 0 to 2 rad, and angles of up to 6 deg.
    rows[:, :3] = np.repeat(rng.uniform(0.0, 2.0, (len(rows) // 5 + 1, 3)), 5, axis=0)[: len(rows)]
    rows[:, 3:5] = rng.uniform(-0.1, 0.1, (len(rows), 2))
    moved = rows.copy()
    moved[_BEFORE, 3:5] += 0.01
    block = model.block()
    start = block.initial_state(use_measurement=1.0)
    change = np.abs(block.run(start, moved)[1] - block.run(start, rows)[1])[_BEFORE:, :2].max(axis=1)
    felt = np.flatnonzero(change > _FORGOTTEN * change.max())
    return int(felt[-1]) + 1 if felt.size else 1
