"""softneck fmu: models, observers, controllers and the virtual neck as FMUs, a loop as an SSP file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck import cosim, identification, plant, runtime, signals
from softneck.core import FileFormatError, SettingsError, file_hash, load
from softneck.fmu import PLATFORMS

from .shared._console import note, print_json, progress
from .shared._options import common_options, output_option, target

if TYPE_CHECKING:
    from softneck.fmu import Buildable


@click.command("fmu", epilog="Example: softneck fmu build/demo/models/rls.npz -o Rls.fmu")
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@output_option("FMU, or the SSP file", "X.fmu|X.ssp")
@click.option(
    "--data",
    multiple=True,
    type=click.Path(path_type=Path),
    help="A recording to score the model on; the scores go into the FMU.",
)
@click.option(
    "--backend",
    type=click.Choice(["python", "compiled"]),
    help="What runs inside: Python and numpy of the host, or a C library that needs neither.  "
    "[default: python; compiled in an SSP file]",
)
@click.option(
    "--fmi",
    type=click.Choice(["2", "3"]),
    default="2",
    show_default=True,
    help="FMI version; 3 needs --backend compiled.",
)
@click.option(
    "--platform",
    "platforms",
    multiple=True,
    metavar="NAME",
    help=f"Build a compiled FMU only for these platforms: {', '.join(PLATFORMS)}.  [default: all that are built]",
)
@click.option(
    "--sensitivities",
    is_flag=True,
    help="Add outputs of later samples (pitch_next, pitch_ahead, motor_setpoint_1_next, ..) and their directional "
    "derivatives; with --backend compiled.",
)
@common_options("robot", "force")
def command(
    files: tuple[str, ...], output: Path | None, data: tuple[Path, ...],
    backend: str | None, fmi: str, platforms: tuple[str, ...], sensitivities: bool,
    robot: str | None, force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Package FILE as an FMU of FMI 2.0 or 3.0; of several files, or of a folder, -o is a folder.

    It is for Co-Simulation; with --backend compiled also for Model Exchange, with an event at each sample.

    FILE is a model, observer or controller (.npz), a neck parameter file (.toml), a neck preset (paper, lab, rough,
    trunk), a robot file or preset, whose virtual plant it becomes, or a loop file, from whose [reference] a reference
    FMU is built. With -o X.ssp the whole loop of a loop file (or of another archive) becomes an SSP 1.0 archive: plant,
    observer, controller and reference. Masters that read it set all inputs and then step all: they compute what
    `order = "jacobi"` does.
    """
    from softneck.fmu import build_compiled_fmu, build_fmu, fmu_info

    many = len(files) != 1 or Path(files[0]).is_dir()
    if output is not None and output.suffix.lower() == ".ssp":
        if many or data or fmi != "2" or platforms or sensitivities:
            raise SettingsError(f"{output}: an SSP file is made of one loop file, and takes --backend only.")
        _ssp(Path(files[0]), output, robot, compiled=backend != "python", force=force, as_json=as_json)
        return
    if backend != "compiled" and (fmi != "2" or platforms or sensitivities):
        raise SettingsError(
            "--fmi 3, --platform and --sensitivities are for compiled FMUs only; add `--backend compiled`."
        )
    origin = ""
    jobs, replace = _what(files, output, force=force)
    # All are read before any is written: one bad file stops the command with nothing done.
    things = [(source, open_buildable(source, robot), path) for source, path in jobs if not many or _has_block(source)]
    built, left_out = [], [str(source) for source, _ in jobs if source not in {source for source, _, _ in things}]
    with progress("build FMU", quiet=as_json) as report:
        for number, (source, thing, path) in enumerate(things):
            report(number / len(things), path.name)
            judged = _judge(thing, source, data, robot) if data else None
            block, info = thing.block(), fmu_info(thing, validation=judged)
            if backend == "compiled":
                ahead = sensitivities and (not many or _has_sensitivities(block))
                origin = build_compiled_fmu(
                    block, path, info=info, force=replace, fmi=int(fmi), platforms=platforms, sensitivities=ahead
                )
            else:
                build_fmu(block, path, info=info, force=replace)
            built.append({"source": str(source), "fmu": str(path)})
    if as_json:
        print_json({"fmus": built, "left_out": left_out} | ({"libraries": origin} if origin else {}))
        return
    for entry in built:
        click.echo(f"{entry['fmu']}  from {entry['source']}")
    if origin:
        click.echo(f"libraries: {origin}")
    for source in left_out:
        click.echo(f"left out: {source}, which is not a model, observer or controller")


