"""softneck family: an uncertain linear plant from several recordings or operating points."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import numpy as np

from softneck import identification, plots, signals
from softneck.core import CheckFailedError, refuse_existing

from .shared._console import print_json, progress
from .shared._options import apply_settings, common_options, kind_command, output_option, set_option, target


@click.command(
    "family",
    cls=kind_command("family", "family"),
    epilog="Example: softneck family 0g.csv 400g.csv 1000g.csv -o neck_family.npz --html family.html",
)
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@output_option("family", "FAMILY")
@set_option
@click.option(
    "--test",
    "tests",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="REC",
    help="Recording that the family is not fitted to, and judged by: where it needs more than the weight. Repeatable.",
)
@click.option(
    "--draws",
    type=click.IntRange(min=0),
    default=59,
    show_default=True,
    help="Nonlinear models for each certificate: 59 for 95 % of such plants, 299 for 99 %; 0 makes none.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the draws.")
@click.option("--html", type=click.Path(path_type=Path), help="Write a page with maps and the weight.")
@common_options("robot", "force")
def command(
    recordings: tuple[Path, ...],
    output: Path | None,
    settings: tuple[str, ...],
    tests: tuple[Path, ...],
    draws: int,
    seed: int,
    html: Path | None,
    robot: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Fit local models over windows, operating points and RECORDINGS (payloads); wrap them into an uncertain plant.

    The file also holds draws: nonlinear models (of a robot with tendons the grey box, else `play`) that explain the
    recordings, and the disturbance that held-out motions leave over. `verify` decides by loops over them.

    The linear plant is tested against the recordings: a weight covers the frequency responses that they show, at every
    amplitude and payload among them, in the band that they excite. Exit code 1 if a recording of --test needs more than
    the weight.
    """
    from softneck.identification import family as made_family

    chosen = apply_settings(identification.FamilySettings, settings)
    path, replace = target(output, "families/family.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    if html is not None:
        refuse_existing(html, force=force)
    judges = [signals.read_recording(source) for source in tests]
    with progress("family", quiet=as_json) as report:
        family = made_family(list(recordings), robot=robot, draws=draws, seed=seed, progress=report, **asdict(chosen))
    lines, needed = family.invalidated_by(judges, [str(source) for source in tests]) if judges else ([], {})
    family.save(path, force=replace)
    if html is not None:
        plots.write_page(html, _page(family), force=force)
    if as_json:
        print_json({**_facts(path, family), **({"test": {"lines": lines, "needed": needed}} if judges else {})})
    else:
        click.echo("\n".join([str(path), family.summary(), *lines]))
    if lines:
        raise CheckFailedError(f"{lines[0]}; record more of that for the family, or say why it does not count.")
    if judges and not as_json:
        click.echo("not invalidated by --test (which does not say that the family explains it)")


def _facts(path: Path, family: identification.Family) -> dict[str, Any]:
    axes = {
        name: {
            "nominal": _parameters(axis.nominal),
            "box": {"low": _parameters(axis.box[0]), "high": _parameters(axis.box[1])},
            "samples": int(axis.used.sum()),
            "largest_relative_error": float(axis.envelope.max()),
            "covered": family.covered(name),
            "weight": {"numerator": axis.weight[0], "denominator": axis.weight[1]},
        }
        for name, axis in family.axes.items()
    }
    return {
        "family": str(path),
        "sample_time_s": family.sample_time,
        "axes": axes,
        "cross_gains": {
            "from": [*family.robot.input_names, family.robot.cocontraction_name][: len(next(iter(family.cross)))],
            **dict(zip(family.axes, family.cross, strict=True)),
        },
        "compression": _parameters(family.compression),
        "settings": family.settings,
        "findings": family.findings,
        "band_rad_s": {name: family.band(name) for name in family.axes},
        "measured": {name: _response_facts(found) for name, found in family.measured.items()},
        "draws": None if family.draws is None else _draws_facts(family.draws),
        "summary": family.summary(),
    }


def _draws_facts(draws: identification.Draws) -> dict[str, Any]:
    return {
        "kind": draws.model.kind, "count": draws.count, "certificates": draws.attempts, "seed": draws.seed,
        "factor": draws.factor, "disturbance_share": draws.share, "disturbance_keep": draws.keep,
        "coverage": draws.coverage, "conditions": dict(draws.conditions),
    }  # fmt: skip


def _response_facts(found: Any) -> dict[str, Any]:
    return {
        "poles": found.model.a.size, "dead_time_s": found.model.delay, "held_out_rms": found.held_out,
        "frequency_rad_s": found.frequency, "weight": found.weight, "bands_rad_s": found.borders,
        "needed": found.needed,
    }  # fmt: skip


def _parameters(numbers: np.ndarray) -> dict[str, float]:
    return dict(zip(("static_gain", "pole", "delay_s"), numbers.tolist(), strict=True))


def _page(family: identification.Family) -> str:
    gain, unit = family.robot.shown_gain
    sections = []
    for name, axis in family.axes.items():
        s, (above, below) = 1j * family.frequency, axis.weight
        weight = np.abs(np.polyval(above, s) / np.polyval(below, s))
        title = f"{name}: the weight over its samples"
        chart = plots.cover_chart(family.frequency, family.errors(name), weight, title)
        head = ["", f"static gain [{unit}]", "pole [1/s]", "dead time [ms]"]
        parts = {"least": axis.box[0], "largest": axis.box[1], "nominal": axis.nominal}
        rows = [[label, *_numbers(row, gain)] for label, row in parts.items()]
        sections.append(plots.Section(name, tables=[plots.Table("Box", head, rows)], charts=[chart]))
    sections.append(plots.Section("In numbers", text=family.summary().splitlines()))
    verdict = " ".join(_verdict(family, name, gain, unit) for name in family.axes)
    return plots.page("Family of linear models", sections, verdict=verdict, footer="Written by softneck family.")


def _verdict(family: identification.Family, name: str, gain: float, unit: str) -> str:
    """Return the band in which the weight covers the measured responses, and the range of the plant."""
    low, high = (_numbers(row, gain) for row in family.axes[name].box)
    shown = f"{name[0].upper()}{name[1:]}"
    span = f"its static gain is {low[0]} to {high[0]} {unit} and its dead time {low[2]} to {high[2]} ms"
    band = family.band(name)
    if band is None:
        return f"{shown} was not tested against the data; {span}."
    return (
        f"{shown}: the weight covers every response measured from {band[0]:.2g} to {band[1]:.2g} rad/s; "
        f"nothing is known above. In them {span}."
    )


def _numbers(row: np.ndarray, gain: float) -> list[str]:
    static = gain * row[0]
    return [f"{static:.2f}" if abs(static) >= 0.1 else f"{static:.3g}", f"{row[1]:.2f}", f"{1e3 * row[2]:.0f}"]
