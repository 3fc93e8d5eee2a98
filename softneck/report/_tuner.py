"""The page on which two sliders choose among all candidates of a search."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from markupsafe import escape

from softneck.core import metric_of
from softneck.loop import error_unit
from softneck.plots import BLUE, GREEN, GREY, MOTOR_COLOURS, ORANGE, Chart, Curve, Panel, Script, Section, cell, page
from softneck.tuning import LEVELS, circle_angles, curve_times, has_observer, objectives
from softneck.verification import metric_title

if TYPE_CHECKING:
    from softneck.robot import Robot
    from softneck.tuning import Candidate, Tuned
    from softneck.verification import Requirement

_SIGNS = {"min": ">=", "max": "<=", "below": "<"}
# Metrics of the sliders, the first that all candidates have: speed, and caution.
_SPEED, _CAUTION = (".rise_s",), ("axes.sensitivity", "axes.gain_margin", ".overshoot_pct")
_NAMES = {"holds": "keeps all", "fails": "breaks a requirement", "chosen": "chosen", "x_limit": "required",
          "y_limit": "required (caution)", "band": "all plants", "value": "one plant", "reference": "reference",
          "overshoot": "overshoot allowed"}  # fmt: skip
_RANGE = 1.2


def tuner_page(found: Tuned, folder: Path, plants: Mapping[str, Path], *, certified: str) -> str:
    """Return the HTML page of all candidates that were simulated.

    `folder`: of the results. `plants`: name -> file or preset. `certified`: sentence on the certificate of the best.
    """
    values = tuner_values(found, folder, plants, certified)
    curves = next((item["curves"] for item in values["candidates"] if item["best"]), {})
    chart, panels = _chart(found, values, curves)
    values["panels"] = panels
    html = files("softneck.report").joinpath("_tuner.html").read_text(encoding="utf-8")
    script = files("softneck.report").joinpath("_tuner.js").read_text(encoding="utf-8")
    where = "all simulation models and payloads" if found.task.own else "all linear plants of the search"
    how = [
        "The sliders choose the nearest candidate. Speed orders the candidates by their "
        f"{values['x_name']}, caution by their {values['y_name']}; 100 is the fastest, and the most cautious.",
        f"The band of a step covers {where}; the line is the last of them with its heaviest payload, or the nominal "
        "plant. Values of the table are the worst of all loops of the search, some of which have noise, other "
        "directions and a later plant; the certificate covers more plants.",
    ]
    if panels["circle"] is not None:
        how.append("On a circle a lag along the path is not visible; its error in the table counts it.")
    elsewhere = [f"Not computed by the search: {'; '.join(values['elsewhere'])}."] if values["elsewhere"] else []
    return page(
        f"Tune the controller for {found.task.robot.label()}",
        [
            Section("Speed and caution", charts=[chart], html=html, method=how),
            Section("Requirements", html=_table(values["requirements"]),
                    text=["Change a limit: candidates that break it turn grey.", *elsewhere]),
            Section("Take this one", html='<p id="settings"></p><p id="file"></p><pre class="take" id="command"></pre>'
                    '<button class="take" type="button" id="copy">Copy</button>'
                    '<span id="copied" role="status"></span>'),
        ],
        verdict="This page needs JavaScript.",
        holds=found.holds,
        footer="Written by softneck tune.",
        script=Script(script, values),
    )  # fmt: skip


def tuner_values(found: Tuned, folder: Path, plants: Mapping[str, Path], certified: str) -> dict[str, Any]:
    """Return the JSON values of the page; infinite numbers as text, values that were not computed as None."""
    shown = _judged(found)
    items, task, bounds, x, y = found.candidates, found.task, shown.bounds, shown.x, shown.y
    metrics = [bound.metric for bound in bounds]
    candidates = []
    for number, k in enumerate(shown.order, start=1):
        item, own = items[k], folder / f"{items[k].kind}-{number}.npz"
        broken = item.ratios(bounds, tested=task.tested)
        candidates.append({
            "number": number, "kind": item.kind, "best": item is found.best,
            "settings": ", ".join(f"{name} {cell(value, '.4g')}" for name, value in item.settings.items()),
            "values": [_number(item.metrics.get(metric)) for metric in metrics],
            "unproven": [_unproven(item, bound, broken) for bound in bounds],
            "x": _number(item.metrics[x]), "y": _number(item.metrics[y]), "speed": shown.speed[k],
            "caution": shown.caution[k], "level": _level(item), "curves": dict(item.curves), "file": str(own),
            "command": design_command(found, item, own, folder, plants),
        })  # fmt: skip
    return {
        "candidates": candidates,
        "requirements": [{"metric": b.metric, "name": _name(b.metric), "unit": _unit(b.metric, task.robot),
                          "bound": b.bound, "limit": b.limit}
                         for b in bounds],
        "x_name": _name(x), "y_name": _name(y), "x_limit": _index(metrics, x), "y_limit": _index(metrics, y),
        "x_unit": _unit(x, task.robot), "y_unit": _unit(y, task.robot),
        "overshoot": _index(metrics, f"{x.partition('.')[0]}.overshoot_pct"),
        "elsewhere": sorted({_name(b.metric) for b in task.bounds if b not in bounds}),
        "time": [float(f"{t:.4g}") for t in curve_times(task)], "angles": circle_angles().tolist(),
        "best_file": str(folder / "best.npz"), "certified": certified,
        "names": {**_NAMES, "motors": {}},
    }  # fmt: skip


class _Judged(NamedTuple):
    """What the page shows of all candidates.

    `bounds`: requirements that the search computed. `x`, `y`: metrics of speed and caution. `speed`, `caution`: place
    of each candidate, 0 to 100. `order`: of the candidates, the fastest first.
    """

    bounds: list[Requirement]
    x: str
    y: str
    speed: list[float]
    caution: list[float]
    order: list[int]


def _judged(found: Tuned) -> _Judged:
    items, task = found.candidates, found.task
    # Of requirements that the search did not compute for any candidate the certificate decides.
    known = objectives(items)
    bounds = [
        b
        for b in task.bounds
        if any(b.metric in item.metrics or b.metric in item.ratios([b], tested=task.tested) for item in items)
    ]
    x = next((name for end in _SPEED for name in known if name.endswith(end)), known[0])
    y = next((name for end in _CAUTION for name in known if name.endswith(end) and name != x), known[-1])
    larger = metric_of(y).larger
    speed = _places([item.metrics[x] for item in items])
    caution = _places([-item.metrics[y] if larger else item.metrics[y] for item in items])
    order = sorted(range(len(items)), key=lambda k: items[k].metrics[x])
    return _Judged(bounds, x, y, speed, caution, order)


_FASTER_PCT = 20.0
# Costs in the sentence, those that break a requirement first; the page lists more.
_MAX_COSTS = 4


def faster_values(found: Tuned) -> dict[str, Any] | None:
    """Return the JSON values of what it costs to be 20 % faster than the best; None if it has no finite speed.

    `candidate`: number on the tuner page of that which breaks least, or has least not computed, of equals the nearest,
    or None. `costs`: metric -> values of the best and of it, where worse by more than a twentieth. `breaks`: the
    requirements that it breaks. `not_computed`: those of which the search does not know whether it keeps them.
    `fewer_loops`: whether the best was judged by more loops.
    """
    items, task, shown = found.candidates, found.task, _judged(found)
    best = next((k for k, item in enumerate(items) if item is found.best), None)
    if best is None or not math.isfinite(items[best].metrics[shown.x]):
        return None
    most = (1.0 - _FASTER_PCT / 100.0) * items[best].metrics[shown.x]
    said = {"faster_pct": _FASTER_PCT, "metric": shown.x, "unit": _unit(shown.x, task.robot), "at_most": most}

    def far(k: int) -> tuple[int, float]:
        places = ((each[k] - each[best]) ** 2 for each in (shown.speed, shown.caution))
        return len(broken(k)) + len(missing(k)), sum(places)

    def broken(k: int) -> list[str]:
        return [metric for metric, ratio in items[k].ratios(shown.bounds, tested=task.tested).items() if ratio > 1.0]

    def missing(k: int) -> list[str]:
        known = items[k].ratios(task.bounds, tested=task.tested)
        return [metric for metric in dict.fromkeys(b.metric for b in task.bounds) if metric not in known]

    fast = [k for k in shown.order if items[k].metrics[shown.x] <= most]
    if not fast:
        return {**said, "candidate": None}
    other, costs = min(fast, key=far), {}
    for bound in shown.bounds:
        a, b = (items[k].metrics.get(bound.metric) for k in (best, other))
        # What is not a number is worse.
        if a is not None and b is not None and not (b >= 0.95 * a if bound.bound == "min" else b <= 1.05 * a):
            costs[bound.metric] = {"best": _number(a), "faster": _number(b), "unit": _unit(bound.metric, task.robot)}
    return {**said, "candidate": shown.order.index(other) + 1, "kind": items[other].kind,
            "value": items[other].metrics[shown.x], "costs": costs, "breaks": broken(other),
            "not_computed": missing(other), "fewer_loops": _level(items[other]) < _level(items[best])}  # fmt: skip


def faster_words(one: Mapping[str, Any] | None, tuner: str) -> str:
    """Return the sentence on what it costs to be 20 % faster, of `faster_values`; `tuner`: its page."""
    if one is None:
        return ""
    goal = f"{one['faster_pct']:g} % faster ({_name(one['metric'])} at most {one['at_most']:.3g} {one['unit']})"
    if one["candidate"] is None:
        return f"{goal}: no judged candidate is."
    ordered = sorted(one["costs"].items(), key=lambda pair: pair[0] not in one["breaks"])
    costs = [f"{_name(metric)} {cell(each['best'], '.3g')} -> {cell(each['faster'], '.3g')} {each['unit']}".rstrip()
             for metric, each in ordered]  # fmt: skip
    costs[_MAX_COSTS:] = [f"{len(costs) - _MAX_COSTS} more"] if len(costs) > _MAX_COSTS else []
    broken, missing = len(one["breaks"]), len(one["not_computed"])
    ends = f"breaks {broken} of the requirements" if broken else "keeps all computed requirements"
    ends += f"; {missing} were not computed of it" if missing else ""
    ends += "; it was judged by fewer loops" if one["fewer_loops"] else ""
    return (
        f"{goal}: candidate {one['candidate']} of {tuner} ({one['kind']}, {one['value']:.3g} {one['unit']}) costs "
        f"{'; '.join(costs) or 'nothing that is required'}, and {ends}."
    )


def design_command(found: Tuned, item: Candidate, target: Path, folder: Path, plants: Mapping[str, Path]) -> str:
    """Return the commands that design a candidate and verify it, for the folder where `tune` ran."""
    names = list(found.task.linear)
    if item.kind in ("nmpc", "adaptive"):  # designed on one plant, as the search does
        names = [name for name, thing in found.task.own.items() if item.kind == "nmpc" and thing in found.task.models]
        names = (names or list(found.task.linear))[:1]
    linear = [str(plants[name]) for name in names]
    given = [word for name, value in item.settings.items()
             for word in ("--set", f"{name}={json.dumps(value, separators=(',', ':'))}")]  # fmt: skip
    eyes = (
        ["--observer", str(folder / "observer.npz")] if found.observer is not None and has_observer(item.kind) else []
    )
    design = ["softneck", "design", item.kind, *linear, *eyes, *given, "-o", str(target)]
    asked = ["--requirements", str(folder / "requirements.toml")]
    verify = ["softneck", "verify", str(target), *map(str, plants.values()), *eyes, *asked]
    return f"{shlex.join(design)}\n{shlex.join(verify)}"


def _unproven(item: Candidate, bound: Any, ratios: Mapping[str, float]) -> bool:
    """Return whether a requirement fails whatever its limit: its margin cannot be shown for this controller."""
    return bound.metric in ratios and math.isinf(ratios[bound.metric]) and math.isfinite(
        item.metrics.get(bound.metric, 0.0)
    )  # fmt: skip


def _level(item: Candidate) -> int:
    return LEVELS.index(item.level)


def _places(values: Sequence[float]) -> list[float]:
    """Return the place of each value from 100, the smallest, to 0, the largest; equal values have one place."""
    distinct = sorted(set(values))
    last = max(len(distinct) - 1, 1)
    return [round(100.0 * (1.0 - distinct.index(value) / last), 1) for value in values]


def _number(value: float | None) -> float | str | None:
    return value if value is None or math.isfinite(value) else "NaN" if math.isnan(value) else "Infinity"


def _index(metrics: Sequence[str], name: str) -> int | None:
    return metrics.index(name) if name in metrics else None


def _name(metric: str) -> str:
    """Return a metric in words, such as "rise time, simulation"."""
    return metric_title(metric).rpartition(" (")[0]


def _unit(metric: str, robot: Robot) -> str:
    """Return the unit that the key of a metric ends in, as it is written; empty for a ratio."""
    shown = {"s": "s", "ms": "ms", "pct": "%", "deg": "deg", error_unit(robot)[0]: robot.outputs.display_unit}
    last = metric.rpartition(".")[2]
    return next((unit for end, unit in shown.items() if last.endswith(f"_{end}")), "")


def _table(requirements: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of requirements, whose limits are inputs."""
    rows = [
        f'<tr><td class="text">{escape(item["name"])}</td><td id="value-{k}" data-label="value"></td>'
        f'<td data-label="limit">{escape(_SIGNS[item["bound"]])} <input type="number" step="any" id="limit-{k}" '
        f'value="{item["limit"]:g}" aria-label="limit of {escape(item["name"])}"> {item["unit"]}</td>'
        f'<td id="verdict-{k}" data-label="verdict"></td></tr>'
        for k, item in enumerate(requirements)
    ]
    head = "".join(f"<th{' class=text' if k == 0 else ''}>{text}</th>" for k, text in
                   enumerate(("requirement", "worst value in the search", "limit", "verdict")))  # fmt: skip
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _chart(found: Tuned, values: dict[str, Any], curves: Mapping[str, Sequence[float]]) -> tuple[Chart, dict[str, Any]]:
    """Return the chart, whose curves the page replaces, and name -> number of its panels."""
    robot, time = found.task.robot, np.array(values["time"])
    unit = robot.outputs.display_unit
    x, y = (np.array([float(one[key]) for one in values["candidates"]]) for key in ("x", "y"))
    panels = [_front_panel(values, x, y)]
    numbers: dict[str, Any] = {"front": 0, "step": 1, "motors": 2, "circle": None}
    if not curves:
        return Chart("Candidates", panels, linked=False), numbers
    reference = np.full(time.size, curves["reference"][0])
    top = float(np.quantile([max(one["curves"]["high"]) for one in values["candidates"] if one["curves"]], 0.9))
    allowed = [] if values["overshoot"] is None else [
        Curve(time, 1.05 * reference, _NAMES["overshoot"], ORANGE, "dotted")
    ]  # fmt: skip
    low, high, line = (np.array(curves[name]) for name in ("low", "high", "value"))
    step = [Curve(time, low, _NAMES["band"], BLUE, "band", upper=high), Curve(time, line, _NAMES["value"], BLUE),
            Curve(time, reference, _NAMES["reference"], GREY, "dashed"), *allowed]  # fmt: skip
    limits = (-0.1 * reference[0], _RANGE * max(top, reference[0]))
    panels.append(Panel(step, f"{robot.outputs.names[0]} [{unit}]", "time after the step [s]", y_range=limits))
    motors = {name: "co-contraction" if name == "tautness" else f"motor {name.rpartition('_')[2]}"
              for name in curves if name.startswith("set_point_") or name == "tautness"}  # fmt: skip
    values["names"]["motors"] = motors
    each = [np.array(one["curves"][name]) for one in values["candidates"] if one["curves"] for name in motors]
    colours = [*MOTOR_COLOURS, GREY, "#56B4E9", "#F0E442", "#CC79A7", "#D55E00"]
    drawn = [Curve(time, np.array(curves[name]), label, "black" if name == "tautness" else colour,
                   "dashed" if name == "tautness" else "step")
             for (name, label), colour in zip(motors.items(), colours * 4, strict=False)]  # fmt: skip
    ends = (min(map(np.min, each)), max(map(np.max, each)))
    pad = 0.05 * (ends[1] - ends[0]) + 1e-9
    panels.append(Panel(drawn, f"set-points [{robot.motors.unit}]", "time after the step [s]",
                        y_range=(float(ends[0] - pad), float(ends[1] + pad))))  # fmt: skip
    if "circle" in curves:
        numbers["circle"] = 3
        panels.append(_circle_panel(found, curves))
    return Chart("The chosen candidate among all", panels, columns=2, linked=False, row_height=3.4), numbers


