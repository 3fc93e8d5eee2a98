"""Several recordings on a command line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from softneck.core import DataError

if TYPE_CHECKING:
    from softneck.signals import Recording


def read_together(paths: Sequence[Path]) -> Recording:
    """Read recordings as runs of one.

    Raises:
        DataError: their sample times or robots differ; the line names two that do.
    """
    from softneck.signals import concatenate, read_recording
    from softneck.signals.recording._recording import require_same_robot

    recordings = [read_recording(path) for path in paths]
    for path, recording in zip(paths, recordings, strict=True):
        if not math.isclose(recording.sample_time, recordings[0].sample_time, rel_tol=1e-6):
            raise DataError(
                f"{path}: is at {1e3 * recording.sample_time:g} ms and {paths[0]} at "
                f"{1e3 * recordings[0].sample_time:g} ms; recordings are used together at one sample time only. Take "
                "each by itself, or bring one to the other's (Python: `softneck.signals.resampled`)."
            )
        require_same_robot(recording.robot, recordings[0].robot, f"{paths[0]} and {path}: recordings")
    return concatenate(recordings)
