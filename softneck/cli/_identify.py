"""softneck identify: a model from recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from softneck import identification, signals
from softneck.core import (
    KINDS,
    CheckFailedError,
    SettingsError,
    find_kind,
    kinds_of,
    refuse_existing,
    require_positive,
    resolve,
)
from softneck.robot import load_for_robot

from ._auto import identify_auto
from .shared._console import left_out, percent, print_json, progress, useless
from .shared._groups import kinds_complete
from .shared._options import (
    apply_settings,
    common_options,
    kind_command,
    output_option,
    set_option,
    target,
    tolerance_option,
)

_ADVICE = "Try another kind or settings, or record longer; `softneck identify auto` compares kinds."
_KINDS = "\n".join(f"  {name:8} {KINDS[name].summary}" for name in kinds_of("model"))
_KINDS += "\n  auto     tries them all and takes the best in simulation"


@click.command(
    "identify",
    cls=kind_command("model"),
    help=f"Identify a model of KIND from one or more recordings.\n\n\b\nKinds:\n{_KINDS}",
    epilog="With --from a model follows a robot that changed: it is refitted to the last 30 s of the recordings (--set "
    "window=30), starting from what it is. What these do not excite stays. Every third block of 2 s is held out: where "
    "an output would be worse there, or where nothing moves, the old model is kept, and that is said.\n\n"
    "Example: softneck identify rls neck.csv -o rls.npz --set na=1 --set delay=0.08",
)
@click.argument("kind", shell_complete=kinds_complete("model", "auto"))
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@output_option("model", "MODEL")
@click.option("--train", default=0.7, show_default=True, help="Part of each run, from its start, to train on.")
@click.option("--html", type=click.Path(path_type=Path), help="With KIND auto: write a page with the ranking.")
@click.option("--seed", type=int, help="Seed of kinds that start at random.")
@click.option(
    "--from",
    "old",
    type=click.Path(path_type=Path),
    metavar="MODEL",
    help="Refit this model of KIND, or auto: its own.",
)
@tolerance_option
@set_option
@common_options("robot", "force")
def command(
    kind: str,
    recordings: tuple[Path, ...],
    output: Path | None,
    train: float,
    html: Path | None,
    seed: int | None,
    old: Path | None,
    tolerance: float | None,
    robot: str | None,
    settings: tuple[str, ...],
    force: bool,
    as_json: bool,
) -> None:
    """Identify a model of KIND from one or more recordings."""
    if old is not None:
        if html is not None or tolerance is not None:
            raise SettingsError("--from takes no --html and --tolerance: the model stays what it is.")
        adapt(kind, old, recordings, output, settings=settings, robot=robot, force=force, as_json=as_json)
        return
    if kind == "auto":
        if settings:
            raise SettingsError("--set: `auto` takes no settings; name the kind that they are for.")
        identify_auto(
            recordings, output, train=train, seed=seed, tolerance=tolerance, robot=robot, html=html,
            force=force, as_json=as_json,
        )  # fmt: skip
        return
    if html is not None:
        raise SettingsError(
            f"--html goes with KIND auto; for `{kind}` use `softneck validate MODEL --data REC --html`."
        )
    entry = find_kind(kind, "model")
    estimator = apply_settings(resolve(entry.settings), settings, seed=seed)
    path, replace = target(output, f"models/{kind}.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    whole = signals.open_recording(recordings, robot)
    with progress(f"identify {kind}", quiet=as_json) as report:
        model, held_out = identification.fit_and_validate(
            estimator, whole, train=train, tolerance=tolerance, progress=report
        )
    model.save(path, force=replace)
    head, tail = (whole, None) if train == 1.0 else whole.split(train)
    poor = signals.poor_excitation(head)
    if as_json:
        print_json(_facts(path, model, held_out) | {"excitation": poor})
    else:
        click.echo(f"{path}\n{model.summary()}")
        if held_out is None:
            click.echo("nothing was held out: judge it with `softneck validate` on another recording")
        click.echo("\n".join(poor), nl=bool(poor))
    why = None if held_out is None else useless(held_out)
    if why is not None:
        still = tail and signals.why_at_rest(tail, whole)
        why, advice = still or why, "" if still or held_out is None else left_out(held_out)
        advice = advice or (poor[0] if poor else _ADVICE)
        raise CheckFailedError(f"{path}: no model of the rows held out: {why}. {advice}")


def _facts(path: Path, model: identification.Model, held_out: identification.Validation | None) -> dict:
    return {
        "model": str(path),
        "kind": model.kind,
        "sample_time_s": model.sample_time,
        "rows_trained": int(model.training_rows.size),
        "settings": dict(model.settings),
        "findings": {name: value for name, value in model.findings.items() if name != "search"},
        "summary": model.summary(),
        "hold_out": None if held_out is None else held_out.as_dict(),
    }


@dataclass(frozen=True, slots=True)
class _Adaptation:
    """The settings of `--from`; `window` is the length of the latest data to use [s]."""

    window: float = 30.0


def adapt(
    kind: str, model: Path, recordings: tuple[Path, ...], output: Path | None, *, settings: Sequence[str],
    robot: str | None, force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Refit MODEL to the latest data, starting from its present parameters; write the result and print the fits."""
    path, replace = target(output, f"models/{model.stem}_adapted.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    old = load_for_robot(model, "model", robot)
    if kind not in (old.kind, "auto"):
        raise SettingsError(f"{model}: is of kind {old.kind}, not {kind}; a refitted model keeps its kind.")
    window = float(apply_settings(_Adaptation, settings).window)
    require_positive("window", window, "s")
    new = old.adapt(signals.open_recording(recordings, robot), window=window)
    new.save(path, force=replace)
    said = new.findings["adaptation"]
    if as_json:
        print_json({"model": str(path), "kind": new.kind, **said})
        return
    names = "/".join(new.robot.outputs.names)
    before, after = ("/".join(percent(fit) for fit in said[key]) for key in ("fit_before", "fit_after"))
    told = f"simulation on {said['rows_held_out']} rows held out of {said['window_s']:.3g} s, fit [%] {names}:"
    if said["adapted"]:
        click.echo(f"{path}: adapted\n{told} {before} -> {after}")
    else:
        click.echo(f"{path}: the old model, kept: {said['why']}" + (f"\n{told} {before}" if before else ""))
