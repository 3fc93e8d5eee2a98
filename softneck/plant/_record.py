"""Recordings made on the virtual neck, as on the real one: settle, ramp in, record."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, require_between
from softneck.robot import Robot
from softneck.runtime import Block, State
from softneck.signals import Excitation, Recording, signal

from ._neck import VirtualNeck
from ._parameters import NeckParameters

# Before a recording starts the set-points rise from rest to their first row and are held [s]; on the
# hardware every signal is ramped in as well. 3 s is 15 time constants of the neck.
_RAMP, _HOLD = 1.0, 3.0


def record(
    excitation: Excitation | str,
    neck: VirtualNeck | NeckParameters | str | Path,
    *,
    seed: int = 0,
    payload: float = 0.0,
    noise: bool = True,
) -> Recording:
    """Run a signal on the virtual neck and return the recording.

    Row k holds the set-points of t_k and what was measured at t_k, before they act. A sample that the
    inclinometer dropped is NaN.

    Args:
        excitation: set-points (time, motors) [rad] at its sample time, or the name of a signal.
        neck: the virtual neck, its parameters, a preset or a neck file.
        seed: of the sensor's noise.
        payload: mass on the platform [kg], 0 to 5.
        noise: False gives a perfect sensor that keeps its lag and delay.

    Raises:
        DataError: set-points that are not finite or beyond the limits of the neck or robot.
        SettingsError: a payload, a seed or a step out of range.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> len(recording), recording.robot.outputs.names
        (1000, ('pitch', 'roll'))
    """
    require_between("payload", payload, 0.0, 5.0, "kg")
    if isinstance(neck, str | Path):
        neck = NeckParameters.preset(str(neck))
    neck = VirtualNeck(neck) if isinstance(neck, NeckParameters) else neck
    if not isinstance(neck, VirtualNeck):
        raise SettingsError(f"a virtual neck, its parameters or a preset is needed; got a {type(neck).__name__}.")
    if isinstance(excitation, str):
        excitation = signal(excitation, robot=neck.robot)
    if not isinstance(excitation, Excitation):
        raise SettingsError(f"an excitation or the name of a signal is needed; got a {type(excitation).__name__}.")
    P = np.asarray(excitation.set_points, dtype=np.float64)
    _check_set_points(P, excitation, neck)
    parameters = neck.parameters if noise else neck.parameters.without_noise()
    block = replace(neck, parameters=parameters).block(noise_seed=seed, sample_time=excitation.sample_time)
    state = settle(block, P[0], payload=payload)
    U = _inputs(block, P, payload)
    _, Y = block.run(state, U[:-1])
    rows = np.vstack([state.outputs, Y])
    names = [port.name for port in block.outputs]
    channels = {name: rows[:, names.index(output)].copy() for name, output in _channels(neck.robot).items()}
    lost = rows[:, names.index("measurement_valid")] < 0.5
    rate = neck.robot.rate_hz  # rows without a sample where the robot's sensor is slower
    every = 1 if rate is None else max(1, round(1.0 / (rate * excitation.sample_time)))
    lost |= np.arange(len(P)) % every > 0
    for name in neck.robot.outputs.names:
        channels[name][lost] = np.nan
        channels[f"{name}_rate"][lost] = np.nan
    if payload > 0.0:  # without the channel there was none
        channels["payload"] = np.full(len(P), payload)
    set_points = dict(zip(neck.robot.set_points, P.T, strict=True))
    return Recording(excitation.time, excitation.sample_time, {**set_points, **channels}, robot=neck.robot)


def _channels(robot: Robot) -> dict[str, str]:
    """Return the recorded outputs: channel of the recording -> output of the neck."""
    outputs, motors = robot.outputs.names, range(1, len(robot.motors.names) + 1)
    return {
        **{name: f"{name}_measured" for name in outputs},
        **{f"{name}_rate": f"{name}_rate_measured" for name in outputs},
        **{name: name for name in robot.motor_positions},
        **{f"tension_{j}": f"tension_{j}" for j in motors},
        "compression": "compression",
    }


def _inputs(block: Block, set_points: Matrix, payload: float) -> Matrix:
    """Return the block's inputs (time, n_in) under set-points (time, motors): payload, and neither push nor tilt."""
    U = np.zeros((set_points.shape[0], len(block.inputs)))
    motors = set_points.shape[1]
    U[:, :motors], U[:, motors] = set_points, payload
    return U


def settle(block: Block, set_points: Matrix, *, payload: float = 0.0) -> State:
    """Return the state after the neck was moved from rest to `set_points` (motors,) [rad] and came to rest."""
    rise = 0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0, _times(_RAMP + _HOLD, block.sample_time) / _RAMP))
    U = rise[:, None] * np.asarray(set_points)
    return block.run(block.initial_state(), _inputs(block, U, payload))[0]


def _times(length: float, sample_time: float) -> Matrix:
    return np.arange(1, round(length / sample_time) + 1) * sample_time


def _check_set_points(P: Matrix, excitation: Excitation, neck: VirtualNeck) -> None:
    ranges = neck.ranges()
    if P.ndim != 2 or P.shape[1] != len(ranges) or P.shape[0] < 2:
        raise DataError(f"set-points must have shape (time, {len(ranges)}) with at least 2 rows; got {P.shape}.")
    # A set-point on the limit may exceed it by rounding.
    beyond = np.maximum(ranges[:, 0] - P, P - ranges[:, 1])
    bad = ~(beyond <= 1e-12 * np.abs(ranges).max(axis=1))
    if bad.any():
        row, motor = np.argwhere(bad)[0]
        low, high = ranges[motor]
        within = f"within +-{high:g} rad" if low == -high else f"from {low:g} to {high:g} rad"
        raise DataError(
            f"`{neck.robot.set_points[motor]}` of {excitation.name} is {P[row, motor]:g} rad at t = "
            f"{excitation.time[row]:g} s; it must be finite and {within}."
        )
