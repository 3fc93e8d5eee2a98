"""Answers of several methods to one question, side by side: where they disagree it is said, never averaged."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from softneck.design.linear._margins import nearer_gain
from softneck.identification.models._linearisation import moved_through

from ._evidence import Evidence, LinearEvidence
from ._linear import LinearLaw, judged
from ._plants import Plants

# Methods that compute the same number agree within this part; the grid is 3 % wide and its peaks are flat.
_SAME = 0.02
# Frequencies of the comparison, 0.6 % apart.
_POINTS = 1500
_NOT_COMPARED = "not compared (slycot is not installed)"


@dataclass(frozen=True, slots=True)
class Agreement:
    """One question and what each method says.

    Attributes:
        question: in words.
        answers: method -> its answer.
        agree: whether they agree.
        note: what to make of it.
    """

    question: str
    answers: dict[str, Any]
    agree: bool
    note: str


def agreements(evidence: Evidence, size: float = 1.0) -> list[Agreement]:
    """Return all comparisons; `size`: how far the robot's outputs go over the neck's, in the display unit for deg."""
    rows = []
    for part in evidence.linear:
        rows += [_stability(part, len(evidence.plants)), *_peaks(part, len(evidence.plants))]
        rows += _classical(part)
    rows += _in_time(evidence, size)
    return rows


def _at(part: LinearEvidence, question: str) -> str:
    return f"{question} (at {part.name})" if part.name else question


def _stability(part: LinearEvidence, count: int) -> Agreement:
    radius = part.margins["stability.radius"]
    rows = [row for items in part.structured for row in items]
    mu, lower = max(row.mu for row in rows), max(float(row.lower.max()) for row in rows)
    sampled = max(row.sampled for row in rows)
    answers: dict[str, Any] = {
        "largest spectral radius of corners and samples": float(radius[:count].max()),
        "mu, upper bound": mu,
        "mu, lower bound (complex dead time)": lower,
        "mu, sampled plants in a scaled box": sampled,
    }
    unstable = bool(radius.max() >= 1.0)
    if part.found is not None:
        answers["largest spectral radius of the search"] = part.found.radius
        unstable = unstable or part.found.radius >= 1.0
    if unstable and radius[:count].max() < 1.0:
        note, agree = "corners and samples are stable, the search found a plant between them that is not", False
    elif unstable:
        note, agree = "plants in the box are unstable", mu >= 1.0
    elif mu < 1.0:
        note, agree = "proven: the whole box is stable, and no plant was found that is not", True
    else:
        note = "undecided: the bound does not prove stability, and no unstable plant was found"
        agree = False
    if unstable and mu < 1.0:
        note += "; the bound says otherwise, which is an internal error in softneck: report it"
    return Agreement(_at(part, "Is every plant of the box stable?"), answers, agree, note)


def _peaks(part: LinearEvidence, count: int) -> list[Agreement]:
    rows = []
    disks = np.min([part.margins[f"{axis}.disk_margin"] for axis in part.plants.axes], axis=0)
    if part.found is not None and disks.size > count:
        grid, found = float(disks[:count].min()), float(disks[count:].min())
        agree = abs(found - grid) <= _SAME * max(grid, found, 1e-9)
        note = (
            "the same" if agree else "the search went further" if found < grid else "the search fell short of a corner"
        )
        rows.append(
            Agreement(
                _at(part, "Least disk margin in the box?"), {"corners and samples": grid, "search": found}, agree, note
            )
        )
    bounds = [row.worst_sensitivity for items in part.structured for row in items]
    bounds = [bound for bound in bounds if not math.isnan(bound)]
    if bounds:
        peak = max(float(part.margins[f"{axis}.sensitivity"].max()) for axis in part.plants.axes)
        agree = peak <= max(bounds) * (1.0 + _SAME)
        note = "a lower and an upper bound of the worst plant's" if agree else "a sample exceeds the bound: report it"
        rows.append(
            Agreement(
                _at(part, "Largest sensitivity in the box?"),
                {"plants tried": peak, "skewed mu, upper bound": max(bounds)}, agree, note,
            )
        )  # fmt: skip
    return rows


def _classical(part: LinearEvidence) -> list[Agreement]:
    """Compare margins of the worst plant of each axis with python-control's, where the axes are apart."""
    if part.law.coupled or np.any(part.plants.cross != 0.0):
        return []
    rows = []
    for i, axis in enumerate(part.plants.axes):
        stable = part.margins["stability.radius"] < 1.0
        if not stable.any():
            continue
        disks = np.where(stable, part.margins[f"{axis}.disk_margin"], math.inf)
        row = int(np.argmin(disks))
        own = [
            float(part.margins[f"{axis}.{name}"][row]) for name in ("gain_margin", "phase_margin_deg", "sensitivity")
        ]
        other = _by_control(part.plants, part.law, i, row)
        compared = [(a, b) for a, b in zip(own, other, strict=True) if b is not None]
        agree = all(abs(a - b) <= _SAME * abs(b) or (math.isinf(a) and math.isinf(b)) for a, b in compared)
        names = ("gain margin", "phase margin [deg]", "Ms")
        answers = {
            f"{name}, {method}": _NOT_COMPARED if value is None else value
            for method, values in (("own response", own), ("python-control", other))
            for name, value in zip(names, values, strict=True)
        }
        question = _at(part, f"Margins of the worst plant of {axis}?")
        rows.append(Agreement(question, answers, agree, "two ways to one number" if agree else "they differ"))
    return rows


