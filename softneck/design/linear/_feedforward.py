"""Model following: feedforward of the reference, and feedback of what the output differs from a plant's response."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, compute_once, to_si
from softneck.estimation import AxisPlant
from softneck.identification import Draws
from softneck.signals import Recording

from ..plants._uncertain import UncertainPlant
from ._axis_loop import delayed_form
from ._controller import AxisController
from ._ports import ControllerLimits, motor_ranges

# A large step, as a share of the largest recorded motion, and the time before and after it [s of a neck's time].
_STEP_SHARE, _HOLD_S = 0.6, 2.0
# The longest dead time that is tried [s of a neck's time].
_MAX_DEAD_TIME_S = 0.3


def follow_model(axis: AxisController, plant: AxisPlant, extra_delay: int, share: float) -> AxisController:
    """Return the axis with `share`/K of the reference as feedforward, K the static gain of `plant`.

    Its feedback sees what the output differs from the response of `plant` (Astrom and Hagglund 2006, Advanced PID
    Control, sec. 5.3). That response is to what the limits leave of the set-point, so the model is no faster than they.
    """
    A, B, C = delayed_form(plant, extra_delay)
    gain, n, m = plant.static_gain, len(axis.A), len(A)
    return AxisController(
        A=np.block([[axis.A, -axis.By * C], [np.zeros((m, n)), A]]),
        Br=np.concatenate([np.zeros(n), B / gain])[:, None],
        By=np.concatenate([axis.By, np.zeros((m, 1))]),
        C=np.concatenate([axis.C, -axis.Dy * C[None, :]], axis=1),
        Dr=share / gain,
        Dy=axis.Dy,
        L=np.concatenate([np.zeros(n), B])[:, None],
    )


def follow_large_moves(uncertain: UncertainPlant, limits: ControllerLimits) -> UncertainPlant:
    """Return the plant with a followed one for each axis: a lag with dead time, of large steps of the draws' model.

    The linear plant of the recordings is slower and has less gain, as friction and hysteresis delay small moves.
    Without draws nothing changes.
    """
    draws = uncertain.draws
    if draws is None:
        return uncertain
    nominal = [axis.nominal for axis in uncertain.axes.values()]

    def find_plants() -> list[AxisPlant]:
        sizes = np.divide(draws.conditions["motion"], [plant.static_gain for plant in nominal])
        return [
            _fit_plant(*_steps(uncertain, draws, limits, k, _STEP_SHARE * float(size)), nominal[k])
            for k, size in enumerate(sizes)
        ]

    found = compute_once(find_plants, draws, nominal, limits.position_limit, limits.slew_limit)
    axes = {
        name: replace(axis, followed=plant) for (name, axis), plant in zip(uncertain.axes.items(), found, strict=True)
    }
    return replace(uncertain, axes=axes)


def _steps(
    uncertain: UncertainPlant, draws: Draws, limits: ControllerLimits, axis: int, size: float
) -> tuple[Matrix, Matrix]:
    """Return input and output (2, time) of an axis after a step up and one down, from rest in the recorded posture."""
    (T, inverse), Ts, motors = uncertain.redefinition, uncertain.sample_time, uncertain.robot.motors
    middle, ends = np.zeros(len(inverse)), motor_ranges(uncertain.robot, limits.position_limit)
    if motors.rest is not None:
        middle = to_si(motors.unit)[0] * np.array(motors.rest)
    elif ends is not None:
        middle = 0.5 * (ends[0] + ends[1])
    middle = middle + inverse[:, -1] * (float(np.mean(draws.conditions["cocontraction"])) - middle.mean())
    rows = round(_HOLD_S * uncertain.axes[uncertain.names[axis]].nominal.second / Ts)
    # As fast as the slew of the motor that moves most allows.
    ramp = np.minimum(limits.slew_limit * Ts / np.abs(size * inverse[:, axis]).max() * np.arange(1, rows + 1), 1.0)
    moved = size * np.concatenate([np.zeros(rows), ramp])[:, None] * inverse[:, axis]
    asked = np.concatenate([middle + moved, middle - moved])
    asked = asked if ends is None else np.clip(asked, *ends)
    steps = Recording.from_arrays(asked, sample_time=Ts, run=np.repeat([1, 2], 2 * rows), robot=uncertain.robot)
    y = np.asarray(draws.model.simulate(steps))[:, axis]
    u, y = (part.reshape(2, -1)[:, rows - 1 :] for part in (asked @ T[axis], y))
    return u - u[:, :1], y - y[:, :1]


def _fit_plant(u: Matrix, y: Matrix, plant: AxisPlant) -> AxisPlant:
    """Return the lag with dead time whose responses to inputs (runs, time) are nearest to `y`.

    Raises SettingsError: nothing moves, or the wrong way.
    """
    from scipy.optimize import minimize_scalar
    from scipy.signal import lfilter

    def response(delay: int, pole: float) -> tuple[float, Vector]:
        x = np.ravel(lfilter(np.append(np.zeros(delay + 1), 1.0 - pole), [1.0, -pole], u))
        return float(x @ y.ravel() / max(x @ x, 1e-300)), x

    def cost(log_lag: float, delay: int) -> float:
        gain, x = response(delay, math.exp(-math.exp(-log_lag)))
        return float(np.sum((y.ravel() - gain * x) ** 2))

    # Lags from half a sample to the whole time, in samples.
    ends = (math.log(0.5), math.log(u.shape[1]))
    delays = range(min(round(_MAX_DEAD_TIME_S * plant.second / plant.sample_time), u.shape[1] // 4) + 1)
    found = [minimize_scalar(cost, bounds=ends, args=(d,), method="bounded") for d in delays]
    delay = int(np.argmin([item.fun for item in found]))
    pole = math.exp(-math.exp(-float(found[delay].x)))
    gain, _ = response(delay, pole)
    if gain * plant.static_gain <= 0.0:
        raise SettingsError(
            "the draws do not move as the linear plant does; leave the feedforward of `reference_time` out."
        )
    return replace(plant, numerator=np.array([gain * (1.0 - pole)]), denominator=np.array([1.0, -pole]), delay=delay)
