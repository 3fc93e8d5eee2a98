"""The quality report of a recording: faults of its channels, and what its inputs can teach a model."""

from __future__ import annotations

from softneck.core import require_positive

from ..recording._recording import Recording
from ._channel_faults import check_channel
from ._excitation import BANDWIDTH, conditioning, correlation, repeats, spectrum
from ._findings import Quality
from ._region import visited

# The paper's section 3.1 and the public face: |P| <= 6 rad.
MOTOR_LIMIT = 6.0


def assess_quality(
    recording: Recording, *, motor_limit: float = MOTOR_LIMIT, bandwidth: float | None = None
) -> Quality:
    """Check a recording's channels and what its inputs can teach; never across the border of two runs.

    Args:
        recording: to check.
        motor_limit: how far a neck's motors go to either side [rad]; coverage of the region is relative to that.
        bandwidth: up to where the outputs follow the motors [rad/s]; a neck's is 4 (section 3.1), and the spectrum of
            another robot is not judged where it is not given.

    Raises:
        SettingsError: a limit or a bandwidth that is not positive.
    """
    neck = recording.robot.is_neck
    require_positive("motor_limit", motor_limit, "rad")
    if bandwidth is None:
        bandwidth = BANDWIDTH if neck else float("nan")
    else:
        require_positive("bandwidth", bandwidth, "rad/s")
    return Quality(
        robot=recording.robot,
        rows=len(recording),
        sample_time=recording.sample_time,
        channels={name: check_channel(recording, name) for name in recording.channels},
        spectrum=spectrum(recording, bandwidth),
        conditioning={axis: conditioning(recording, axis) for axis in recording.robot.outputs.names},
        region=visited(recording, motor_limit) if neck else None,
        correlation=correlation(recording),
        repeats=repeats(recording),
    )
