"""Scores of the charts of motors and tilt, cycle by cycle: whitening, features, hypotheses, scores.

All arrays belong to the callers (`MotorCharts`, `TiltCharts`), which document them.
"""

import math

import numpy as np

SUPERVISED_NOT = -1e6
# Innovations and faults are clipped to this number of standard deviations: no model is accurate to a few per cent in
# each sample, and no single sample should decide.
CHART_CLIP = 5.0


def chart_shift(innovation: float, mean: float, variance: float, sight: float) -> float:
    """Return s for a shift by `mean`, which is limited to `sight` standard deviations."""
    spread = max(math.sqrt(variance), abs(mean) / sight)
    e = innovation / spread
    f = mean / spread
    # Clipped around the fault's mean as well: the part explained by the fault is not limited.
    seen = min(max(e, min(f, 0.0) - CHART_CLIP), max(f, 0.0) + CHART_CLIP)
    return f * seen - 0.5 * f * f


def chart_spread(innovation: float, variance: float, ratio: float) -> float:
    """Return s for a change of variance by `ratio` (Basseville and Nikiforov, example 2.2.2)."""
    square = min(innovation * innovation / variance, CHART_CLIP * CHART_CLIP * max(1.0, ratio))
    return 0.5 * (1.0 - 1.0 / ratio) * square - 0.5 * math.log(ratio)


def chart_whiten(coefficients: np.ndarray, past: np.ndarray, values: np.ndarray, channel: int) -> None:
    """Whiten a channel of `values` (kinds, channels) in place, and store it in `past` (order, kinds, channels)."""
    order = coefficients.shape[0]
    for i in range(values.shape[0]):
        value = values[i, channel]
        for k in range(order):
            values[i, channel] -= coefficients[k, channel] * past[k, i, channel]
        for k in range(order - 1, 0, -1):
            past[k, i, channel] = past[k - 1, i, channel]
        if order > 0:
            past[0, i, channel] = value


def chart_push(past: np.ndarray, values: np.ndarray) -> None:
    """Insert `values` (channels,) as the first row of `past` and drop the last one."""
    for k in range(past.shape[0] - 1, 0, -1):
        for j in range(values.shape[0]):
            past[k, j] = past[k - 1, j]
    for j in range(values.shape[0]):
        past[0, j] = values[j]


def supervised_features(
    now: tuple, past: tuple, x: np.ndarray, edges: np.ndarray, asked: tuple[int, int], cycle: float
) -> None:
    """Add one cycle of (set-points, positions, tensions), each (motors,), to `past` and compute the features `x`.

    `x` is (cycles, motors, features): positions of all motors, friction at each edge, three speeds, and the distances
    to past set-points.
    """
    setpoints, positions, tensions = now
    s, p, tension = past
    chart_push(s, setpoints)
    chart_push(p, positions)
    chart_push(tension, tensions)
    n = positions.shape[0]
    for i in range(n):
        for k in range(x.shape[0] - 1, 0, -1):
            for j in range(x.shape[2]):
                x[k, i, j] = x[k - 1, i, j]
        for j in range(n):
            x[0, i, j] = positions[j]
        speed = (p[0, i] - p[1, i]) / cycle
        at = n
        for j in range(edges.shape[0]):
            x[0, i, at] = math.tanh(speed / edges[j])
            at += 1
        for k in range(3):
            x[0, i, at] = (p[k, i] - p[k + 1, i]) / cycle
            at += 1
        for k in range(asked[0], asked[1]):
            x[0, i, at] = s[k, i] - positions[i]
            at += 1


