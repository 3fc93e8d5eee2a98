"""The sentences that pages open with: which file to use, how good it is and where, what holds, what to do next.

Each is made of values of its command's JSON and is itself there as `decision`, so that pages and JSON agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from softneck.core import percent, to_si
from softneck.identification import EXAM, trained_range
from softneck.verification import certificate_decision

# The least simulation fits [%] with their words: `design` refuses models below 30, `identify auto` warns below 70.
_FIT_WORDS = ((90.0, "very good"), (80.0, "good"), (70.0, "fair"), (30.0, "poor"))
_USEFUL = _FIT_WORDS[-1][0]
# Fits closer than this [points] are alike, as `identify auto` has it.
_ALIKE = 0.5

Values = Mapping[str, Any]


def fit_word(fit: float | None) -> str:
    """Return a verdict in one or two words on the simulation fit [%] of an output."""
    if fit is None:
        return "no fit"
    return next((word for least, word in _FIT_WORDS if fit >= least), "useless")


def beats(fit: float | None, other: float | None) -> str:
    """Return "beats", "equals" or "misses": a fit [%] beside that of a baseline; empty where one is not known."""
    if fit is None or other is None or math.isnan(fit) or math.isnan(other):
        return ""
    return "beats" if fit > other + _ALIKE else "misses" if fit < other - _ALIKE else "equals"


def list_fits(fits: Values, best_linear: Values | None = None) -> str:
    """Return each output with its simulation fit, a verdict, and the best fit of any linear model beside it."""
    said = []
    for name, fit in fits.items():
        linear = (best_linear or {}).get(name)
        beside = {"beats": "above", "equals": "equal to", "misses": "below", "": ""}[beats(fit, linear)]
        more = f", {beside} the best linear fit of these rows, {percent(linear)} %" if beside else ""
        said.append(f"{name} {percent(fit)} % ({fit_word(fit)}{more})")
    return ", ".join(said)


def trust_limits(ranges: Values | None, unit: str) -> str:
    """Return where a model was never judged: "outside pitch -17.3 to 18.2 deg"; `ranges`: output -> [low, high]."""
    known = [(name, ends) for name, ends in (ranges or {}).items() if ends]
    return (
        "outside " + ", ".join(f"{name} {low:.3g} to {high:.3g} {unit}" for name, (low, high) in known) if known else ""
    )


def auto_decision(facts: Values) -> str:
    """Return the decision of `identify auto`, from its JSON."""
    chosen = next(one for one in facts["ranking"] if one["kind"] == facts["chosen"])
    judged = chosen["hold_out"]
    if judged is None:
        return f"Do not use {facts['model']}: {facts['chosen']} was not judged."
    fits, linear = judged["fits"]["model"]["inf"], judged["fits"]["best_linear"].get("inf", {})
    if judged["diverged"] is not None or min(map(_least, fits.values())) < _USEFUL:
        return f"Do not use {facts['model']} ({facts['chosen']}): simulation fit {list_fits(fits, linear)}."
    said = f"Use {facts['model']} ({facts['chosen']}): on rows it has not seen it simulates {list_fits(fits, linear)}."
    limits = trust_limits(judged["measured_range"], judged.get("unit", "deg"))
    more = " with the median of all kinds on motions that nobody recorded" if chosen["worst"] == EXAM else ""
    worst = "" if chosen["fit"] is None else f"Worst test: {percent(chosen['fit'])} % ({chosen['worst']}{more})."
    return " ".join(
        filter(None, [said, f"Do not trust it {limits}: it was not judged there." if limits else "", worst])
    )


def _least(fit: float | None) -> float:
    return -math.inf if fit is None or math.isnan(fit) else fit


def validation_decision(models: Sequence[Values]) -> str:
    """Return the decision of `validate` from its JSON: of each recording the best model by its longest horizon."""
    return " ".join(
        _best_on(data, [one for one in models if one["data"] == data])
        for data in dict.fromkeys(one["data"] for one in models)
    )


def _best_on(data: str, rivals: Sequence[Values]) -> str:
    best = max(rivals, key=lambda one: min(map(_least, _last(one).values())))
    fits, ahead = _last(best), list(best["fits"]["model"])[-1]
    least = _USEFUL if ahead == "inf" else 0.0
    bad = best["diverged"] is not None or min(map(_least, fits.values())) < least
    of = f", the best of {len(rivals)} models" if len(rivals) > 1 else ""
    rows = f"{best['rows_scored']} rows of {Path(data).name}"
    if ahead == "inf":
        how = f"it simulates {list_fits(fits, best['fits']['best_linear'].get(ahead))}"
    else:
        held = best["fits"]["persistence"].get(ahead, {})
        how = f"{ahead} samples ahead it fits " + ", ".join(
            f"{name} {percent(fit)} % (repeating the last sample {percent(held.get(name))} %)"
            for name, fit in fits.items()
        )
    said = [f"{'Do not use' if bad else 'Use'} {Path(best['model']).name}{of}: on {rows} {how}."]
    if trained := best.get("rows_trained", 0):
        said.append(f"It was trained on {trained} of these rows: they say nothing about new motions.")
    if lost := [Path(one["model"]).name for one in rivals if one["diverged"] is not None]:
        said.append(f"Diverged: {', '.join(lost)}.")
    if (limits := trust_limits(best["measured_range"], best.get("unit", "deg"))) and not bad:
        said.append(f"Do not trust it {limits}: it was not judged there.")
    return " ".join(said)


def _last(one: Values) -> Values:
    return list(one["fits"]["model"].values())[-1]


def model_values(file: str, model: Any) -> dict[str, Any]:
    """Return the JSON values of a model in a project.

    File, kind, its simulation fit on the rows held out, and the range of the set-points that it was trained on.
    """
    findings = getattr(model, "findings", {})
    fit, trained = findings.get("hold_out", {}).get("fit", {}), trained_range(findings)
    unit = "" if trained is None else model.robot.motors.unit
    ends = None if trained is None else [float(end / to_si(unit)[0]) for end in (trained[0].min(), trained[1].max())]
    return {"file": file, "kind": getattr(model, "kind", ""), "fit": dict(fit), "chosen": "chosen" in findings,
            "trained_set_points": ends, "unit": unit}  # fmt: skip


def project_decision(models: Sequence[Values], certificates: Sequence[Values], *, tuner: str | None) -> str:
    """Return the decision on a project: which model, which controller and what it holds, and what to do next.

    `models`, `certificates`: as from `model_values` and `certificate_values`. `tuner`: path of `tuner.html`, if there.
    """
    said, judged = [], [one for one in models if one["fit"]]
    if judged:
        # That which `identify auto` chose, else the best on the rows held out.
        best = max(judged, key=lambda one: (one["chosen"], min(map(_least, one["fit"].values()))))
        said.append(
            f"Use {best['file']} ({best['kind']}): on rows it has not seen it simulates {list_fits(best['fit'])}."
        )
        if ends := best.get("trained_set_points"):
            low, high = (f"{end:.3g}" for end in ends)
            said.append(f"It was trained on set-points from {low} to {high} {best['unit']}: do not trust it outside.")
    verified = sorted(
        (one for one in certificates if one["of"] == "verify"), key=lambda one: (one["holds"], one["file"])
    )
    if not verified:
        return " ".join(said)
    return " ".join([*said, certificate_decision(verified[0], tuner=tuner)])