def _front_panel(values: Mapping[str, Any], x: np.ndarray, y: np.ndarray) -> Panel:
    x, y = (np.where(np.isfinite(each), each, np.nan) for each in (x, y))
    nothing = np.full(x.size, np.nan)
    dots = [Curve(x, nothing, _NAMES["fails"], "#AAAAAA", "points", 2.0),
            Curve(x, y, _NAMES["holds"], GREEN, "points", 2.4),
            Curve(x, nothing, _NAMES["chosen"], ORANGE, "points", 4.5)]  # fmt: skip
    lines, items = [], values["requirements"]
    known_x, known_y = x[np.isfinite(x)], y[np.isfinite(y)]
    xs = [0.9 * min(known_x, default=0.0), 1.05 * max(known_x, default=1.0)]
    high = max(1.3 * float(np.quantile(known_y, 0.9)), 1.0) if known_y.size else 1.0
    if values["y_limit"] is not None:
        limit = items[values["y_limit"]]["limit"]
        lines.append(Curve(np.array(xs), np.full(2, limit), _NAMES["y_limit"], GREY, "dashed"))
        high = max(high, 1.2 * limit)
    ys = (0.0, high)
    if values["x_limit"] is not None:
        lines.append(
            Curve(np.full(2, items[values["x_limit"]]["limit"]), np.array(ys), _NAMES["x_limit"], GREY, "dotted")
        )
    return Panel([*lines, *dots], _axis(values, "y"), _axis(values, "x"), y_range=ys)


def _axis(values: Mapping[str, Any], key: str) -> str:
    """Return the label of an axis of the front."""
    unit = values[f"{key}_unit"]
    return f"{values[f'{key}_name']} [{unit}]" if unit else values[f"{key}_name"]


def _circle_panel(found: Tuned, curves: Mapping[str, Sequence[float]]) -> Panel:
    angles, unit = circle_angles(), found.task.robot.outputs.display_unit
    asked, r = float(found.task.asked.track["circle_deg"]), np.array(curves["circle"])
    names = found.task.robot.outputs.names
    drawn = [
        Curve(angles, np.zeros(angles.size), _NAMES["band"], BLUE, "band", upper=np.zeros(angles.size)),
        Curve(r * np.cos(angles), r * np.sin(angles), _NAMES["value"], BLUE),
        Curve(asked * np.cos(angles), asked * np.sin(angles), _NAMES["reference"], GREY, "dashed"),
    ]
    return Panel(drawn, f"{names[1]} [{unit}]", f"{names[0]} [{unit}]", equal=True)
