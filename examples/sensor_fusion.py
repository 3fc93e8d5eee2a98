"""Fuse an inclinometer that drops out, lies and goes dark with set-points or a gyro, on the virtual neck.

The loop runs at 100 Hz, the inclinometer at 50 Hz and 15 ms late; 20 % of its samples are lost, 2 % are outliers, five
times nothing comes for 0.6 s, and the linear model is 15 % wrong in its gain. Printed: rms errors against the true
angle of this instant, over all and over the blackouts, and that of the worst blackout.

Run it with `python examples/sensor_fusion.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import control
import numpy as np

from softneck.core import Vector
from softneck.estimation import Estimates, KalmanSettings, LinearNeck
from softneck.identification import Rls
from softneck.plant import NeckParameters, VirtualNeck, record, settle
from softneck.signals import Recording, signal

PERIOD = 0.01
# What the virtual neck's 3DM-GX5 does: lag 5 ms and transport delay 10 ms; its rates have the delay only.
SENSOR = {"sensor_lag": 0.005, "sensor_delay": 0.01, "noise_std": math.radians(0.005),
          "drift_std": math.radians(0.03), "drift_time": 2.0,
          "rate_noise_std": math.radians(0.05), "rate_bias_std": math.radians(0.2)}  # fmt: skip
ANGLE_DELAY, RATE_DELAY = 0.015, 0.01
LOST, OUTLIERS, OUTLIER_STD = 0.2, 0.02, math.radians(20.0)
BLACKOUTS = (6.0, 12.0, 17.3, 21.7, 25.1)
BLACKOUT_LENGTH = 0.6
# What a model whose gain is 15 % wrong misses while the neck moves by up to 2 deg in a sample.
DISTURBANCE_STD = math.radians(0.3)
# The filters start from nothing: their first second is not scored.
SCORED_FROM = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """A spoilt recording and the truth behind it.

    Attributes:
        recording: at 100 Hz; NaN where no measurement came.
        truth: (time, 2) true pitch and roll [rad].
        model: the identified linear model with its gain 15 % too high.
    """

    recording: Recording
    truth: np.ndarray
    model: LinearNeck


def scenario(*, seed: int = 0, seconds: float = 30.0) -> Scenario:
    """Move the virtual neck by Eq. 22 and spoil what its inclinometer says."""
    neck = VirtualNeck(replace(NeckParameters.paper(), **SENSOR))
    identified = Rls().fit([record(signal("eq22", duration=60.0), neck, seed=seed + 1)])
    model = LinearNeck(**{axis: wrong(identified.tf(axis), 1.15) for axis in ("pitch", "roll")})

    block = neck.block(noise_seed=seed, sample_time=PERIOD)
    P = np.repeat(signal("eq22", duration=seconds).set_points, 2, axis=0)
    state = settle(block, P[0])
    U = np.zeros((len(P), len(block.inputs)))
    U[:, :3] = P
    Y = np.vstack([state.outputs, block.run(state, U[:-1])[1]])
    names = [port.name for port in block.outputs]
    column = {name: Y[:, names.index(name)] for name in names}

    rng = np.random.default_rng(seed)
    time = np.arange(len(P)) * PERIOD
    measured = np.column_stack([column["pitch_measured"], column["roll_measured"]])
    outlier = rng.random(len(P)) < OUTLIERS
    measured[outlier] += OUTLIER_STD * rng.standard_normal((int(outlier.sum()), 2))
    gone = (rng.random(len(P)) < LOST) | (np.arange(len(P)) % 2 == 1) | dark(time)
    measured[gone] = np.nan
    channels = {f"motor_setpoint_{j + 1}": P[:, j] for j in range(3)}
    channels |= {"pitch": measured[:, 0], "roll": measured[:, 1]}
    channels |= {f"{axis}_rate": column[f"{axis}_rate_measured"] for axis in ("pitch", "roll")}
    return Scenario(Recording(time, PERIOD, channels), np.column_stack([column["pitch"], column["roll"]]), model)


def wrong(system: control.TransferFunction, factor: float) -> control.TransferFunction:
    """Return the system with another gain."""
    return control.TransferFunction(factor * system.num[0][0], system.den[0][0], system.dt)


def dark(time: Vector) -> np.ndarray:
    """Return where nothing comes (time,)."""
    return np.logical_or.reduce([(time >= start) & (time < start + BLACKOUT_LENGTH) for start in BLACKOUTS])


def settings() -> dict[str, KalmanSettings]:
    """Return both filters by name."""
    common = KalmanSettings(sensor="3dm-gx5-10", sample_time=PERIOD, sensor_delay=ANGLE_DELAY)
    return {
        "model + disturbance": replace(common, disturbance_noise_std=DISTURBANCE_STD),
        "gyro + bias": replace(common, form="gyro", gyro_delay=RATE_DELAY),
    }


def hold(recording: Recording) -> np.ndarray:
    """Return the last measurement that came (time, 2), as a loop without a filter sees it."""
    y = recording.outputs
    last = np.maximum.accumulate(np.where(np.isfinite(y[:, 0]), np.arange(len(y)), 0))
    return y[last]


def rms_deg(case: Scenario, angles: np.ndarray) -> tuple[float, float, float]:
    """Return the rms error of both angles together: over all scored, the blackouts, the worst of them [deg]."""
    time = case.recording.time
    squared = np.degrees(angles - case.truth) ** 2
    parts = [squared[(time >= start) & (time < start + BLACKOUT_LENGTH)] for start in BLACKOUTS]
    means = (
        np.mean(squared[time >= SCORED_FROM]),
        np.mean(np.concatenate(parts)),
        max(np.mean(part) for part in parts),
    )
    everything, blackouts, worst = (math.sqrt(mean) for mean in means)
    return everything, blackouts, worst


def angles(estimates: Estimates) -> np.ndarray:
    """Return estimated pitch and roll (time, 2)."""
    return np.column_stack([estimates.pitch, estimates.roll])


def results(case: Scenario) -> dict[str, tuple[float, float, float]]:
    """Return the rms errors [deg] of the raw measurement, held, and of each filter."""
    found = {"raw, held": rms_deg(case, hold(case.recording))}
    for name, setting in settings().items():
        found[name] = rms_deg(case, angles(setting.design(case.model).estimate(case.recording)))
    return found


def main() -> None:
    """Print a line for each way to know the angle."""
    print(f"{'rms error [deg]':22}{'all':>8}{'blackouts':>11}{'worst one':>11}")
    for name, (everything, blackouts, worst) in results(scenario()).items():
        print(f"{name:22}{everything:8.3f}{blackouts:11.3f}{worst:11.3f}")


if __name__ == "__main__":
    main()
