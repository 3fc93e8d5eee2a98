"""How many of its past angles a model remembers: found by asking it."""

from __future__ import annotations

import numpy as np

from softneck.identification import Model

from ._reach import random_run, trained_levels

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
    block, n, m = model.block(), len(model.robot.motors.names), len(model.robot.outputs.names)
    rows = np.full((_BEFORE + LONGEST, len(block.inputs)), np.nan)
    count = len(rows) // 5 + 1
    if model.robot.is_neck:
        # Set-points that stand for 5 samples, of 0 to 2 rad, and angles of up to 6 deg.
        levels, middle, span = rng.uniform(0.0, 2.0, (count, 3)), np.zeros(2), np.full(2, 0.1)
    else:
        levels, y = trained_levels(model, rng, count), random_run(model, rng)
        middle, span = 0.5 * (y.max(axis=0) + y.min(axis=0)), 0.25 * np.ptp(y, axis=0)
    rows[:, :n] = np.repeat(levels, 5, axis=0)[: len(rows)]
    rows[:, n : n + m] = middle + rng.uniform(-span, span, (len(rows), m))
    moved = rows.copy()
    moved[_BEFORE, n : n + m] += 0.1 * span
    start = block.initial_state(use_measurement=1.0)
    change = np.abs(block.run(start, moved)[1] - block.run(start, rows)[1])[_BEFORE:, :m].max(axis=1)
    felt = np.flatnonzero(change > _FORGOTTEN * change.max())
    return int(felt[-1]) + 1 if felt.size else 1
