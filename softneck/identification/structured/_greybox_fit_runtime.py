"""Free run of the grey box, for its fit."""

import numpy as np

from softneck.identification.structured._neck_equations_runtime import neck_advance, neck_sense


def neck_run(
    neck: np.ndarray,
    sample_time: float,
    delay: np.ndarray,
    lines: int,
    settle: int,
    targets: np.ndarray,
    start: np.ndarray,
    motors: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Fill `motors` (time, motors) and `outputs` (time, outputs) for set-points `targets`, standing at `start` before.

    `delay` (motors,) is that of the drives in samples, `lines` the sensor's; `settle` samples of rest come first.
    """
    x = np.zeros(7 + 2 * lines)
    m = start.copy()
    held = np.empty(m.shape[0])
    axes = outputs.shape[1]
    # Under set-points that stay: a run begins at rest, as its recording is taken to.
    for _ in range(settle):
        neck_advance(neck, sample_time, start, m, x)  # pyright: ignore[reportArgumentType]
        neck_sense(neck, sample_time, x)  # pyright: ignore[reportArgumentType]
    motors[0] = m
    outputs[0] = x[5 : 5 + axes]
    for k in range(targets.shape[0] - 1):
        for j in range(m.shape[0]):
            back = k + 1 - int(delay[j])
            held[j] = targets[back, j] if back >= 0 else start[j]
        neck_advance(neck, sample_time, held, m, x)  # pyright: ignore[reportArgumentType]
        neck_sense(neck, sample_time, x)  # pyright: ignore[reportArgumentType]
        motors[k + 1] = m
        outputs[k + 1] = x[5 : 5 + axes]
