"""Tilt and co-contraction onto motors, within limits that keep the direction of tilt and the tendons taut.

    P = T^-1 (theta_i, phi_i, delta_i)           inverse of Eq. 9-11

Of other robots than the neck the tilt has an axis for each output, and co-contraction is the last column of T^-1 or
nothing (see `_redefined.py`).

Every limit takes a share of the whole move and never of one motor alone: what is left of a tilt points where the
whole did. A tendon only pulls. In the antagonist the tension falls by what the agonist's pull does not stretch, and
in all three by what a payload presses the link together, so a motor that lets out far leaves its tendon slack: then
nothing of it acts, the gain falls to that of the other two, and taking the slack up again costs time. So no
motor goes below a least position; co-contraction, which stretches all three against the link, is raised instead.
"""

import numpy as np

# More than any co-contraction; the square of it is a number still.
ALLOCATION_FAR = 1e150


def allocate(
    inverse: np.ndarray, wanted: np.ndarray, limits: np.ndarray, taut: bool, motors: np.ndarray, held: np.ndarray
) -> None:
    """Move the set-points `held` (motors,) to `wanted` (tilt of each axis, co-contraction) as far as the limits let.

    Args:
        inverse: (motors, axes + 1) T^-1 of Eq. 9-11.
        wanted: (axes + 1,).
        limits: (3 + 2 motors,) lead before the motors, move in one sample, least position, and the lowest and the
            highest set-point of each motor; changed.
        taut: whether co-contraction is raised where a motor would go below its least or lowest position.
        motors: (motors,) measured positions.
        held: (motors,) set-points of the last sample; replaced by those of this one.
    """
    target = np.empty(inverse.shape[0])
    allocate_tendons(inverse, wanted, limits, taut, target)
    allocate_lead(target, motors, limits[0])
    allocate_move(target, limits[1], held)


def allocate_tendons(
    inverse: np.ndarray, wanted: np.ndarray, limits: np.ndarray, taut: bool, target: np.ndarray
) -> None:
    """Fill `target` (motors,) with the motors of `wanted`, none beyond the lowest and highest of `limits`.

    Co-contraction comes before tilt, which is scaled as a whole. Where tendons are to stay `taut`, co-contraction
    is first raised so far that no motor is below its least position. That must be below the highest; unequal tendons
    that cannot all keep it at rest keep as much of it as they can.
    """
    n, axes = inverse.shape[0], inverse.shape[1] - 1
    low, high = limits[3 : 3 + n], limits[3 + n :]
    most, lowest, smallest = ALLOCATION_FAR, -ALLOCATION_FAR, ALLOCATION_FAR
    for j in range(n):
        tilt = inverse[j, 0] * wanted[0]
        for i in range(1, axes):
            tilt += inverse[j, i] * wanted[i]
        target[j] = tilt  # until the end `target` holds the tilt alone
        share = inverse[j, axes]
        if share < 0.0:
            # One that co-contraction lets out is reckoned the other way round, its least position as a highest one.
            target[j] = -tilt
            floor = -high[j]
            high[j] = -max(low[j], limits[2]) if taut else -low[j]
            low[j] = floor
            share = -share
        if share > 0.0:
            most = min(most, high[j] / share)
            lowest = max(lowest, low[j] / share)
            smallest = min(smallest, share)
    # Co-contraction first: what it leaves is for the tilt.
    common = min(max(wanted[axes], lowest), most)
    # What the least pulled of unequal tendons has when the most pulled is at its limit: more cannot be kept at rest.
    least = min(limits[2], most * smallest)
    if taut:
        for j in range(n):
            share = abs(inverse[j, axes])
            if share > 0.0:
                common = max(common, allocate_floor(low[j], least, inverse[j, axes], taut) / share)
    scale = allocate_scale(inverse, low, high, least, taut, target, common)  # pyright: ignore[reportArgumentType]
    if taut:
        # delta = max(delta_ref, max_j (P_least - s p_j) / c_j).
        for j in range(n):
            share = abs(inverse[j, axes])
            if share > 0.0:
                floor = allocate_floor(low[j], least, inverse[j, axes], taut)
                common = max(common, (floor - scale * target[j]) / share)
    for j in range(n):
        # The limits are kept already, but for rounding.
        position = min(max(abs(inverse[j, axes]) * common + scale * target[j], low[j]), high[j])
        target[j] = -position if inverse[j, axes] < 0.0 else position


def allocate_floor(low: float, least: float, share: float, taut: bool) -> float:
    """Return the lower bound of a motor; a motor with a negative `share` of co-contraction has no least position."""
    return max(low, least) if taut and share >= 0.0 else low


def allocate_scale(
    inverse: np.ndarray, low: np.ndarray, high: np.ndarray, least: float, taut: bool, tilt: np.ndarray, common: float
) -> float:
    """Return the largest share of `tilt` (motors,), 0 to 1, that leaves every motor within its limits."""
    n, axes = inverse.shape[0], inverse.shape[1] - 1
    scale = 1.0
    for j in range(n):
        share = abs(inverse[j, axes])
        rest = share * common  # motor j by co-contraction alone
        if tilt[j] > 0.0:
            # |s p_j + c_j delta| <= P_max, solved for s.
            scale = min(scale, (high[j] - rest) / tilt[j])
        elif tilt[j] < 0.0 and not (taut and share > 0.0):  # with the rule co-contraction is raised instead
            scale = min(scale, (rest - allocate_floor(low[j], least, inverse[j, axes], taut)) / -tilt[j])
        if taut:
            for i in range(n):
                other = abs(inverse[i, axes])
                if other > 0.0:
                    # Motor j at its highest while co-contraction keeps motor i at its least.
                    ratio = share / other
                    spread = tilt[j] - ratio * tilt[i]
                    # Then `scale * spread + ratio * least` is where motor j is.
                    if spread > 0.0:
                        floor = allocate_floor(low[i], least, inverse[i, axes], taut)
                        scale = min(scale, (high[j] - ratio * floor) / spread)
    return max(scale, 0.0)  # never the other way round


def allocate_lead(target: np.ndarray, motors: np.ndarray, lead: float) -> None:
    """Draw `target` (motors,) straight towards where the motors are until none has further to go than `lead`."""
    largest = 0.0
    for j in range(target.shape[0]):
        largest = max(largest, abs(target[j] - motors[j]))
    if largest > lead:
        # Towards the motors, so that the integral waits for a drive at its current limit.
        share = lead / largest
        for j in range(target.shape[0]):
            target[j] = motors[j] + share * (target[j] - motors[j])


def allocate_move(target: np.ndarray, move: float, held: np.ndarray) -> None:
    """Move `held` (motors,) straight towards `target` (motors,), no motor further than `move`."""
    largest = 0.0
    for j in range(target.shape[0]):
        largest = max(largest, abs(target[j] - held[j]))
    share = 1.0 if largest <= move else move / largest
    for j in range(target.shape[0]):
        held[j] += share * (target[j] - held[j])
