"""The quality report of a recording: faults of its channels, and what its inputs can teach a model."""

from __future__ import annotations

from softneck.core import require_positive

from ..recording._channels import OUTPUTS
from ..recording._recording import Recording
from ._channel_faults import check_channel
from ._excitation import conditioning, correlation, repeats, spectrum
from ._findings import Quality
from ._region import visited

# The paper's section 3.1 and the public face: |P| <= 6 rad.
MOTOR_LIMIT = 6.0


def assess_quality(recording: Recording, *, motor_limit: float = MOTOR_LIMIT) -> Quality:
    """Check a recording's channels and what its inputs can teach; never across the border of two runs.

    Args:
        recording: to check.
        motor_limit: how far motors go to either side [rad]; coverage of the region is relative to that.

    Raises:
        SettingsError: a limit that is not positive, or a robot other than the neck.
    """
    recording.robot.require_neck("the quality report")
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
