"""softneck identify auto: all kinds, ranked by simulation over rows held out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck import identification, plots, signals
from softneck.core import CheckFailedError, SettingsError, refuse_existing

from .shared._console import left_out, note, percent, print_json, print_table, progress, useless
from .shared._options import target

if TYPE_CHECKING:
    from softneck.robot import Robot


_TABLE_HEAD = ["kind", "worst", "of", "all of them", "rows held out", "cold", "tried in", "found", ""]
_TABLE_TITLE = "Simulation fit [%] over what was left out, mean of {names}; +- one standard error"

_OTHER = {
    "linear": "`design` of most kinds takes linear models: the best of them, {kind}, is in {path}",
    "nonlinear": "the best of the kinds that are not linear, {kind}, is in {path}: a plant to close loops over",
}


def identify_auto(
    recordings: tuple[Path, ...],
    output: Path | None,
    *,
    train: float,
    seed: int | None,
    tolerance: float | None,
    robot: str | None,
    html: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Try the kinds, save the chosen model, and explain."""
    path, overwrite = target(output, "models/auto.npz", force=force, ending=".npz")
    # Linear kinds are what `design` and `observer` take; the best of the others is the better plant for loops.
    beside = {name: path.with_name(f"{path.stem}_{name}.npz") for name in _OTHER}
    for file in (path, *beside.values()):
        refuse_existing(file, force=overwrite)
    if html is not None:
        refuse_existing(html, force=force)
    parts = [signals.read_recording(source, robot=robot) for source in recordings]
    with progress("identify auto", quiet=as_json) as report:
        choice = identification.choose_kind(
            parts, name=str(recordings[-1]), train=train, seed=seed or 0, progress=report
        )
    found = identification.best_others(choice.ranking, choice.chosen)
    others = {sort: replace(choice, chosen=one) for sort, one in found.items() if one.model is not None}
    saved = {path: choice, **{beside[sort]: other for sort, other in others.items()}}
    models: list[identification.Model] = []
    for file, taken in saved.items():
        model = _model(taken)
        if taken is choice:
            model = replace(model, findings={**model.findings, "chosen": choice.why})
        if tolerance is not None:
            model = identification.with_tolerance(model, tolerance)
        models.append(identification.with_fit(model, taken.chosen.judged, taken.chosen.examination))
        models[-1].save(file, force=overwrite)
    for file in beside.values():
        if file not in saved:
            file.unlink(missing_ok=True)  # of another choice, which --force replaces
    said = [_OTHER[sort].format(kind=other.chosen.kind, path=beside[sort]) for sort, other in others.items()]
    facts = _facts(choice, path)
    if html is not None:
        plots.write_page(html, _page(choice, facts), force=force)
    if as_json:
        kept = {f"{name}_model": str(file) if file in saved else None for name, file in beside.items()}
        print_json({**facts, **kept})
        _refuse_useless(path, choice)
        return
    print_table(_title(parts[0].robot), _TABLE_HEAD, _rows(choice))
    click.echo(f"{choice.why}\n{path}\n{models[0].summary()}")
    for remark in [*said, *choice.remarks]:
        note(remark)
    _refuse_useless(path, choice)


def _refuse_useless(path: Path, choice: identification.Choice) -> None:
    """Raise CheckFailedError where the chosen kind is no model of the rows held out."""
    judged = choice.chosen.judged
    why = None if judged is None else useless(judged)
    if judged is None or why is None:
        return
    advice = left_out(judged) or "`softneck info REC` says what it lacks."
    # Kinds rank by their worst motion: another may fit the rows held out, and fail elsewhere.
    fitting = [one for one in choice.ranking if one.judged is not None and useless(one.judged) is None]
    if not fitting:
        raise CheckFailedError(f"{path}: no kind is a model of the rows held out: {why}. {advice}")
    best = max(fitting, key=lambda one: one.hold_out_fit)
    raise CheckFailedError(
        f"{path}: {choice.chosen.kind}, the best by its worst test, is no model of the rows held out: {why}. "
        f"{best.kind} fits them {percent(best.hold_out_fit)} %, but {percent(best.fit)} % on {best.worst}. {advice}"
    )


