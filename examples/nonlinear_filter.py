"""Bridge what an inclinometer misses by filters over nonlinear models, on the virtual neck.

20 s of Eq. 22 at 50 Hz: white noise of 0.05 deg, 20 % of the samples lost, three times nothing for 0.6 s. Printed: rms
errors against the angle without noise, over all and over the blackouts.

Run it with `python examples/nonlinear_filter.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from softneck.estimation import Estimates, KalmanSettings
from softneck.identification import GreyBox, Network, Play, Rls
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal

NOISE_STD = math.radians(0.05)
LOST = 0.2
BLACKOUTS = (6.0, 12.0, 16.0)
BLACKOUT_LENGTH = 0.6
# What a linear model misses while the neck moves.
# Judged at the instant of the measurement, whose noise-free value is the truth here: nothing to look ahead to.
SETTINGS = KalmanSettings(disturbance_noise_std=math.radians(0.3), sensor_delay=0.0)
# The filters start from nothing: their first second is not scored.
SCORED_FROM = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """A spoilt recording, NaN where nothing was measured, and the angles (time, 2) behind it [rad]."""

    recording: Recording
    truth: np.ndarray
    dark: np.ndarray


def scenario(*, seed: int = 3, seconds: float = 20.0) -> Scenario:
    """Move the virtual neck by Eq. 22 and spoil what its inclinometer says."""
    clean = record(signal("eq22", duration=seconds), VirtualNeck(NeckParameters.paper().without_noise()), seed=7)
    rng = np.random.default_rng(seed)
    measured = clean.outputs + NOISE_STD * rng.standard_normal(clean.outputs.shape)
    dark = np.logical_or.reduce([(clean.time >= t) & (clean.time < t + BLACKOUT_LENGTH) for t in BLACKOUTS])
    measured[dark | (rng.random(len(clean)) < LOST)] = math.nan
    return Scenario(clean.with_channels(pitch=measured[:, 0], roll=measured[:, 1]), clean.outputs, dark)


def rms_deg(case: Scenario, angles: np.ndarray) -> tuple[float, float]:
    """Return the rms error of both angles together [deg]: over all that is scored, and over the blackouts."""
    squared = np.degrees(angles - case.truth) ** 2
    return math.sqrt(squared[case.recording.time >= SCORED_FROM].mean()), math.sqrt(squared[case.dark].mean())


def results(case: Scenario, network: Network) -> dict[str, tuple[float, float]]:
    """Return the errors by filter; all models are identified from another minute of Eq. 22 with the neck's noise."""
    training = [record(signal("eq22", duration=60.0), VirtualNeck(NeckParameters.paper()), seed=1)]
    y = case.recording.outputs
    last = np.maximum.accumulate(np.where(np.isfinite(y[:, 0]), np.arange(len(y)), 0))
    observers = {
        "linear (rls)": SETTINGS.design(Rls().fit(training)),
        "nonlinear (play)": SETTINGS.design(Play().fit(training)),
        "nonlinear (nn)": SETTINGS.design(network.fit(training)),
        "nonlinear (greybox)": SETTINGS.design(GreyBox().fit(training)),
    }
    found = {name: rms_deg(case, angles(observer.estimate(case.recording))) for name, observer in observers.items()}
    return {"raw, held": rms_deg(case, y[last]), **found}


def angles(estimates: Estimates) -> np.ndarray:
    """Return pitch and roll (time, 2) [rad]."""
    return np.column_stack([estimates.pitch, estimates.roll])


def main() -> None:
    """Print the table."""
    print(f"{'rms error [deg]':<20}{'all':>8}{'blackouts':>11}")
    for name, (everything, blackouts) in results(scenario(), Network()).items():
        print(f"{name:<20}{everything:>8.3f}{blackouts:>11.3f}")


if __name__ == "__main__":
    main()
