"""softneck fmu: models, observers, controllers and the virtual neck as FMUs."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import FileFormatError, SettingsError, load
from softneck.cosim import is_loop_file, reference_of
from softneck.fmu import Buildable, build_fmu, describe
from softneck.plant import NeckParameters, VirtualNeck

from ._console import print_json, progress
from ._neck import load_neck
from ._options import force_option, json_option, output_option, target


@click.command("fmu", epilog="Example: softneck fmu build/demo/models/rls.npz -o Rls.fmu")
@click.argument("file", required=False)
@output_option("FMU", "X.fmu")
@click.option("--all", "folder", type=click.Path(path_type=Path), help="Build one FMU of every file of ours in DIR.")
@click.option("--backend", type=click.Choice(["python"]), default="python", show_default=True, help="What runs inside.")
@click.option("--fmi", type=click.Choice(["2"]), default="2", show_default=True, help="FMI version.")
@force_option
@json_option
def command(
    file: str | None, output: Path | None, folder: Path | None, backend: str, fmi: str, force: bool, as_json: bool
) -> None:
    """Package FILE as an FMI 2.0 Co-Simulation FMU.

    FILE is a model, observer or controller (.npz), a neck parameter file (.toml), a neck preset (paper, lab), or a
    loop file, of whose [reference] a reference FMU is made.
    """
    del backend, fmi  # one of each in this version; the options hold their place
    jobs, replace = _what(file, folder, output, force=force)
    with progress("build FMU", quiet=as_json) as report:
        for number, (source, path) in enumerate(jobs):
            report(number / len(jobs), path.name)
            thing = open_buildable(source)
            build_fmu(thing.block(), path, info=describe(thing), force=replace)
    built = [{"source": str(source), "fmu": str(path)} for source, path in jobs]
    if as_json:
        print_json({"fmus": built})
        return
    for entry in built:
        click.echo(f"{entry['fmu']}  from {entry['source']}")


def open_buildable(source: str | Path) -> Buildable:
    """Return what `source` names: a file of ours, a neck file or a neck preset."""
    if Path(source).suffix == ".npz":
        return load(source)
    if is_loop_file(Path(source)):
        return reference_of(Path(source))
    return VirtualNeck(load_neck(str(source)))


def _what(
    file: str | None, folder: Path | None, output: Path | None, *, force: bool
) -> tuple[list[tuple[str | Path, Path]], bool]:
    """Return (source, FMU) pairs and whether existing FMUs may be replaced."""
    if file is not None and folder is None:
        path, replace = target(output, f"fmus/{_stem(file)}.fmu", force=force)
        return [(file, path)], replace
    if folder is not None and file is None:
        return _jobs(folder, output or Path("build/fmus")), force or output is None
    raise SettingsError("name one FILE, or a folder with --all.")


def _jobs(folder: Path, out: Path) -> list[tuple[str | Path, Path]]:
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: is no folder.")
    sources = sorted(path for path in folder.iterdir() if path.suffix == ".npz" or _is_neck(path))
    if not sources:
        raise FileFormatError(f"{folder}: holds no model, observer, controller or neck file.")
    return [(path, out / f"{_stem(path.name)}.fmu") for path in sources]


def _is_neck(path: Path) -> bool:
    if path.suffix != ".toml":
        return False
    try:
        NeckParameters.from_toml(path)
    except SettingsError:
        return False
    return True


def _stem(file: str) -> str:
    """Return a name that FMI allows, out of a file's: `my-model.npz` becomes `my_model`."""
    stem = "".join(c if c.isascii() and c.isalnum() else "_" for c in Path(file).stem)
    return f"m_{stem}" if stem[:1].isdigit() else stem