def supervised_motors(model: tuple, rules: tuple, past: tuple, x: np.ndarray, white: tuple, rest: np.ndarray,
                      scales: np.ndarray, cycle: float, scores: np.ndarray) -> None:  # fmt: skip
    """Fill the scores (kinds x motors,) of one cycle: jams, jumps, and each scale of the currents.

    Args:
        model: drive, its spread, its fastest steps, current, its spread, top, reach, and the tension below which a
            tendon may be slack.
        rules: of `MotorRules`.
        past: set-points, positions, tensions so far.
        x: features.
        white: coefficients and past of the currents' whitening, and a buffer (1 + scales, motors).
        rest: remaining cycles for which each current is not evaluated (motors,).
        scales: hypotheses of a wrong current scale.
        cycle: of the bus [s].
        scores: out.
    """
    drive, drive_spread, fastest, current, current_spread, top, reach, slack = model
    usual, excited, sight, known, stands, near_top, cut, _ = rules
    s, p, tension = past
    coefficients, before, values = white
    n, last = rest.shape[0], x.shape[0] - 1
    for i in range(n):
        expected, behind = 0.0, 0.0
        for k in range(s.shape[0]):
            expected += drive[i, k] * (s[k, i] - p[1, i])
            behind = max(behind, abs(s[k, i] - p[0, i]))
        moved = p[0, i] - p[1, i]
        spread = drive_spread[i, 0] + drive_spread[i, 1] * expected * expected
        # A motor that turns is not jammed, even if it is late: an overloaded motor still creeps.
        turns = abs(moved) > stands * cycle
        scores[i] = SUPERVISED_NOT if turns else chart_shift(moved - expected, -expected, spread, CHART_CLIP)
        # A jump is larger than expected, or in the other direction, and larger than any calibrated step.
        jumps = abs(moved) > abs(expected) and abs(moved) > fastest[i]
        more = abs(moved - expected) / math.sqrt(spread) if jumps else 0.0
        scores[n + i] = more - usual
        change, taut = 0.0, tension[0, i]
        for j in range(x.shape[2]):
            change += current[i, j] * (x[0, i, j] - x[last, i, j])
            if j >= n:
                taut -= current[i, j] * x[0, i, j]
        values[0, i] = tension[0, i] - tension[last, i] - change
        for k in range(scales.shape[0]):
            values[1 + k, i] = (scales[k] - 1.0) * change
        chart_whiten(coefficients, before, values, i)
        # Currents at their limit, or of a tendon that is or was just slack, are not evaluated.
        silent = abs(abs(tension[0, i]) / top[i] - 1.0) < near_top or taut < slack[i]
        rest[i] = cut if silent else rest[i] - 1.0
        # Nor those of motors further from their set-points than in nearly all of the commissioning run.
        quiet = behind > reach[i] or rest[i] > 0.0 or change * change < excited * excited * current_spread[i, 0]
        spread = current_spread[i, 0] + current_spread[i, 1] * change * change
        for k in range(scales.shape[0]):
            f = values[1 + k, i]
            # All scales within a tolerance of the right one count as right.
            allowed = known * min(f * f / (abs(scales[k] - 1.0) * spread), sight * sight)
            score = chart_shift(values[0, i], f, spread, sight) - allowed
            scores[(2 + k) * n + i] = 0.0 if quiet else score


def supervised_load(off: np.ndarray, load: np.ndarray, counted: np.ndarray, memory: float) -> None:
    """Update the mean over the last cycles of the residual of each motor's other tensions (motors,) [N]."""
    counted[0] = min(counted[0] + 1.0, memory)
    for i in range(load.shape[0]):
        load[i] += (off[i] - load[i]) / counted[0]


def supervised_levels(model: tuple, rules: tuple, past: tuple, x: np.ndarray, rest: np.ndarray, scales: np.ndarray,
                      carried: tuple, scores: np.ndarray) -> None:  # fmt: skip
    """Fill the scores (scales x motors,) of each tension against those of the other tendons, which share a payload.

    Args:
        model: level, its spread, mean of the others by position, top, reach, and the tension below which a tendon may
            be slack.
        rules, past, x, rest, scales, scores: as in `supervised_motors`.
        carried: residual of the others, its mean over the last cycles (motors,) each, and the number of cycles.
    """
    level, spread, others, top, reach, slack = model
    sight, near_top, memory = rules[2], rules[5], rules[7]
    off, load, counted = carried
    s, p, tension = past
    n, features = rest.shape[0], x.shape[2]
    known = n > 1
    for i in range(n):
        known = known and slack[i] <= tension[0, i] <= (1.0 - near_top) * top[i]
        for k in range(s.shape[0]):
            known = known and abs(s[k, i] - p[0, i]) <= reach[i]
        off[i] = -others[i, n]
        for j in range(n):
            off[i] -= others[i, j] * p[0, j]
            if j != i:
                off[i] += tension[0, j] / (n - 1)
    if known:
        supervised_load(off, load, counted, memory)
    for i in range(n):
        # Over a few cycles friction has not averaged out.
        expected, quiet = level[i, features + 1], not known or counted[0] < 0.1 * memory
        for j in range(features):
            expected += level[i, j] * x[0, i, j]
        for j in range(n):
            quiet = quiet or rest[j] > 0.0
        expected += level[i, features] * load[i]
        # A slack tendon shows no scale: half of the expected tension must be well above slack.
        quiet = quiet or expected < 3.0 * slack[i]
        for k in range(scales.shape[0]):
            score = chart_shift(tension[0, i] - expected, (scales[k] - 1.0) * expected, spread[i], sight)
            # A sum from before the pause does not count: two halves of the evidence are not evidence.
            scores[k * n + i] = SUPERVISED_NOT if quiet else score


