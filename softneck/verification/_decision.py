"""The sentences on a certificate that pages open with: what holds, what fails, and what to do next.

Each is made of values of its command's JSON and is itself there as `decision`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from softneck.core import SettingsError, certifies, required_rows, to_si, unit_of_metric
from softneck.plots import cell

from ._metrics import MARGIN_GROUPS, metric_title

Values = Mapping[str, Any]
_SIGNS = {"min": "at least", "max": "at most", "below": "below"}


def metric_words(metric: str) -> str:
    """Return the plain name of a metric without its key; the key alone where this version does not know it."""
    try:
        return metric_title(metric).rpartition(" (")[0]
    except SettingsError:
        return metric


def certificate_values(file: str, content: Values) -> dict[str, Any]:
    """Return the JSON values of a certificate: its controller, what fails, what does not decide, what draws say."""
    rows = required_rows(content)
    controller = content.get("files", {}).get("controller", {}).get("path", "")
    return {"file": file, "of": str(content.get("certificate")), "controller": str(controller),
            "kind": str(content.get("controller_kind", "")), **verdict_values(rows),
            "drives": has_drives(content.get("units", ())),
            "draws": [f"Of its draws: {part['statement']}." for part in content.get("draws", ())],
            "holds": certifies(content)}  # fmt: skip


def has_drives(units: Sequence[str]) -> bool:
    """Return whether `softneck drives` runs a robot whose motors and outputs have these units: all are angles."""
    return all(to_si(str(unit))[1] == "rad" for unit in units)


def verdict_values(rows: Sequence[Values]) -> dict[str, Any]:
    """Return the number of requirements, those that fail, and the names of those that do not decide.

    `rows`: with `metric`, `bound`, `value`, `limit` and `holds`, None for what does not decide.
    """
    failed = [
        {key: row.get(key) for key in ("metric", "bound", "value", "limit", "note")}
        for row in rows
        if row.get("holds") is False
    ]
    open_ = [str(row["metric"]) for row in rows if row.get("holds") is None]
    return {"requirements": len(rows), "failed": failed, "undecided": open_}


def certificate_decision(one: Values, *, tuner: str | None = None, judged: str = "") -> str:
    """Return the decision on a controller: what it holds, or why not to run it, and what to do next.

    `one`: as from `certificate_values`. `tuner`: path of `tuner.html`, if there. `judged`: by what, in a sentence.
    """
    facts = " ".join(filter(None, [judged, *one.get("draws", ())]))
    facts += " " * bool(facts)
    count, name = one["requirements"], one["controller"] or "The controller"
    name = f"{name} ({one['kind']})" if one["kind"] else name
    trade = "" if tuner is None else f"open {tuner} to trade speed for caution"
    if one["holds"]:
        undecided, held = one["undecided"], count - len(one["undecided"]) - len(one["failed"])
        holds = f"{held} of {count}" if held < count else f"all {count}"
        rest = f"; {_undecided_words(undecided)}" if undecided else ""
        # Slack is known of plants with tensions alone, and other robots have no tendons.
        if any(metric.startswith(("sim.", "track.")) and metric != "sim.slack_s" for metric in undecided):
            way = "verify it over a simulation model of this robot too, or over a family with draws"
        elif one["drives"]:
            way = "run it on drives with that certificate (`softneck drives --help`)"
        else:
            file = one["controller"] or "CONTROLLER"
            way = f"export it for your own computer (`softneck fmu {file} --backend compiled`: an FMU, C inside)"
        more = f", or {trade}" if trade else ""
        return f"{name} holds {holds} requirements of {one['file']}{rest}. {facts}Next: {way}{more}."
    if not one["failed"]:
        return f"Do not run {name} yet: no requirement was judged. {facts}".rstrip()
    failing = "; ".join(_requirement(row) for row in one["failed"][:2])
    more = f" and {len(one['failed']) - 2} more" if len(one["failed"]) > 2 else ""
    # A safety margin is never loosened, and what was not computed holds at no limit.
    margins = any(str(row["metric"]).startswith(MARGIN_GROUPS) for row in one["failed"])
    blind = any("no linear form" in str(row["note"]) for row in one["failed"])
    way = "allow a slower rise" if margins else "loosen these"
    way = "take a kind with a linear form, such as pi or lqg" if blind else way
    return (
        f"Do not run {name} yet: {len(one['failed'])} of {count} requirements fail: {failing}{more}. "
        f"{facts}Next: {way}, or record another motion and start with both logs{'; ' + trade if trade else ''}."
    )


def _undecided_words(metrics: Sequence[str]) -> str:
    named = "; ".join([*map(metric_words, metrics[:2]), *([f"{len(metrics) - 2} more"] if len(metrics) > 2 else [])])
    return f"{len(metrics)} {'does' if len(metrics) == 1 else 'do'} not decide ({named})"


def _requirement(row: Values) -> str:
    metric = str(row["metric"])
    unit = unit_of_metric(metric)
    value = "not computed" if row["value"] is None else f"{cell(row['value'], '.3g')}{unit}"
    # A note says why a value within its limit does not count.
    note = f" ({row['note']})" if row["note"] else ""
    bound = _SIGNS.get(row["bound"], "at most")
    return f"{metric_words(metric)} {value}, required {bound} {cell(row['limit'], '.3g')}{unit}{note}"
