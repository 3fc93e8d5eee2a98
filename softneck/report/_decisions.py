"""The sentences that pages open with: which file to use, how good it is and where, what holds, what to do next.

Each is made of values of its command's JSON and is itself there as `decision`, so that pages and JSON agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from softneck.core import SettingsError, percent, required_rows
from softneck.plots import cell
from softneck.verification import MARGIN_GROUPS, metric_title

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
    worst = "" if chosen["fit"] is None else f"Worst test: {percent(chosen['fit'])} % ({chosen['worst']})."
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
    if lost := [Path(one["model"]).name for one in rivals if one["diverged"] is not None]:
        said.append(f"Diverged: {', '.join(lost)}.")
    if (limits := trust_limits(best["measured_range"], best.get("unit", "deg"))) and not bad:
        said.append(f"Do not trust it {limits}: it was not judged there.")
    return " ".join(said)


def _last(one: Values) -> Values:
    return list(one["fits"]["model"].values())[-1]


def model_values(file: str, model: Any) -> dict[str, Any]:
    """Return the JSON values of a model in a project: file, kind, and its simulation fit on the rows held out."""
    findings = getattr(model, "findings", {})
    fit = findings.get("hold_out", {}).get("fit", {})
    return {"file": file, "kind": getattr(model, "kind", ""), "fit": dict(fit), "chosen": "chosen" in findings}


def certificate_values(file: str, content: Values) -> dict[str, Any]:
    """Return the JSON values of a certificate in a project: its controller, what fails, what does not decide."""
    rows = required_rows(content)
    controller = content.get("files", {}).get("controller", {}).get("path", "")
    failed = [
        {key: row.get(key) for key in ("metric", "bound", "value", "limit", "note")}
        for row in rows
        if row.get("holds") is False
    ]
    return {"file": file, "of": str(content.get("certificate")), "controller": str(controller),
            "kind": str(content.get("controller_kind", "")), "holds": bool(content.get("holds")) and bool(rows),
            "requirements": len(rows), "failed": failed,
            "undecided": [str(row["metric"]) for row in rows if row.get("holds") is None]}  # fmt: skip


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
    verified = sorted(
        (one for one in certificates if one["of"] == "verify"), key=lambda one: (one["holds"], one["file"])
    )
    if not verified:
        return " ".join(said)
    one, count = verified[0], verified[0]["requirements"]
    name, trade = (
        f"{one['controller']} ({one['kind']})",
        "" if tuner is None else f"open {tuner} to trade speed for caution",
    )
    if one["holds"]:
        undecided = one["undecided"]
        holds = f"{count - len(undecided)} of {count}" if undecided else f"all {count}"
        rest = f"; {len(undecided)} do not decide" if undecided else ""
        said.append(f"{name} holds {holds} requirements of {one['file']}{rest}.")
        # Slack is known of plants with tensions alone, and other robots have no tendons.
        if any(metric.startswith("sim.") and metric != "sim.slack_s" for metric in undecided):
            way = "verify it over a simulation model of this robot too, or over a family with draws"
        else:
            way = "run it on drives with that certificate"
        said.append(f"Next: {way}{', or ' + trade if trade else ''}.")
        return " ".join(said)
    failing = "; ".join(_requirement(row) for row in one["failed"][:2])
    more = f" and {len(one['failed']) - 2} more" if len(one["failed"]) > 2 else ""
    said.append(f"Do not run {name} yet: {len(one['failed'])} of {count} requirements fail: {failing}{more}.")
    # A safety margin is never loosened.
    margins = any(str(row["metric"]).startswith(MARGIN_GROUPS) for row in one["failed"])
    way = "allow a slower rise" if margins else "loosen these"
    said.append(f"Next: {way}, or record another motion and start with both logs{'; ' + trade if trade else ''}.")
    return " ".join(said)


_SIGNS = {"min": "at least", "max": "at most", "below": "below"}


def _requirement(row: Values) -> str:
    try:
        name = metric_title(str(row["metric"])).rpartition(" (")[0]
    except SettingsError:  # of another version
        name = str(row["metric"])
    value = "not computed" if row["value"] is None else cell(row["value"], ".3g")
    # A note says why a value within its limit does not count.
    note = f" ({row['note']})" if row["note"] else ""
    return f"{name} {value}, required {_SIGNS.get(row['bound'], 'at most')} {cell(row['limit'], '.3g')}{note}"
