"""softneck verify: a controller against all that its plant may be, or exit code 1."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import click

from softneck import estimation, verification
from softneck.core import (
    CERTIFICATE_ENDING,
    CheckFailedError,
    SoftneckError,
    file_hash,
    read_certificate,
    refuse_existing,
    write_certificate,
)
from softneck.loop import ORDERS
from softneck.robot import load_for_robot

from .shared._console import note, print_json, print_table, progress
from .shared._options import common_options, output_option, requirements_option, target

_PATH = click.Path(path_type=Path)


@click.command("verify", epilog="Example: softneck verify pi.npz neck_family.npz -o pi.certificate.json --html pi.html")
@click.argument("controller", type=_PATH)
@click.argument("plants", metavar="MODEL|FAMILY|NECK|FMU...", nargs=-1, required=True, type=_PATH)
@click.option("--requirements", type=_PATH, metavar="TOML", help="What must hold, where it differs from the defaults.")
@requirements_option("softneck.verification._requirements:default_text")
@click.option("--observer", type=_PATH, help="Observer of the loops over the virtual neck; hashed like the controller.")
@click.option(
    "--order", type=click.Choice(ORDERS), help="Order of the loop. [default: that of the controller's design]"
)
@output_option("certificate", "CERTIFICATE")
@click.option("--html", type=_PATH, help="Write a page with the verdict, and all behind it in plots.")
@common_options("robot", "force")
def command(
    controller: Path,
    plants: tuple[Path, ...],
    requirements: Path | None,
    observer: Path | None,
    order: str | None,
    robot: str | None,
    output: Path | None,
    html: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Verify CONTROLLER on every plant of the linear MODELs and FAMILYs, and in loops over simulation models.

    A FAMILY with draws (`softneck family`) decides by loops over them: none of 59 may fail. Its linear tests are shown
    beside. The certificate counts how often one was tried over the same FAMILY, by the certificates in its folder.

    Simulation models are nonlinear MODELs, NECKs (a neck file, or a preset by its name) and FMUs. On them margins are
    also found by experiment. Without any, and without draws, the built-in neck is shown only: it does not decide. For
    another robot it is the virtual plant that its robot.toml names, if there is one.

    Writes a certificate: each requirement with its value, limit and worst plant, and the hashes of all files read;
    beside it a loop file for every worst plant, for `softneck simulate`. Exit code 1 if a requirement does not hold.
    """
    path, replace = target(output, f"certificates/{controller.stem}{CERTIFICATE_ENDING}", force=force, ending=".json")
    refuse_existing(path, force=replace)
    if html is not None:
        refuse_existing(html, force=force)
    judged = load_for_robot(controller, "controller", robot)
    whose = estimation.robot_of(judged)
    asked = verification.read_requirements(requirements, robot=whose)
    if left := [name for name, item in asked.own.get("require", {}).items() if name.startswith("track.") and item]:
        note(f"{requirements}: {', '.join(left)} not looked at; `softneck tune` alone closes those loops.")
    things, eyes = (
        verification.named_plants(list(plants), robot),
        None if observer is None else load_for_robot(observer, "observer", robot),
    )
    files = {
        "controller": controller,
        **{f"plant {k}": item for k, item in enumerate(plants, start=1) if item.is_file()},
    }
    files |= {} if requirements is None else {"requirements": requirements}
    files |= {} if observer is None else {"observer": observer}
    neck_file = verification.neck_file_of(whose, asked)
    files |= {"neck": neck_file} if neck_file.suffix == ".toml" else {}
    hashed = {role: (str(item), file_hash(item)) for role, item in files.items()}
    families = [digest for role, (_, digest) in hashed.items() if role.startswith("plant ")]
    tried = _tried(path.parent, families) if any(getattr(t, "draws", None) is not None for t in things.values()) else []
    this = _attempt_of(hashed)
    earlier = tried if this not in tried else tried[: tried.index(this)]
    attempt = max(len(earlier) + 1, _attempt_of_tune(controller))
    with progress("verify", quiet=as_json) as report:
        found = verification.verify(
            judged, things, asked, order=order, observer=eyes, progress=report, attempt=attempt, files=hashed
        )
    folder = path.with_name(f"{path.name.removesuffix('.json').removesuffix('.certificate')}_worst")
    loops = found.write_worst(folder, controller=controller, observer=observer, force=True)
    counted = {"attempts": {"plants": families, "tried": [*earlier, this]}} if found.evidence.drawn else None
    contents = found.contents(loops, counted)
    write_certificate(path, contents, force=replace)
    if html is not None:
        from softneck.plots import write_page
        from softneck.verification import verification_page

        write_page(html, verification_page(found, controller.name, path.name), force=force)
    if as_json:
        print_json({**contents, "decision": verification.verification_decision(contents, path.name)})
    else:
        _print(path, found, folder)
    if not found.holds:
        if not found.failed:
            raise CheckFailedError(f"{controller}: no requirement was computed, so none holds.")
        listed = ", ".join(verdict.requirement.metric for verdict in found.failed)
        raise CheckFailedError(f"{controller}: {len(found.failed)} requirement(s) do not hold: {listed}.")


def _attempt_of(files: Mapping[str, tuple[str, str]]) -> str:
    """Return what tells an attempt at a certificate from another one: its controller, observer and requirements."""
    told = [f"{role} {digest}" for role, (_, digest) in files.items() if not role.startswith("plant ")]
    return hashlib.sha256("\n".join(sorted(told)).encode()).hexdigest()


def _attempt_of_tune(controller: Path) -> int:
    """Return which attempt at a certificate `softneck tune` counted for its controller; 1 without one."""
    beside = controller.with_name(controller.stem + CERTIFICATE_ENDING)
    try:
        said = read_certificate(beside).contents.get("draws") if beside.is_file() else None
        return max((int(part["attempt"]) for part in said), default=1) if isinstance(said, list) else 1
    except (SoftneckError, KeyError, TypeError, ValueError):
        return 1


def _tried(folder: Path, families: list[str]) -> list[str]:
    """Return the attempts at a certificate over the same plants that the certificates of a folder tell of."""
    found: dict[str, None] = {}
    lists = []
    for item in sorted(folder.glob("*.json")):
        try:
            said = read_certificate(item).contents.get("attempts")
        except SoftneckError:
            continue  # another file
        if isinstance(said, dict) and said.get("plants") == families and isinstance(said.get("tried"), list):
            lists.append([str(each) for each in said["tried"]])
    # The longest first: each tells of those before it.
    for each in sorted(lists, key=len, reverse=True):
        found |= dict.fromkeys(each)
    return list(found)


def _print(path: Path, found: verification.Verification, folder: Path) -> None:
    table = verification.verdict_table(found)
    below = set(found.evidence.not_computed.values())  # printed once, below, and no cell as wide
    print_table(str(path), table.head, [[*row[:-1], "" if row[-1] in below else row[-1]] for row in table.rows])
    for part in found.evidence.drawn:
        for row in filter(lambda row: row["motion"] > 0.0, part.draws.coverage):  # files of before have such rows
            click.echo(
                f"draws cover {100.0 * row['covered']:.0f} % of {row['class']} held-out motions, by a band of "
                f"+-{part.draws.band_of(row)} of the motion"
            )
    for name, why in found.evidence.not_computed.items():
        click.echo(f"not computed: {name}: {why}")
    click.echo(f"{found.summary()}; worst plants as loops in {folder}")
