"""softneck tune: find the best controller for requirements, or exit with code 1 and the active requirement."""

from __future__ import annotations

from pathlib import Path

import click

from softneck import tuning, verification
from softneck.core import CheckFailedError, SettingsError, file_hash
from softneck.robot import load_for_robot

from .shared._console import note, print_json, print_table, progress
from .shared._options import common_options, requirements_option

_PATH = click.Path(path_type=Path)
# As `softneck.tuning` has it, which is imported when the command runs.
_DEFAULT_BUDGET = 160


@click.command("tune", epilog="Example: softneck tune family.npz greybox.npz --requirements wanted.toml -o build/tune")
@click.argument("plants", metavar="FAMILY|MODEL...", nargs=-1, required=True, type=_PATH)
@click.option("--requirements", type=_PATH, metavar="TOML", help="Requirements that differ from the defaults.")
@requirements_option("softneck.tuning._requirements:default_text")
@click.option("--kinds", metavar="K,K", help="Kinds of controller to search. [default: all but nmpc and custom]")
@click.option(
    "--budget", type=click.IntRange(min=1), default=_DEFAULT_BUDGET, show_default=True, metavar="EVALUATIONS",
    help="Evaluations of candidates, by linear checks, loops or experiments.",
)  # fmt: skip
@click.option("--observer", type=_PATH, help="Of the loop. [default: a Kalman filter over the nominal plant]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the search and its noise.")
@click.option("--workers", type=click.IntRange(min=0), help="More processes. [default: one a further core, at most 7]")
@click.option("-o", "--output", type=_PATH, metavar="DIR", required=True, help="Folder of the search and its results.")
@common_options("robot", "force")
def command(
    plants: tuple[Path, ...],
    requirements: Path | None,
    kinds: str | None,
    budget: int,
    observer: Path | None,
    seed: int,
    workers: int | None,
    output: Path,
    robot: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Search kinds and settings for the controller that keeps the requirements on all plants.

    Designs are made on the linear MODELs and FAMILYs, the first of which is the nominal plant; loops are closed over
    simulation models: nonlinear MODELs, NECKs (a neck file, or a preset by its name) and FMUs.

    \b
    DIR gets  best.npz               the controller, and observer.npz for it
              best.certificate.json  of verify with the same requirements, if it holds
              loop.toml              a loop with both, for softneck simulate; without a simulation
                                     model it is over plant.npz, the model of the draws
              pareto.csv, .json      the Pareto front, and report.html
              tuner.html             all candidates, chosen by two sliders
              requirements.toml      all requirements, for tune and verify
              evaluations.json       all evaluations: the same command continues from them
    If no candidate meets a default limit of speed or accuracy, the limit becomes the best candidate's value, at most
    twice the default, and the result says so. Limits of a --requirements file stay. Exit code 1 if no candidate meets
    all; the line names the requirement that fails.
    """
    from softneck.report import tune_verdict, write_tuned

    if output.exists() and not output.is_dir():
        raise SettingsError(f"{output}: is a file; name a folder.")
    things = verification.named_plants(list(plants), robot)
    asked = tuning.task_of(things, requirements, seed).asked
    if not as_json:
        note("requirements: " + "; ".join(asked.lines()))
    eyes = None if observer is None else load_for_robot(observer, "observer", robot)
    files = {f"plant {k}": item for k, item in enumerate(plants, start=1) if item.is_file()}
    with progress("tune", quiet=as_json) as report:
        found = tuning.tune(
            things, asked, kinds=() if kinds is None else tuple(kinds.split(",")), budget=budget, observer=eyes,
            seed=seed, workers=workers, folder=output, force=force, progress=report,
            files={role: (str(item), file_hash(item)) for role, item in files.items()},
        )  # fmt: skip
    values = write_tuned(found, output, dict(zip(things, plants, strict=True)))
    if as_json:
        print_json(values)
    else:
        _print(found, output)
    if found.loosened:
        note(f"{output}: {tune_verdict(found)}")
    if not found.holds:
        raise CheckFailedError(_why(found, output))


def _print(found: tuning.Tuned, folder: Path) -> None:
    from softneck.report import requirement_rows, tune_notes

    best = found.best
    settings = ", ".join(
        f"{name} {value if isinstance(value, list) else f'{value:.4g}'}" for name, value in best.settings.items()
    )
    print_table(f"{folder / 'best.npz'}: {best.kind} ({settings})", ["metric", "bound", "limit", "value", ""],
                [row[:5] for row in requirement_rows(found)])  # fmt: skip
    for line in tune_notes(found):
        click.echo(line)
    for kind, why in found.dropped.items():
        click.echo(f"left out: {kind}: {why}")
    click.echo(
        f"{found.evaluations} evaluations, {len(found.front)} candidates on the front; report: {folder / 'report.html'}"
    )


def _why(found: tuning.Tuned, folder: Path) -> str:
    from softneck.report import failing_requirement

    failed = found.verification.failed
    binds = [item.note for item in failed if item.requirement.metric == found.binding]
    unknown = [item.note for item in failed if item.value is None]
    blind = verification.ALONE in binds or any("no linear form" in note for note in unknown)
    unheard = any(note.startswith("not supported by the data") for note in binds)
    drawn = found.verification.evidence.drawn
    doubt = next((part.draws.doubt for part in drawn if part.failed and part.draws.doubt), "")
    way = way_on(found.binding, unheard=unheard, blind=blind, unknown=bool(unknown), doubt=doubt)
    return f"{folder}: the best so far does not keep all requirements. {failing_requirement(found)} {way}."


def way_on(binding: str | None, *, unheard: bool, blind: bool = False, unknown: bool = False, doubt: str = "") -> str:
    """Return the advice on the active requirement.

    `binding`: the active requirement; None if it is not known. `unheard`: whether the data do not support it. `blind`:
    whether the kind has no linear form to test against the data. `unknown`: whether something else was not computed.
    `doubt`: why the draws that fail decide little.
    """
    from softneck.verification import MARGIN_GROUPS

    if blind:
        return "No setting fixes it: name kinds with a linear form in --kinds, such as pi or lqg"
    if unknown:
        return "No setting of a controller fixes it: give what is missing, or leave the requirement out"
    if doubt:
        return (
            f"The family's draws decide little, as {doubt}: record longer, with steps to other heights, and make the "
            "family of all recordings"
        )
    if binding is None:
        return "Continue with a larger --budget"
    if unheard:
        return "Record the data named above; no setting fixes it"
    if binding.startswith(MARGIN_GROUPS):
        return (
            "It covers the uncertainty of the models: allow a slower rise, give a family of more recordings, or "
            "continue with a larger --budget"
        )
    return "Loosen it, or continue with a larger --budget"