def supervised_angle(gains: np.ndarray, lags: np.ndarray, past: np.ndarray, positions: np.ndarray,
                     parts: np.ndarray) -> None:  # fmt: skip
    """Compute each motor's part of the tilt (motors, outputs) [rad] from its past positions."""
    chart_push(past, positions)
    for i in range(parts.shape[0]):
        for a in range(parts.shape[1]):
            parts[i, a] = 0.0
            for k in range(lags.shape[0]):
                parts[i, a] += gains[a, k, i] * past[lags[k], i]


def supervised_faults(gears: np.ndarray, offset: float, seen: tuple, raw: np.ndarray) -> None:
    """Fill `raw` (1 + hypotheses, outputs) with the residual and its mean under each fault hypothesis."""
    residual, parts, began, late, stuck = seen
    n, m = parts.shape
    raw[:] = 0.0
    for a in range(m):
        angle, moved = 0.0, 0.0
        for i in range(n):
            angle += parts[i, a]
            moved += parts[i, a] - began[i, a]
        raw[0, a] = residual[a]
        at = 1
        for g in range(gears.shape[0]):
            # Wrong gear in the drives file: the winch turned this number of times as far as its counts.
            for i in range(n):
                raw[at, a] = (gears[g] - 1.0) * (parts[i, a] - began[i, a])
                at += 1
            raw[at, a] = (gears[g] - 1.0) * moved
            at += 1
        raw[at + a, a] = stuck[a] - angle
        raw[at + m + a, a] = -2.0 * moved
        at += 2 * m
        # Axes a and a + 1 are swapped: each shows the motion of the other.
        if a > 0:
            raw[at + a - 1, a] -= moved
            raw[at + a - 1, a - 1] += moved
        if a < m - 1:
            raw[at + a, a] -= moved
            raw[at + a, a + 1] += moved
        at += m - 1
        raw[at, a] = late[a] - angle
        raw[at + 1 + 2 * a, a] = offset
        raw[at + 2 + 2 * a, a] = -offset


def supervised_tilt(spreads: np.ndarray, allowed: np.ndarray, squares: tuple, white: tuple, sums: tuple,
                    lately: float, good: bool, scores: np.ndarray) -> None:  # fmt: skip
    """Fill the scores of the first hypotheses, and discount their evidence by `lately`.

    Args:
        spreads: variance of each output and its parts in the squares (outputs, 3).
        allowed: slow model error of each innovation (outputs,).
        squares: of the change over two samples, and of the distance (outputs,) each.
        white: coefficients, past and values of the whitening.
        sums: explained and information of each hypothesis.
        lately: discount factor of these.
        good: whether the model is valid.
        scores: out.
    """
    coefficients, before, values = white
    explained, information = sums
    for a in range(spreads.shape[0]):
        chart_whiten(coefficients, before, values, a)
    for k in range(explained.shape[0]):
        score, fits, size = 0.0, 0.0, 0.0
        for a in range(spreads.shape[0]):
            spread = spreads[a, 0] + spreads[a, 1] * squares[0][a] + spreads[a, 2] * squares[1][a]
            f = values[1 + k, a]
            score += chart_shift(values[0, a], f, spread, CHART_CLIP) - abs(f) * allowed[a] / spread
            fits += f * values[0, a] / spread
            size += f * f / spread
        scores[k] = score if good else 0.0
        explained[k] = (lately if good else 0.0) * explained[k] + fits
        information[k] = (lately if good else 0.0) * information[k] + size


def supervised_noise(bend: np.ndarray, noise: np.ndarray, ratios: np.ndarray, good: bool, scores: np.ndarray) -> None:
    """Fill the scores of the noise, for each output and each ratio of variances."""
    for a in range(bend.shape[0]):
        for k in range(ratios.shape[0]):
            score = chart_spread(bend[a], noise[a], ratios[k])
            scores[ratios.shape[0] * a + k] = score if good else 0.0