def _ssp(file: Path, path: Path, robot: str | None, *, compiled: bool, force: bool, as_json: bool) -> None:
    """Write a loop as an SSP archive."""
    from softneck.loop import System

    if file.suffix.lower() not in (".toml", ".ssp"):
        raise SettingsError(f"{file}: an SSP file is made of a loop file (.toml) or of another archive (.ssp).")
    with progress("build SSP", quiet=as_json):
        plain = file.suffix.lower() == ".ssp" and robot is None
        setup = cosim.load_ssp(file) if plain else cosim.load_loop(file, robot=robot)
        cosim.write_ssp(setup, path, force=force, compiled=compiled)
    loop = setup if isinstance(setup, System) else setup.loop
    parts = [*loop.parts, *(["reference"] if loop is not setup and "reference" not in loop.parts else [])]
    if as_json:
        print_json({"ssp": str(path), "sha256": file_hash(path), "parts": parts})
        return
    click.echo(str(path))
    if loop.order == "sequential":
        note('the loop file is sequential; an SSP master computes what it gives with order = "jacobi".')


def open_buildable(source: str | Path, robot: str | None = None) -> Buildable:
    """Return the softneck file, neck or robot that `source` names, by its file or preset."""
    from softneck.fmu import buildable

    return (
        cosim.reference_of(Path(source), robot=robot) if cosim.is_loop_file(Path(source)) else buildable(source, robot)
    )


def _has_block(source: str | Path) -> bool:
    return Path(source).suffix != ".npz" or hasattr(load(source), "block")


def _has_sensitivities(block: runtime.Block) -> bool:
    """Return whether an FMU of `block` can have sensitivities; print a warning if not."""
    from softneck.fmu import next_outputs

    try:
        return bool(next_outputs(block))
    except SettingsError as error:
        click.echo(f"warning: built without: {error}", err=True)
        return False


def _judge(
    thing: Buildable, source: str | Path, data: tuple[Path, ...], robot: str | None
) -> identification.Validation | None:
    """Validate a model on all recordings together; return None if `thing` is no model."""
    if not isinstance(thing, identification.Model):
        return None
    names = (Path(source).name, ", ".join(path.name for path in data))
    return identification.validate(thing, signals.open_recording(data, robot), names=names)


def _what(files: tuple[str, ...], output: Path | None, *, force: bool) -> tuple[list[tuple[str | Path, Path]], bool]:
    """Return (source, FMU) pairs and whether existing FMUs may be replaced."""
    if len(files) == 1 and not Path(files[0]).is_dir():
        path, replace = target(output, f"fmus/{_stem(files[0])}.fmu", force=force)
        return [(files[0], path)], replace
    sources: list[str | Path] = []
    for file in files:
        sources += _inside(Path(file)) if Path(file).is_dir() else [file]
    out = output or Path("build/fmus")
    if out.suffix == ".fmu":
        raise SettingsError(f"{out}: several files become several FMUs; name a folder.")
    jobs: dict[Path, str | Path] = {}
    for source in sources:
        fmu = out / f"{_stem(Path(source).name)}.fmu"
        if fmu in jobs:
            raise SettingsError(f"{jobs[fmu]} and {source} would both become {fmu}; rename one of them.")
        jobs[fmu] = source
    return [(source, fmu) for fmu, source in jobs.items()], force or output is None


def _inside(folder: Path) -> list[Path]:
    """Return the files of a folder that are, or may be, files of softneck."""
    sources = sorted(path for path in folder.iterdir() if path.suffix == ".npz" or _is_neck(path))
    if not sources:
        raise FileFormatError(f"{folder}: holds no model, observer, controller or neck file.")
    return sources


def _is_neck(path: Path) -> bool:
    """Return whether a file has the keys of a neck file; reading it checks the rest."""
    from softneck.fmu import has_keys

    return has_keys(path, {"preset", *plant.NeckParameters.names()})


def _stem(file: str) -> str:
    """Return a name that FMI allows, out of a file's: `my-model.npz` becomes `my_model`."""
    stem = "".join(c if c.isascii() and c.isalnum() else "_" for c in Path(file).stem)
    return f"m_{stem}" if stem[:1].isdigit() else stem