def _model(choice: identification.Choice) -> identification.Model:
    if choice.chosen.model is None:
        raise SettingsError("the chosen kind has no model.")
    return choice.chosen.model


def _title(robot: Robot) -> str:
    return _TABLE_TITLE.format(names=" and ".join(robot.outputs.names))


def _rows(choice: identification.Choice) -> list[list[str]]:
    return [_row(one, one is choice.chosen) for one in choice.ranking]


def _row(one: identification.KindTrial, chosen: bool) -> list[str]:
    if one.model is None:
        return [one.kind, *["-"] * 5, f"{one.seconds:.1f} s", "-", f"not identified: {one.failure}"[:76]]
    scores, error = one.scores, one.errors.get(one.worst)
    return [
        one.kind,
        percent(one.fit) + ("" if error is None else f" +- {error:.1f}"),
        one.worst,
        f"{percent(one.fit)}..{percent(max(scores.values()))}",
        percent(scores[identification.HOLD_OUT]),
        percent(scores[identification.COLD]) if identification.COLD in scores else "-",
        f"{one.seconds:.1f} s",
        f"{one.numbers} numbers",
        "chosen" if chosen else "" if one.whole else "stopped early",
    ]


def _facts(choice: identification.Choice, path: Path) -> dict:
    from softneck.report import auto_decision

    facts = {
        "model": str(path),
        "chosen": choice.chosen.kind,
        "why": choice.why,
        "remarks": list(choice.remarks),
        "ranking": [
            {
                "kind": one.kind,
                "seconds": one.seconds,
                "failure": f"not identified: {one.failure}" if one.failure else None,
                "fit": one.fit,
                "worst": one.worst or None,
                "scores": dict(one.scores),
                "standard_errors": dict(one.errors),
                "numbers": one.numbers,
                "stopped_early": one.model is not None and not one.whole,
                "hold_out": None if one.judged is None else one.judged.as_dict(),
            }
            for one in choice.ranking
        ],
    }
    return {**facts, "decision": auto_decision(facts)}


def _page(choice: identification.Choice, facts: dict) -> str:
    from softneck.report import curves, fit_table

    rows, scores = [], []
    names = list(dict.fromkeys(name for one in facts["ranking"] for name in one["scores"]))
    for one in facts["ranking"]:
        part, error = one["worst"], one["standard_errors"].get(one["worst"])
        said = (
            "chosen"
            if one["kind"] == facts["chosen"]
            else one["failure"] or ("stopped early" if one["stopped_early"] else "")
        )
        rows.append([one["kind"], percent(one["fit"]), plots.cell(error, ".1f"), part or "-", f"{one['numbers']:,}",
                     f"{one['seconds']:.1f}", said])  # fmt: skip
        scores.append([one["kind"], *(percent(one["scores"].get(name)) for name in names)])
    head = ["kind", "worst fit [%]", "standard error", "worst on", "parameters", "tried in [s]", ""]
    tables = [
        plots.Table(
            f"All kinds by their worst simulation fit, mean of {' and '.join(_model(choice).robot.outputs.names)}",
            head,
            rows,
        ),
        plots.Table("Simulation fit [%] over each part that was left out", ["kind", *names], scores),
    ]
    judged = choice.chosen.judged
    charts = [] if judged is None else [curves(judged)]
    tables[:0] = [] if judged is None else [fit_table([judged])]
    why = plots.Section(
        f"Why {facts['chosen']}", text=[facts["why"], *facts["remarks"]], charts=charts, tables=tables,
        method=_model(choice).summary().splitlines(),
    )  # fmt: skip
    return plots.page(
        "Which model to use", [why], verdict=facts["decision"], footer="Written by softneck identify auto."
    )
