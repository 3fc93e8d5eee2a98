"""Loops over the drive and the bank of `_bank_runtime`, for training."""

import numpy as np

from softneck.identification.models._bank_runtime import (
    bank_advance,
    drive_advance,
    drive_limit,
    load_advance,
    valve_advance,
)


def drive_run(drive: np.ndarray, load: np.ndarray, targets: np.ndarray, start: np.ndarray, motors: np.ndarray) -> None:
    """Fill `motors` (time, motors) for set-points `targets` (time, motors), standing at `start` (motors,) before."""
    m = start.copy()
    q = start.copy()
    motors[0] = m
    for k in range(targets.shape[0] - 1):
        # In the order of the kinds' `step`: the load follows m(k), then the drive moves on to k+1 against it.
        load_advance(load, m, q)
        mean = 0.0
        for j in range(q.shape[0]):
            mean += q[j]
        mean /= q.shape[0]
        for j in range(targets.shape[1]):
            back = k + 1 - int(drive[j, 1])  # m(k+1) answers to u(k+1-d)
            target = targets[back, j] if back >= 0 else start[j]
            if load.shape[0] > 4:
                m[j] = valve_advance(load, target, m[j])
            else:
                m[j] = drive_advance(drive[j, 0], target, m[j], drive_limit(load, q[j], mean))
        motors[k + 1] = m


def bank_run(
    redefinition: np.ndarray, widths: np.ndarray, chain: np.ndarray, motors: np.ndarray, signals: np.ndarray
) -> None:
    """Fill `signals` (time, n) with the bank along `motors` (time, motors), at rest at the first row before."""
    n = int(chain[1])
    count = widths.shape[0]
    inputs = redefinition.shape[0]
    plays = np.zeros(inputs * count)
    bank = np.zeros(inputs * (count + 1) * n)
    for c in range(inputs):
        v = 0.0
        for j in range(redefinition.shape[1]):
            v += redefinition[c, j] * motors[0, j]
        # Plays that came from zero, as a model's do that starts from rest and is then held.
        for i in range(count + 1):
            x = v
            if i > 0:
                # Filters that have settled hold what they are given.
                x = max(v - widths[i - 1], min(v + widths[i - 1], 0.0))
                plays[c * count + i - 1] = x
            for o in range(n):
                bank[(c * (count + 1) + i) * n + o] = x
    signals[0] = bank
    for k in range(motors.shape[0] - 1):
        bank_advance(redefinition, widths, chain, motors[k], plays, bank)
        signals[k + 1] = bank
