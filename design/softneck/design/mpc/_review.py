"""What is wrong with a predictive controller's set-up, before it moves anything."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from . import _mpc_state_runtime as rt

if TYPE_CHECKING:
    from ._controller import MpcController

# Half the digits of a double.
_ILL_CONDITIONED = 1e8
# Of the way that an input of one takes to rest, seen by the end of the horizon.
_SEEN = 0.5


def review(controller: MpcController) -> list[str]:
    """Return one line for each finding."""
    c, q = controller, controller.arrays[0]
    lines = []
    settings = c.design.get("settings", {})
    condition = float(np.linalg.cond(c.arrays[16]))
    if condition > _ILL_CONDITIONED:
        lines.append(f"the QP is ill-conditioned ({condition:.1g}): bring the weights closer together.")
    horizon = int(settings.get("horizon", 0))
    delay = int(q[rt.MPC_PAST])
    if horizon <= delay:
        lines.append(
            f"the horizon ({horizon} samples) is not longer than the dead time ({delay}); it is counted behind it, but "
            "a plan that short sees no more than it has already caused: take 30."
        )
    lines += _limits(c)
    n = int(q[rt.MPC_ORDER])
    for axis, name in enumerate(("pitch", "roll")):
        A = c.arrays[1][axis * n : (axis + 1) * n]
        radius = float(np.abs(np.linalg.eigvals(A)).max())
        if 0.0 < radius < 1.0 and 1.0 - radius**horizon < _SEEN:
            lines.append(f"{name}: the horizon ends before half of a move's effect is seen; lengthen it.")
    Ms = max(c.design.get("sensitivity", [1.0]))
    if Ms > 2.0:
        lines.append(f"Ms is {Ms:.2f}: not robust. Ask for less `max_sensitivity`.")
    if c.design.get("spectral_radius", 0.0) >= 1.0:
        lines.append("the loop with the identified plant is not stable without limits; ask for less.")
    return lines


def _limits(c: MpcController) -> list[str]:
    lines = []
    travel = 2.0 * c.position_limit
    if c.slew_limit * c.sample_time > travel:
        lines.append("the slew limit lets a motor cross its range within a sample: it limits nothing.")
    if c.lead_limit < c.slew_limit * c.sample_time:
        lines.append(
            f"lead_limit {c.lead_limit:g} rad is less than one sample's slew "
            f"({c.slew_limit * c.sample_time:g} rad): the slew limit is never reached."
        )
    n = int(c.arrays[0][rt.MPC_ORDER])
    gains = [float(c.arrays[4][axis, 0]) for axis in range(2)]
    if c.angle_limit is not None:
        T_inverse = np.linalg.inv(c.arrays[8])
        for axis, name in enumerate(("pitch", "roll")):
            needed = float(np.abs(T_inverse[:, axis]).max()) * c.angle_limit / abs(gains[axis])
            if needed > c.position_limit:
                reach = c.angle_limit * c.position_limit / needed
                lines.append(
                    f"{name}: its limit of {math.degrees(c.angle_limit):.3g} deg is beyond what the motors reach "
                    f"({math.degrees(reach):.3g} deg): it limits nothing."
                )
    if c.minimum_tautness is not None and c.minimum_tautness > 0.0:
        lines.append(
            f"minimum_tautness {c.minimum_tautness:g} rad is above rest: the neck is compressed all the time, and a "
            "co-contraction reference below that is never reached."
        )
    if not np.isfinite(c.arrays[10]).all() or n < 1:
        lines.append("the arrays are damaged; design it again.")
    return lines
