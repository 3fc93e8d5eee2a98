"""One sample of an identified nonlinear model as a CasADi expression, on the state vector of the model's own runtime.

Each function says what its runtime says (`identification.networks._nn_runtime` and so on) in free run and without
noise; a test holds both equal. What only measurements and noise touch stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError
from softneck.identification import Model
from softneck.identification.structured import _neck_equations_runtime as neck

Arrays = Sequence[Matrix]


def step_function(model: Model) -> Any:
    """Return `casadi.Function` (state, set-points) -> (next state, pitch and roll one sample later).

    Raises:
        SettingsError: a kind without such an expression.
    """
    import casadi as ca

    if model.kind not in _STEPS:
        raise SettingsError(
            f"nonlinear predictive control is over {', '.join(_STEPS)}; got a model of kind {model.kind}. "
            "For a linear one use `softneck design mpc`."
        )
    size = model.block().initial_state().values.size
    x, u = ca.SX.sym("x", size), ca.SX.sym("u", 3)
    state = [x[i] for i in range(size)]
    y = _STEPS[model.kind](tuple(model.arrays.values()), state, [u[j] for j in range(3)])
    return ca.Function("model", [x, u], [ca.vertcat(*state), ca.vertcat(*y)], ["x", "u"], ["x_next", "y"])


def _observe(arrays: Arrays, x: list[Any], u: list[Any]) -> None:
    """Push what is known at t_k into the histories (`narx_observe`)."""
    h = int(arrays[0][0])
    now = 8 * h
    for j in range(3):
        if arrays[1][j, 1] == 0.0:
            x[now + j] = u[j]
    x[3 : 3 * h] = x[: 3 * h - 3]
    x[3 * h + 3 : 6 * h] = x[3 * h : 6 * h - 3]
    x[6 * h + 2 : 8 * h] = x[6 * h : 8 * h - 2]
    x[:3] = u
    x[3 * h : 3 * h + 3] = x[now : now + 3]
    x[6 * h : 6 * h + 2] = [x[now + 3 + i] - x[now + 11 + i] for i in range(2)]


def _drives(arrays: Arrays, load: Matrix, x: list[Any], q: list[Any], m: list[Any]) -> None:
    """Move the motors on, stopped under load (`drive_advance`)."""
    import casadi as ca

    now = 8 * int(arrays[0][0])
    mean = (q[0] + q[1] + q[2]) / 3.0
    for j in range(3):
        pole, delay = float(arrays[1][j, 0]), int(arrays[1][j, 1])
        if delay > 0:
            limit = load[1] + load[2] * (q[j] - mean) + load[3] * mean
            x[now + j] = ca.fmin(pole * m[j] + (1.0 - pole) * x[3 * (delay - 1) + j], ca.fmax(limit, m[j]))


def _nn(arrays: Arrays, x: list[Any], u: list[Any]) -> list[Any]:
    import casadi as ca

    h = int(arrays[0][0])
    size, now = 8 * h + 13, 8 * h
    _observe(arrays, x, u)
    m, load = list(x[3 * h : 3 * h + 3]), arrays[11]
    x[size : size + 3] = [load[0] * x[size + j] + (1.0 - load[0]) * m[j] for j in range(3)]
    y = []
    for axis in range(2):
        own, disturbance = x[size + 3 + axis], x[size + 5 + axis]
        memory, gain = arrays[12][axis]
        kept = memory * (disturbance + gain * (x[6 * h + axis] - own - disturbance))
        z = (ca.vertcat(*_regressor(arrays, x, axis)) - arrays[9][axis, 0]) / arrays[9][axis, 1]
        first = ca.tanh(ca.mtimes(ca.DM(arrays[3][axis]), z) + arrays[4][axis])
        second = ca.tanh(ca.mtimes(ca.DM(arrays[5][axis]), first) + arrays[6][axis])
        value = ca.dot(ca.DM(arrays[7][axis]), second) + float(np.ravel(arrays[8][axis])[0])
        x[size + 5 + axis] = kept
        x[size + 3 + axis] = arrays[10][axis, 0] + arrays[10][axis, 1] * value
        y.append(x[size + 3 + axis] + kept)
    _drives(arrays, load, x, x[size : size + 3], m)
    x[now + 3 : now + 5] = y
    return y


def _regressor(arrays: Arrays, x: list[Any], axis: int) -> list[Any]:
    h = int(arrays[0][0])
    values = []
    for source, channel, lag in arrays[2].astype(int).tolist():
        back = lag - 1
        places = (6 * h + 2 * back + axis, 3 * back + channel, 3 * h + 3 * back + channel, 6 * h + 2 * back + channel)
        values.append(x[places[min(source, 3)]])
    return values


def _echo(arrays: Arrays, weights: Matrix, x: list[Any], f: list[Any]) -> list[Any]:
    """Return the angles: what the equations say and the echo of what was measured; remember the first."""
    h = int(arrays[0][0])
    y = []
    for axis in range(2):
        echo = sum(float(weights[axis, i]) * x[6 * h + 2 * i + axis] for i in range(weights.shape[1]))
        y.append(f[axis] + echo)
        x[8 * h + 11 + axis] = f[axis]
    x[8 * h + 3 : 8 * h + 5] = y
    return y


def _plays(redefinition: Matrix, widths: Matrix, m: list[Any], plays: list[Any]) -> list[Any]:
    """Move `plays` to `m` and return each redefined input as it is and behind its plays."""
    import casadi as ca

    signals = []
    for c in range(3):
        v = sum(float(redefinition[c, j]) * m[j] for j in range(3))
        signals.append(v)
        for i, width in enumerate(widths.tolist()):
            at = c * widths.size + i
            plays[at] = ca.fmax(v - width, ca.fmin(v + width, plays[at]))
            signals.append(plays[at])
    return signals


def _play(arrays: Arrays, x: list[Any], u: list[Any]) -> list[Any]:
    import casadi as ca

    h, count = int(arrays[0][0]), arrays[4].shape[0]
    size = 8 * h + 13
    _observe(arrays, x, u)
    m, load, pole, order = list(x[3 * h : 3 * h + 3]), arrays[2], float(arrays[5][0]), int(arrays[5][1])
    x[size : size + 3] = [load[0] * x[size + j] + (1.0 - load[0]) * m[j] for j in range(3)]
    plays = x[size + 3 : size + 3 + 3 * count]
    signals = _plays(arrays[3], arrays[4], m, plays)
    x[size + 3 : size + 3 + 3 * count] = plays
    first = size + 3 + 3 * count
    bank = x[first:]
    for i, signal in enumerate(signals):
        for o in range(order - 1, 0, -1):
            bank[i * order + o] = pole * bank[i * order + o] + (1.0 - pole) * bank[i * order + o - 1]
        bank[i * order] = pole * bank[i * order] + (1.0 - pole) * signal
    x[first:] = bank
    f = []
    terms = [math.prod([bank[at] for at in row if at >= 0], start=1.0) for row in arrays[6].astype(int).tolist()]
    for axis in range(2):
        total = sum(float(w) * term for w, term in zip(arrays[7][axis], terms, strict=True))
        f.append(ca.fmin(ca.fmax(total, arrays[8][axis, 0]), arrays[8][axis, 1]))
    y = _echo(arrays, arrays[9], x, f)
    _drives(arrays, load, x, x[size : size + 3], m)
    return y


def _greybox(arrays: Arrays, x: list[Any], u: list[Any]) -> list[Any]:
    h = int(arrays[0][0])
    size, now = 8 * h + 13, 8 * h
    _observe(arrays, x, u)
    m = list(x[3 * h : 3 * h + 3])
    targets = [x[3 * (int(arrays[1][j, 1]) - 1) + j] for j in range(3)]
    body = x[size:]
    _neck_advance(arrays[2], float(arrays[3][1]), targets, m, body)
    _neck_sense(arrays[2], float(arrays[3][1]), body)
    x[size:] = body
    y = _echo(arrays, arrays[4], x, [body[5], body[6]])
    x[now : now + 3] = m
    return y


def _neck_advance(p: Matrix, sample_time: float, targets: list[Any], m: list[Any], x: list[Any]) -> None:
    """Move motors and neck on by one sample (`neck_advance`)."""
    dt = sample_time / neck._SUBSTEPS
    keep = math.exp(-p[neck.NECK_DRIVE_RATE] * dt)
    angles = [p[neck.NECK_TWIST] + 2.0943951023931953 * j for j in range(3)]
    for _ in range(neck._SUBSTEPS):
        _neck_substep(p, dt, keep, [(math.cos(a), math.sin(a)) for a in angles], targets, m, x)


def _neck_substep(
    p: Matrix, dt: float, keep: float, ways: list[tuple[float, float]], targets: list[Any], m: list[Any], x: list[Any]
) -> None:
    import casadi as ca

    pulls, taut = [], 0
    for j, (c, s) in enumerate(ways):
        toward = c * x[0] + s * x[1]
        limit = p[neck.NECK_PULL_LIMIT] - p[neck.NECK_PRETENSION] + p[neck.NECK_LEVER] * toward + x[4]
        m[j] = ca.fmin(keep * m[j] + (1.0 - keep) * targets[j], limit)
    for j, (c, s) in enumerate(ways):
        stretch = p[neck.NECK_PRETENSION] + m[j] - p[neck.NECK_LEVER] * (c * x[0] + s * x[1]) - x[4]
        taut += ca.if_else(stretch > 0.0, 1.0, 0.0)
        pulls.append(ca.fmax(stretch, 0.0))
    squared = x[0] * x[0] + x[1] * x[1]
    loss = p[neck.NECK_STIFFENING] * squared
    gain, friction = p[neck.NECK_GAIN], p[neck.NECK_FRICTION]
    rate = p[neck.NECK_STIFFNESS] + 3.0 * loss + 0.5 * taut * gain * p[neck.NECK_LEVER] + friction
    moved = []
    for axis, sign in ((0, 1.0), (1, -1.0)):
        pull = sum(pulls[j] * ways[j][axis] for j in range(3))
        stiffness = p[neck.NECK_STIFFNESS] * (1.0 + sign * p[neck.NECK_ASYMMETRY])
        force = gain * pull - stiffness * (x[axis] - p[neck.NECK_REST + axis]) - loss * x[axis] - friction * x[2 + axis]
        moved.append(dt * force / (1.0 + dt * rate))
    x[0], x[1] = x[0] + moved[0], x[1] + moved[1]
    # A root of zero has no derivative; 1e-24 rad^2 is none that a double sees beside a bend.
    size = ca.sqrt(x[0] * x[0] + x[1] * x[1] + 1e-24)
    share = ca.fmin(1.0, neck._LARGEST_BEND / size)
    x[0], x[1] = x[0] * share, x[1] * share
    forget = 1.0 + ca.sqrt(moved[0] ** 2 + moved[1] ** 2 + 1e-24) / p[neck.NECK_FRICTION_ANGLE]
    x[2], x[3] = (x[2] + moved[0]) / forget, (x[3] + moved[1]) / forget
    axial, compliance = p[neck.NECK_AXIAL_RATE], p[neck.NECK_COMPLIANCE]
    rise = axial * (compliance * (sum(pulls) - 3.0 * p[neck.NECK_PRETENSION]) - x[4])
    x[4] = x[4] + dt * rise / (1.0 + dt * axial * (1.0 + compliance * taut))


def _neck_sense(p: Matrix, sample_time: float, x: list[Any]) -> None:
    import casadi as ca

    size = ca.sqrt(x[0] * x[0] + x[1] * x[1] + 1e-24)
    part = ca.sin(size) / size
    lines = (len(x) - neck.NECK_STATES) // 2
    keep = math.exp(-p[neck.NECK_SENSOR_RATE] * sample_time)
    for axis in range(2):
        tilt = ca.atan2(part * x[axis], ca.cos(size))
        first = neck.NECK_STATES + axis * lines
        seen = tilt
        if lines > 0:
            seen = x[first + lines - 1]
            x[first + 1 : first + lines] = x[first : first + lines - 1]
            x[first] = tilt
        x[5 + axis] = keep * x[5 + axis] + (1.0 - keep) * seen


def _nss(arrays: Arrays, x: list[Any], u: list[Any]) -> list[Any]:
    import casadi as ca

    h, count, n = int(arrays[0][0]), arrays[4].shape[0], arrays[6].shape[0]
    size = 8 * h + 13
    _observe(arrays, x, u)
    m, load = list(x[3 * h : 3 * h + 3]), arrays[2]
    x[size : size + 3] = [load[0] * x[size + j] + (1.0 - load[0]) * m[j] for j in range(3)]
    plays = x[size + 3 : size + 3 + 3 * count]
    late = 3 * h + 3 * int(arrays[5][0])
    v = ca.vertcat(*_plays(arrays[3], arrays[4], x[late : late + 3], plays))
    x[size + 3 : size + 3 + 3 * count] = plays
    A, B, E, F, G, b, D = (arrays[i] for i in range(6, 13))
    body = ca.vertcat(*x[size + 3 + 3 * count :])
    total = ca.mtimes(ca.DM(F), body) + ca.mtimes(ca.DM(G), v) + b
    t: list[Any] = []
    for i in range(b.shape[0]):
        t.append(ca.tanh(total[i] + sum(float(D[i, j]) * t[j] for j in range(i) if D[i, j] != 0.0)))
    body = ca.mtimes(ca.DM(A), body) + ca.mtimes(ca.DM(B), v) + ca.mtimes(ca.DM(E), ca.vertcat(*t))
    x[size + 3 + 3 * count :] = [body[i] for i in range(n)]
    f = []
    for axis in range(2):
        value = float(arrays[14][axis]) + ca.dot(ca.DM(arrays[13][axis]), body)
        f.append(ca.fmin(ca.fmax(value, arrays[15][axis, 0]), arrays[15][axis, 1]))
    y = _echo(arrays, arrays[16], x, f)
    _drives(arrays, load, x, x[size : size + 3], m)
    return y


_STEPS: dict[str, Callable[[Arrays, list[Any], list[Any]], list[Any]]] = {
    "nn": _nn,
    "play": _play,
    "greybox": _greybox,
    "nss": _nss,
}
NONLINEAR_KINDS = tuple(_STEPS)
