"""One axis of a linear controller with limits and conditioning, simulated on every plant of a family."""

import numpy as np


def sweep_run(
    A: np.ndarray,
    B: np.ndarray,
    C: np.ndarray,
    D: np.ndarray,
    L: np.ndarray,
    test: np.ndarray,
    plants: np.ndarray,
    delays: np.ndarray,
    angles: np.ndarray,
) -> None:
    """Fill `angles` (plants, time) with the outputs of `run_bake_off`.

    A (n, n); B (n, 2) from filtered reference and angle; C (n,); D (2,); L (n,) conditioning.
    test: reference, filter's pole, position limit, slew limit per sample, load, load's first row, filter's jump.
    plants: (plants, 2, order) numerator and denominator without its leading one; delays: (plants,).
    """
    n, order = A.shape[0], plants.shape[2]
    rows = angles.shape[1]
    longest = 0
    for i in range(delays.size):
        longest = max(longest, int(delays[i]))
    x, following, state = np.zeros(n), np.zeros(n), np.zeros(order)
    line = np.zeros(longest + 1)
    for i in range(angles.shape[0]):
        x[:] = 0.0
        state[:] = 0.0
        line[:] = 0.0
        # What a lead passes at once stands in the filter from the start.
        held, rf = 0.0, test[6] * test[0]
        delay = int(delays[i])
        for k in range(rows):
            y = state[0]
            angles[i, k] = y
            # The reference acts at once, as in the runtime's filter (Df).
            rf = test[1] * rf + (1.0 - test[1]) * test[0]
            v = D[0] * rf + D[1] * y
            for j in range(n):
                v += C[j] * x[j]
            # Position, then move in one sample: one motor's part of `allocate`.
            u = min(max(v, -test[2]), test[2])
            held = min(max(u, held - test[3]), held + test[3])
            for j in range(n):
                # Conditioning: L times what the limits took away.
                total = B[j, 0] * rf + B[j, 1] * y + L[j] * (held - v)
                for m in range(n):
                    total += A[j, m] * x[m]
                following[j] = total
            x[:] = following
            # Written where it will be at the front once its dead time is over.
            line[delay] = held + (test[4] if k >= test[5] else 0.0)
            # Observable form; `y` keeps the angle of now, as state[0] changes first.
            for j in range(order):
                tail = state[j + 1] if j + 1 < order else 0.0
                state[j] = tail - plants[i, 1, j] * y + plants[i, 0, j] * line[0]
            for j in range(delay):
                line[j] = line[j + 1]
