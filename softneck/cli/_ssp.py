"""softneck ssp: a loop as one SSP file for other simulators."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import file_hash

from .shared._console import note, print_json, progress
from .shared._options import force_option, json_option, output_option, target
from .shared._robot import robot_option


@click.command("ssp", epilog="Example: softneck ssp build/demo/loops/pitch_step.toml -o pitch_step.ssp")
@click.argument("loop_file", metavar="LOOP.toml|X.ssp", type=click.Path(path_type=Path))
@output_option("SSP archive", "X.ssp")
@click.option(
    "--backend",
    type=click.Choice(["compiled", "python"]),
    default="compiled",
    show_default=True,
    help="What runs in its FMUs: a C library that needs nothing, or Python and numpy of the host.",
)
@robot_option
@force_option
@json_option
def command(loop_file: Path, output: Path | None, backend: str, robot: str | None, force: bool, as_json: bool) -> None:
    """Write the loop of LOOP.toml as an SSP 1.0 archive: plant, observer, controller and reference FMUs.

    Masters that read it set all inputs and then step all: they compute what `order = "jacobi"` does.
    """
    from softneck.cosim import load_loop, load_ssp, write_ssp
    from softneck.loop._system import System

    path, replace = target(output, f"ssp/{loop_file.stem}.ssp", force=force)
    with progress("ssp", quiet=as_json):
        plain = loop_file.suffix == ".ssp" and robot is None
        setup = load_ssp(loop_file) if plain else load_loop(loop_file, robot=robot)
        write_ssp(setup, path, force=replace, compiled=backend == "compiled")
    loop = setup if isinstance(setup, System) else setup.loop
    parts = [*loop.parts, *(["reference"] if loop is not setup and "reference" not in loop.parts else [])]
    if as_json:
        print_json({"ssp": str(path), "sha256": file_hash(path), "parts": parts})
        return
    click.echo(str(path))
    if loop.order == "sequential":
        note('the loop file is sequential; an SSP master computes what it gives with order = "jacobi".')
