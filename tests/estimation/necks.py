"""Linear necks and recordings whose truth the estimation tests know."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np

from softneck.estimation import KalmanObserver, KalmanSettings, LinearNeck
from softneck.estimation._kalman_parts_runtime import KALMAN_GATE
from softneck.runtime import Block, load_runtime
from softneck.signals import Recording, redefine, signal

TS = 0.02
POLE = math.exp(-5.293 * TS)
# A sensor in time and a model that is right: what most laws are about.
IN_TIME = KalmanSettings(sensor_delay=0.0, disturbance_noise_std=math.radians(0.02))


def neck(*, pitch_delay: int = 4, roll_delay: int = 2, gain: float = 1.0, sample_time: float = TS) -> LinearNeck:
    """The paper's pitch (Eq. 31, exp(-0.08 s) 27.69/(s + 5.293) deg/rad) and a faster-answering roll."""
    pole = math.exp(-5.293 * sample_time)
    b = gain * math.radians(27.69) / 5.293 * (1.0 - pole)
    first = control.TransferFunction([b], [1.0, -pole, *([0.0] * pitch_delay)], sample_time)
    second = control.TransferFunction([0.8 * b], [1.0, -pole, *([0.0] * roll_delay)], sample_time)
    return LinearNeck(pitch=first, roll=second)


def with_levels(observer: Any, **levels: float) -> Any:
    """The same filter with some other noise levels."""
    return observer.with_noise([levels.get(name, value) for name, value in
                                zip(observer.noise_names, observer.noise, strict=True)])  # fmt: skip


def without(observer: Any, *places: int) -> Any:
    """The same filter that refuses next to nothing (1e-12): places of its constants KALMAN_GATE, KALMAN_FROZEN."""
    constants = observer.constants.copy()
    for place in places:
        constants[place] = -2.0 * math.log(1e-12) if place == KALMAN_GATE else 0.0
    return observer.with_constants(constants)


def recording(*, noise_deg: float = 0.05, rows: int = 1500, seed: int = 1) -> Recording:
    """Eq. 22 through the linear neck, white noise on the measured angles, exact mean rates over the last sample."""
    P = signal("eq22").set_points[:rows]
    u = redefine(P)
    rng = np.random.default_rng(seed)
    time: Any = np.arange(rows) * TS
    channels = {f"motor_setpoint_{j + 1}": P[:, j] for j in range(3)}
    for i, axis in enumerate(("pitch", "roll")):
        true = np.asarray(control.forced_response(neck().tf(axis), time, u[:, i]).outputs)  # pyright: ignore
        channels[axis] = true
        channels[f"{axis}_measured"] = true + math.radians(noise_deg) * rng.standard_normal(rows)
    return Recording(time, TS, channels)


def smooth_motion(
    *, rows: int = 1500, period: float = 0.01, noise_deg: float = 0.02, bias_deg: float = 0.5, seed: int = 2
) -> Recording:
    """Two sines with their exact rates, a constant gyro bias, white noise on all; `pitch`, `roll` are the truth."""
    rng = np.random.default_rng(seed)
    time = np.arange(rows) * period
    channels = {f"motor_setpoint_{j}": np.zeros(rows) for j in (1, 2, 3)}
    for axis, size, w in (("pitch", 0.3, 3.0), ("roll", 0.2, 5.0)):
        channels[axis] = size * np.sin(w * time)
        channels[f"{axis}_measured"] = channels[axis] + math.radians(noise_deg) * rng.standard_normal(rows)
        rate = size * w * np.cos(w * time) + math.radians(bias_deg)
        channels[f"{axis}_rate"] = rate + math.radians(0.05) * rng.standard_normal(rows)
    return Recording(time, period, channels)


def rows_of(observer: KalmanObserver, record: Recording) -> np.ndarray:
    """The inputs of the block row by row, as a sequential loop gives them."""
    z = np.column_stack([record.channels["pitch_measured"], record.channels["roll_measured"]])
    P = record.set_points[np.maximum(np.arange(len(record)) - 1, 0)]
    valid = np.isfinite(z).all(axis=1).astype(float)
    U = np.column_stack([P, z, valid])
    if observer.form == "gyro":
        U = np.column_stack([U, record.channels["pitch_rate"], record.channels["roll_rate"]])
    return U


def run_block(observer: KalmanObserver, record: Recording, *, compiled: bool = True) -> np.ndarray:
    """The runtime over a recording; outputs (time, 6)."""
    block, U = observer.block(), rows_of(observer, record)
    return block.run(block.initial_state(), U)[1] if compiled else run_plain(block, U)


def run_plain(block: Block, U: np.ndarray) -> np.ndarray:
    """The runtime without numba."""
    state, Y = block.initial_state(), np.zeros((len(U), 6))
    load_runtime(block.runtime, compiled=False).run_steps(block.arrays, state.parameters, state.values.copy(), U, Y)
    return Y


def changed(record: Recording, rows: slice | list[int], value: float, *channels: str) -> Recording:
    """The recording with `value` in some rows of some channels."""
    replaced = {}
    for name in channels:
        replaced[name] = record.channels[name].copy()
        replaced[name][rows] = value
    return record.with_channels(**replaced)


def ramped(run: Recording, rate: float) -> Recording:
    """The same set-points, but that each rises by `rate` [rad/s] at most."""
    P, most = run.set_points.copy(), rate * run.sample_time
    for k in range(1, len(P)):
        P[k] = P[k - 1] + np.clip(P[k] - P[k - 1], -most, most)
    return run.with_channels(**{f"motor_setpoint_{j + 1}": P[:, j] for j in range(P.shape[1])})


def jumping(run: Recording) -> Recording:
    """The same, but that set-points stand for 0.4 s at a time."""
    names = [name for name in run.channels if "setpoint" in name]
    return run.with_channels(**{name: np.repeat(run.channels[name][::20], 20)[: len(run)] for name in names})
