"""An observer over a model, as `softneck observer` makes it."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from softneck.core import make_settings
from softneck.identification import Model
from softneck.robot import Robot, load_for_robot
from softneck.signals import Recording, RecordingLike, open_recording

from ._axis import HasTransferFunctions
from ._fitted import AnyObserver, FittedObserver, fitted_observer
from ._settings import KalmanSettings


def observer(
    model: Model | HasTransferFunctions | str | Path,
    *,
    data: RecordingLike | None = None,
    robot: Robot | str | Path | None = None,
    **settings: Any,
) -> AnyObserver:
    """Return the filter over an identified model: a Kalman filter over a linear one, else the free run corrected.

    Args:
        model: itself or its file; of one's own, anything with `tf` of each output.
        data: recordings that tell the noise levels (maximum likelihood), as `softneck.identify` takes them.
        robot: whose they are; None: `robot.toml` beside a file or above it, else what the files say.
        **settings: those of `KalmanSettings`, for instance `form="gyro"`.

    Raises:
        SettingsError: an unknown setting, or a model that it cannot be built on.
        FileFormatError: no such file, or no model.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> softneck.observer(softneck.identify("rls", recording)).block().kind
        'kalman'
    """
    made = designed(make_settings(KalmanSettings, settings), model, robot)
    if data is None:
        return made
    parts = data if isinstance(data, list | tuple) else [data]
    return fitted(made, [open_recording(part, robot) for part in parts], settings).observer


def designed(settings: KalmanSettings, model: Any, robot: Robot | str | Path | None) -> AnyObserver:
    """Return the observer with the levels that its settings, sensor and robot say."""
    return settings.design(load_for_robot(model, None if hasattr(model, "tf") else "model", robot))


def fitted(made: AnyObserver, recordings: list[Recording], named: Collection[str]) -> FittedObserver:
    """Return what recordings make of it: what somebody `named` of the sensor stays."""
    fixed = (made.noise_names[0],) if "sensor" in named else ()
    return fitted_observer(made, recordings, fixed=fixed, delay="sensor_delay" not in named)
