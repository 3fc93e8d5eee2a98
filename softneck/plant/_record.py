"""Recordings made on the virtual neck, as on the real one: settle, ramp in, record."""

from __future__ import annotations

import numpy as np

from softneck.core import DataError, Matrix, require_between
from softneck.runtime import Block, State
from softneck.signals import SET_POINTS, Excitation, Recording

from ._neck import INTERNAL_STEP, VirtualNeck

# Before a recording starts the set-points rise from rest to their first row and are held [s]; on the
# hardware every signal is ramped in as well. 3 s is 15 time constants of the neck.
_RAMP, _HOLD = 1.0, 3.0
# Recorded beside the set-points: channel of the recording <- output of the neck.
_CHANNELS = {
    "pitch": "pitch_measured",
    "roll": "roll_measured",
    "pitch_rate": "pitch_rate_measured",
    "roll_rate": "roll_rate_measured",
    **{f"motor_position_{j}": f"motor_position_{j}" for j in (1, 2, 3)},
    **{f"tension_{j}": f"tension_{j}" for j in (1, 2, 3)},
    "compression": "compression",
}


def record(
    excitation: Excitation,
    neck: VirtualNeck,
    *,
    seed: int = 0,
    payload: float = 0.0,
    noise: bool = True,
    internal_step: float = INTERNAL_STEP,
) -> Recording:
    """Run a signal on the virtual neck and return what would be logged.

    Row k holds the set-points of t_k and what was measured at t_k, before they act. A sample that the
    inclinometer dropped is NaN.

    Args:
        excitation: set-points (time, 3) [rad] at its sample time.
        neck: the virtual neck.
        seed: of the sensor's noise.
        payload: mass on the platform [kg], 0 to 5.
        noise: False gives a perfect sensor that keeps its lag and delay.
        internal_step: longest [s]; a sample takes equal steps.

    Raises:
        DataError: set-points that are not finite or beyond the neck's position limit.
        SettingsError: a payload, a seed or a step out of range.
    """
    require_between("payload", payload, 0.0, 5.0, "kg")
    P = np.asarray(excitation.set_points, dtype=np.float64)
    _check_set_points(P, excitation, neck.parameters.position_limit)
    parameters = neck.parameters if noise else neck.parameters.without_noise()
    block = VirtualNeck(parameters).block(
        noise_seed=seed, sample_time=excitation.sample_time, internal_step=internal_step
    )
    state = settle(block, P[0], payload=payload)
    U = np.zeros((P.shape[0], len(block.inputs)))
    U[:, :3], U[:, 3] = P, payload
    _, Y = block.run(state, U[:-1])
    rows = np.vstack([state.outputs, Y])
    names = [port.name for port in block.outputs]
    channels = {name: rows[:, names.index(output)].copy() for name, output in _CHANNELS.items()}
    lost = rows[:, names.index("measurement_valid")] < 0.5
    for name in ("pitch", "roll", "pitch_rate", "roll_rate"):
        channels[name][lost] = np.nan
    set_points = dict(zip(SET_POINTS, P.T, strict=True))
    return Recording(excitation.time, excitation.sample_time, {**set_points, **channels})


def settle(block: Block, set_points: Matrix, *, payload: float = 0.0) -> State:
    """Return the state after the neck was moved from rest to `set_points` (3,) [rad] and came to rest."""
    rise = 0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0, _times(_RAMP + _HOLD, block.sample_time) / _RAMP))
    U = np.zeros((rise.size, len(block.inputs)))
    U[:, :3] = rise[:, None] * np.asarray(set_points)
    U[:, 3] = payload
    return block.run(block.initial_state(), U)[0]


def _times(length: float, sample_time: float) -> Matrix:
    return np.arange(1, round(length / sample_time) + 1) * sample_time


def _check_set_points(P: Matrix, excitation: Excitation, limit: float) -> None:
    if P.ndim != 2 or P.shape[1] != 3 or P.shape[0] < 2:
        raise DataError(f"set-points must have shape (time, 3) with at least 2 rows; got {P.shape}.")
    # A set-point on the limit may exceed it by rounding.
    bad = ~(np.abs(P) <= limit * (1 + 1e-12))
    if bad.any():
        row, motor = np.argwhere(bad)[0]
        raise DataError(
            f"`motor_setpoint_{motor + 1}` of {excitation.name} is {P[row, motor]:g} rad at t = "
            f"{excitation.time[row]:g} s; it must be finite and within +-{limit:g} rad."
        )
