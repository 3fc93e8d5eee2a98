"""The test that designs are compared by: a step and a load on every plant, and the figures of its runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_positive

# Scaled [rad of theta_i].
_LOAD = -0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class StepAndLoad:
    """What is asked of a controller on every plant.

    Attributes:
        reference: the step at t = 0 [rad].
        position_limit: of `|u|` [rad].
        slew_limit: of u, per sample [rad].
        load: added to the plant's input [rad].
        load_at: from when on [s].
        duration: [s].
        sample_time: [s].
        size: what scales outputs: 10 deg over `reference`.
    """

    reference: float = math.radians(10.0)
    position_limit: float = 6.0
    slew_limit: float = 0.25
    load: float = _LOAD
    load_at: float = 3.5
    duration: float = 6.0
    sample_time: float = 0.02
    size: float = 1.0

    def __post_init__(self) -> None:
        for name in ("reference", "position_limit", "slew_limit", "load_at", "sample_time"):
            require_positive(name, getattr(self, name))
        if not self.load_at < self.duration < math.inf:
            raise SettingsError(f"`duration` must be beyond `load_at` {self.load_at:g} s; got {self.duration:g} s.")

    @property
    def gain_unit(self) -> float:
        """A scaled gain of 1 from output to input; of the neck 1."""
        return self.size * self.load / _LOAD

    @property
    def rows(self) -> int:
        """Samples of a run."""
        return round(self.duration / self.sample_time) + 1

    @property
    def load_row(self) -> int:
        """The first sample with the load."""
        return round(self.load_at / self.sample_time)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StepAndLoadResult:
    """What a controller did on every plant.

    Attributes:
        settling: (plants,) time after which the angle stays within 5 % of the step, until the load [s]; inf if never.
        overshoot: (plants,) beyond the step, until the load [%].
        load_rms: (plants,) rms of the error from the load on [deg].
        angles: (plants, time) [rad].
        inputs: (plants, time) within their limits [rad].
        nominal: index of the nominal plant.
    """

    settling: Vector
    overshoot: Vector
    load_rms: Vector
    angles: Matrix
    inputs: Matrix
    nominal: int

    @property
    def row(self) -> dict[str, float]:
        """The three figures that controllers are compared by."""
        return {
            "nominal_settling_s": float(self.settling[self.nominal]),
            "worst_overshoot_pct": float(self.overshoot.max()),
            "worst_load_rms_deg": float(self.load_rms.max()),
        }


def judge(angles: Matrix, inputs: Matrix, test: StepAndLoad, nominal: int) -> StepAndLoadResult:
    """Return the figures of runs, `angles` and `inputs` (plants, time)."""
    before, after = angles[:, : test.load_row], angles[:, test.load_row :]
    # 1e-12: the border itself belongs to the band, whatever rounding says.
    outside = np.abs(before - test.reference) > (0.05 + 1e-12) * test.reference
    last = before.shape[1] - np.argmax(outside[:, ::-1], axis=1)
    settled = np.where(outside[:, -1], math.inf, last * test.sample_time)
    return StepAndLoadResult(
        settling=np.where(outside.any(axis=1), settled, 0.0),
        overshoot=100.0 * np.maximum(before.max(axis=1) / test.reference - 1.0, 0.0),
        load_rms=np.degrees(np.sqrt(np.mean((after - test.reference) ** 2, axis=1))),
        angles=angles,
        inputs=inputs,
        nominal=nominal,
    )