def _by_control(plants: Plants, law: LinearLaw, axis: int, row: int) -> list[float | None]:
    """Return gain margin, phase margin [deg] and Ms; None for what python-control needs Slycot for, where it is not."""
    import control

    above, below = plants.numerator[row, axis], plants.denominator[row, axis]
    plant = control.TransferFunction(above, np.append(below, np.zeros(plants.delay[row, axis])), plants.sample_time)
    A, B, C = moved_through(law.A, law.By[:, [axis]], law.C[[axis]])
    own = control.StateSpace(A, B, -C, -law.Dy[[axis]][:, [axis]], plants.sample_time)
    loop: Any = control.ss(plant) * own
    # Of the state-space form's response: polynomials of this order are inaccurate.
    response = control.frequency_response(loop, judged(plants.sample_time, _POINTS)[:-1])
    gains, phases = (np.asarray(item) for item in control.stability_margins(response, returnall=True)[:2])
    gain = nearer_gain(float(np.exp(np.abs(np.log(gains[gains > 0.0])).min(initial=math.inf))), complex(loop(-1.0)))
    # The nearest of all crossings, as `classical` takes it.
    phase = float(np.abs((phases + 180.0) % 360.0 - 180.0).min(initial=math.inf))
    # The dead time's poles are at z = 0, where its own norm without Slycot stops.
    if find_spec("slycot") is None:
        return [gain, phase, None]
    closed: Any = control.feedback(1, loop)
    infinity: Any = "inf"
    return [gain, phase, float(control.system_norm(closed, p=infinity, print_warning=False))]


def _in_time(evidence: Evidence, at_rest: float) -> list[Agreement]:
    """Compare the plants whose steps run away or never settle with those that are not stable."""
    if len(evidence.linear) != 1:
        return []
    radius = evidence.linear[0].margins["stability.radius"]
    rms = evidence.steps.metrics["steady_rms_deg"]
    size = min(radius.size, rms.size)
    unstable, swings = radius[:size] >= 1.0, rms[:size] > at_rest
    answers = {
        "unstable plants, linear": int(unstable.sum()),
        "plants that do not come to rest, in time": int(swings.sum()),
    }
    agree = bool(np.array_equal(unstable, swings))
    note = "the same plants" if agree else "limits of the motors, slow poles or noise make the difference"
    return [Agreement("Which plants do not come to rest?", answers, agree, note)]
