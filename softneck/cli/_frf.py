"""softneck frf: the frequency response that recordings show."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from softneck.core import DataError, refuse_existing

from .shared._console import print_json, progress
from .shared._options import force_option, json_option, output_option, target
from .shared._robot import load_of, robot_option

if TYPE_CHECKING:
    from softneck.identification import Family, FrequencyResponse, Model


@click.command(
    "frf", epilog="Example: softneck frf small.csv -o small.npz --html frf.html; what it takes best: "
    "softneck record multisine --band 0.5,25 --amplitude 0.3 -o small.csv"
)  # fmt: skip
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@output_option("frequency response", "FRF")
@click.option("--source", default="set_points", show_default=True, metavar="set_points|positions", help="Inputs.")
@click.option(
    "--model", "models", multiple=True, type=click.Path(path_type=Path), help="Model or family to draw beside."
)
@click.option("--html", type=click.Path(path_type=Path), help="Write a page with Bode plots.")
@robot_option
@force_option
@json_option
def command(
    recordings: tuple[Path, ...],
    output: Path | None,
    source: str,
    models: tuple[Path, ...],
    html: Path | None,
    robot: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Estimate the frequency response from RECORDINGS, with confidence, coherence and the band that they support.

    Periodic multisines (`softneck record multisine --band ...`) give noise and nonlinear distortion apart; one sine
    gives the describing function; any other excitation, and a closed loop with its reference, is taken by local
    polynomials. It holds for inputs of the size that was played.
    """
    from softneck.identification import frequency_response
    from softneck.plots import write_page
    from softneck.signals import read_recording

    path, replace = target(output, "frf/frf.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    if html is not None:
        refuse_existing(html, force=force)
    beside = {str(file): load_of(file, robot) for file in models}
    parts = [read_recording(file, robot=robot) for file in recordings]
    with progress("frf", quiet=as_json):
        found = frequency_response(parts, source=source)
    curves = {name: _curve(found, thing, name) for name, thing in beside.items()}
    found.save(path, force=replace)
    if html is not None:
        write_page(html, _page(found, curves), force=force)
    if as_json:
        print_json({"frf": str(path), **found.as_dict()})
        return
    click.echo(f"{path}\n{found.summary()}")


def _curve(found: FrequencyResponse, thing: Model | Family, name: str) -> dict[str, np.ndarray]:
    """Return the model's response of each output to the input that is meant for it [SI]."""
    if not hasattr(thing, "tf"):
        raise DataError(f"{name}: only a linear model or a family has a response to draw.")
    if abs(thing.sample_time - found.sample_time) > 1e-9 * found.sample_time:
        raise DataError(f"{name}: is at {thing.sample_time:g} s and the recordings at {found.sample_time:g} s.")
    z = np.exp(1j * found.frequency * found.sample_time)
    return {output: np.squeeze(thing.tf(output)(z)) for output in found.outputs}


def _page(found: FrequencyResponse, models: dict[str, dict[str, np.ndarray]]) -> str:
    from softneck.plots import Section, frequency_response_figure, page

    scale, per_input, unit = found.shown()
    sections: list[Any] = []
    radius = found.radius()
    for i, output in enumerate(found.outputs):
        source = found.own_input(output)
        a = found.inputs.index(source)
        title = f"{source} to {output}"
        played = [
            (item.frequency, scale * item.response[i], f"sine of {per_input * item.amplitude[a]:.2g}")
            for item in found.sines
            if int(np.argmax(item.amplitude)) == a
        ]
        figure = frequency_response_figure(
            found.frequency,
            scale * found.response[:, i, a],
            scale * np.nan_to_num(radius[:, i, a]),
            found.coherence[:, i],
            title,
            unit=unit,
            models={Path(name).stem: scale * curves[output] for name, curves in models.items()},
            sines=played,
        )
        sections.append(Section(title, figures=[(title, figure)]))
    sections.append(Section("Numbers", text=found.summary().splitlines()))
    bands = {output: found.band(output, found.own_input(output)) for output in found.outputs}
    told = [
        f"{output} nowhere" if band is None else f"{output} from {band[0]:.3g} to {band[1]:.3g} rad/s"
        for output, band in bands.items()
    ]
    return page(
        "Frequency response", sections, verdict=f"The data support the response of {', '.join(told)}.",
        holds=None if all(bands.values()) else False, footer="Written by softneck frf.",
    )  # fmt: skip
