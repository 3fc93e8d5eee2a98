"""The quality report of a recording: faults of its channels, and what its inputs can teach a model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, require_positive

from ._channels import OUTPUTS, SET_POINTS
from ._quality_channels import ChannelQuality, check_channel
from ._quality_excitation import (
    BANDWIDTH,
    INPUTS,
    Conditioning,
    Repeat,
    Spectrum,
    conditioning,
    correlation,
    repeats,
    spectrum,
)
from ._quality_findings import SEVERITIES, Finding, findings
from ._quality_region import Region, visited
from ._recording import Recording

# The paper's section 3.1 and the public face: |P| <= 6 rad.
MOTOR_LIMIT = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """What `quality` found; arrays in SI.

    Attributes:
        rows: of the recording.
        sample_time: [s].
        channels: name -> faults of that channel.
        spectrum: of theta_i, phi_i, delta_i.
        conditioning: pitch, roll -> condition of Eq. 21's regressor.
        region: of (theta_i, phi_i, delta_i) that was visited.
        correlation: (3, 3) between the motors' set-points.
        repeats: pairs of runs with the same set-points.
    """

    rows: int
    sample_time: float
    channels: dict[str, ChannelQuality]
    spectrum: Spectrum
    conditioning: dict[str, Conditioning]
    region: Region
    correlation: Matrix
    repeats: tuple[Repeat, ...]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what there is to say, warnings first."""
        return findings(self)

    @property
    def severity(self) -> str:
        """Return the worst severity: ok, note or warning."""
        return max((finding.severity for finding in self.findings), key=SEVERITIES.index)

    def as_dict(self) -> dict[str, Any]:
        """Return what `softneck info --json` holds under `quality`."""
        said = self.findings
        return {
            "severity": self.severity,
            "findings": [finding.as_dict() for finding in said],
            "channels": {name: channel.as_dict() for name, channel in self.channels.items()},
            "bandwidth_rad_s": BANDWIDTH,
            "excitation": self.spectrum.as_dict(),
            "condition": {axis: condition.as_dict() for axis, condition in self.conditioning.items()},
            "region": self.region.as_dict(),
            "correlation": {"channels": SET_POINTS, "matrix": self.correlation},
            "repeats": [repeat.as_dict() for repeat in self.repeats],
        }

    def lines(self) -> tuple[str, ...]:
        """Return the report as lines: the numbers, then one line for each finding."""
        return (*self._numbers(), "", *(str(finding) for finding in self.findings))

    def text(self) -> str:
        """Return the report as text."""
        return "\n".join(self.lines())

    def _numbers(self) -> list[str]:
        low, high = self.region.ranges.T
        lines = [
            f"{name}: {low[i]:+.2f} to {high[i]:+.2f} rad, {_percent(self.spectrum.below_bandwidth[i])} of its power "
            f"below {BANDWIDTH:g} rad/s, real power up to {self.spectrum.highest[i]:.1f} rad/s, "
            f"crest factor {_number(self.spectrum.crest[i])}"
            for i, name in enumerate(INPUTS)
        ]
        noise = ", ".join(f"{axis} {np.degrees(self.channels[axis].noise):.3f} deg" for axis in OUTPUTS)
        condition = ", ".join(f"{axis} {c.number:.3g}" for axis, c in self.conditioning.items())
        r = self.correlation
        lines.append(f"noise (standard deviation): {noise}")
        lines.append(f"condition of Eq. 21's regressor, columns at unit variance: {condition}")
        lines.append(f"correlation of motors 1-2, 1-3, 2-3: {_number(r[0, 1])}, {_number(r[0, 2])}, {_number(r[1, 2])}")
        steps = [
            f"{channel.name} {channel.shown(channel.quantum):.3g}"
            for channel in self.channels.values()
            if channel.quantum is not None
        ]
        if steps:
            lines.append(f"steps between levels: {', '.join(steps)} (units of the file)")
        return lines


def quality(recording: Recording, *, motor_limit: float = MOTOR_LIMIT) -> Quality:
    """Check a recording's channels and what its inputs can teach; never across the border of two runs.

    Args:
        recording: to check.
        motor_limit: how far motors go to either side [rad]; coverage of the region is relative to that.

    Raises:
        SettingsError: a limit that is not positive.
    """
    require_positive("motor_limit", motor_limit, "rad")
    return Quality(
        rows=len(recording),
        sample_time=recording.sample_time,
        channels={name: check_channel(recording, name) for name in recording.channels},
        spectrum=spectrum(recording),
        conditioning={axis: conditioning(recording, axis) for axis in OUTPUTS},
        region=visited(recording, motor_limit),
        correlation=correlation(recording),
        repeats=repeats(recording),
    )


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100 * share:.0f} %"


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"
