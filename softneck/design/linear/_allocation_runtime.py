"""Tilt and co-contraction onto three tendons, within limits that keep the direction of tilt and the tendons taut.

    P = T^-1 (theta_i, phi_i, delta_i)           inverse of Eq. 9-11

Every limit takes a share of the whole move and never of one motor alone: what is left of a tilt points where the
whole did. A tendon only pulls. In the antagonist the tension falls by what the agonist's pull does not stretch, and
in all three by what a payload presses the link together, so a motor that lets out far leaves its tendon slack: then
nothing of it acts, the gain falls to that of the other two, and taking the slack up again costs time. So no
motor goes below a least position; co-contraction, which stretches all three against the link, is raised instead.
"""

import numpy as np


def allocate(inverse: np.ndarray, wanted: np.ndarray, limits: np.ndarray, motors: np.ndarray, held: np.ndarray) -> None:
    """Move the set-points `held` (3,) to `wanted` (theta_i, phi_i, delta_i) as far as the limits let them.

    Args:
        inverse: (3, 3) T^-1 of Eq. 9-11.
        wanted: (3,) [rad].
        limits: (4,) position, lead before the motors, move in one sample, least position [rad].
        motors: (3,) measured positions [rad].
        held: (3,) set-points of the last sample; replaced by those of this one.
    """
    target = np.empty(3)
    allocate_tendons(inverse, wanted, limits[0], limits[3], target)
    allocate_lead(target, motors, limits[1])
    allocate_move(target, limits[2], held)


def allocate_tendons(
    inverse: np.ndarray, wanted: np.ndarray, position: float, least: float, target: np.ndarray
) -> None:
    """Fill `target` (3,) with the motors of `wanted`, none above `position` nor below `least` or -`position`.

    Co-contraction comes before tilt, which is scaled as a whole. Where `least` is above -`position`, co-contraction
    is first raised so far that no motor is below it. `least` must be below `position`; unequal tendons that
    cannot all keep it at rest keep as much of it as they can.
    """
    tilt = np.empty(3)
    # All of the last column are positive where the tendons surround the link.
    most = position / np.max(inverse[:, 2])
    # Co-contraction first: what it leaves is for the tilt.
    common = min(max(wanted[2], -most), most)
    # What the least pulled of unequal tendons has when the most pulled is at its limit: more cannot be kept at rest.
    least = min(least, most * np.min(inverse[:, 2]))
    for j in range(3):
        tilt[j] = inverse[j, 0] * wanted[0] + inverse[j, 1] * wanted[1]
    # At -position the rule asks for nothing: tendons may be let out to the limit.
    taut = least > -position
    if taut:
        for j in range(3):
            common = max(common, least / inverse[j, 2])
    scale = 1.0
    for j in range(3):
        rest = inverse[j, 2] * common  # motor j by co-contraction alone
        if tilt[j] > 0.0:
            # |s p_j + c_j delta| <= P_max, solved for s.
            scale = min(scale, (position - rest) / tilt[j])
        elif tilt[j] < 0.0 and not taut:  # with the rule, `least` is the nearer bound
            scale = min(scale, (position + rest) / -tilt[j])
        if taut:
            for i in range(3):
                # Motor j at `position` while co-contraction keeps motor i at `least`.
                ratio = inverse[j, 2] / inverse[i, 2]
                spread = tilt[j] - ratio * tilt[i]
                # Then `scale * spread + ratio * least` is where motor j is.
                if spread > 0.0:
                    scale = min(scale, (position - ratio * least) / spread)
    scale = max(scale, 0.0)  # never the other way round
    if taut:
        # delta = max(delta_ref, max_j (P_least - s p_j) / c_j).
        for j in range(3):
            common = max(common, (least - scale * tilt[j]) / inverse[j, 2])
    for j in range(3):
        # The limits are kept already, but for rounding.
        target[j] = min(max(inverse[j, 2] * common + scale * tilt[j], -position), position)


def allocate_lead(target: np.ndarray, motors: np.ndarray, lead: float) -> None:
    """Draw `target` (3,) straight towards where the motors are until none has further to go than `lead`."""
    largest = 0.0
    for j in range(3):
        largest = max(largest, abs(target[j] - motors[j]))
    if largest > lead:
        # Towards the motors, so that the integral waits for a drive at its current limit.
        share = lead / largest
        for j in range(3):
            target[j] = motors[j] + share * (target[j] - motors[j])


def allocate_move(target: np.ndarray, move: float, held: np.ndarray) -> None:
    """Move `held` (3,) straight towards `target` (3,), no motor further than `move`."""
    largest = 0.0
    for j in range(3):
        largest = max(largest, abs(target[j] - held[j]))
    share = 1.0 if largest <= move else move / largest
    for j in range(3):
        held[j] += share * (target[j] - held[j])
