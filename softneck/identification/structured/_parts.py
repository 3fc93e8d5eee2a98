"""The optional parts of the grey box: anisotropy, stop, softening, creep, displaced tendons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import SettingsError, Vector

from ._output_error import FitProblem, Found, SearchProgress
from ._parameters import PARTS


def parts_of(body: str) -> tuple[str, ...]:
    """Return the parts that the setting `body` names: "rigid" none, "all", or some joined by plus signs."""
    if body == "rigid":
        return ()
    parts = tuple(PARTS) if body == "all" else tuple(body.split("+"))
    if len(set(parts)) < len(parts) or not set(parts) <= set(PARTS):
        raise SettingsError(f"`body` must be rigid, all, or some of {', '.join(PARTS)} joined by `+`; got {body!r}.")
    return parts


def extend(found: Found, parts: Sequence[str], evaluations: int, tell: SearchProgress) -> Found:
    """Return the fit with the numbers of `parts`, searched from what was found without.

    Those that a robot cannot have are left out: tendons of other robots, anisotropy in a plane.
    """
    can = {"tendons": found.problem.has_neck_tendons, "anisotropy": found.problem.has_two_outputs}
    able = [part for part in parts if can.get(part, True)]
    larger = found.problem.as_sure_as(found.x, found.delay).with_parts(*able)
    new = larger.numbers[len(found.x) :]
    tell.what = "parts"
    x = np.concatenate([found.x, [number.encode(number.guess) for number in new]])
    return larger.search(x, found.delay, evaluations, tell) if able else found


def describe_parts(problem: FitProblem, x: Vector, second: float) -> str:
    """Return in words what the optional numbers say; `second`: of the equations' time in SI [s]."""
    found = {number.name: number.decode(value) for number, value in zip(problem.numbers, x, strict=True)}
    parts = []
    reach = np.degrees(problem.reach)
    if "coupling" in found:
        stiffer = np.hypot(found["asymmetry"], found["coupling"])
        along = 0.5 * np.degrees(np.arctan2(found["coupling"], found["asymmetry"])) % 180.0
        lobes = np.hypot(found["lobe_pitch"], found["lobe_roll"])
        toward = np.degrees(np.arctan2(-found["lobe_roll"], found["lobe_pitch"])) / 3.0 % 120.0
        parts.append(
            f"stiffness is {100.0 * stiffer:.0f} % larger than its mean along {along:.0f} deg, and at {reach:.0f} deg "
            f"{100.0 * lobes:.0f} % larger towards {toward:.0f} deg and each 120 deg from there"
        )
    if "stop" in found and found["stop"] > 0.0:
        parts.append(f"beyond a compression of {1.0 / found['stop']:.2g} rad of motor the link is ten times stiffer")
    if "softening" in found:
        fall = 1.0 - 1.0 / (1.0 + found["softening"])
        parts.append(
            f"stiffness falls by {100.0 * fall:.0f} % from rest to {reach:.0f} deg, "
            f"and by {100.0 * found['lasting_softening'] * (1.0 - np.exp(-2.0)):.0f} % after a bend of {reach:.0f} deg"
        )
    if "creep" in found:
        share = found["creep"] / (1.0 + found["creep"])
        seconds = second / found["creep_rate"]
        parts.append(f"{100.0 * share:.0f} % of the stiffness creeps away with a time constant of {seconds:.2g} s")
    if "angle_2" in found:
        for j, nominal in ((2, 120.0), (3, 240.0)):
            angle = nominal + np.degrees(found[f"angle_{j}"])
            parts.append(f"tendon {j} stands at {angle:.0f} deg with {found[f'arm_{j}']:.2f} of the arm of tendon 1")
    return "; ".join(parts)
