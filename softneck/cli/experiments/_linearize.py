"""softneck linearize: the linear system that a model, a neck, a controller or any tool's FMU is near a moment."""

from __future__ import annotations

import math
from pathlib import Path

import click

from softneck.core import SettingsError, refuse_existing

from .._fmu import open_buildable
from ..shared._console import print_json
from ..shared._options import force_option, json_option, output_option, target
from ..shared._robot import robot_option

# What pulses may differ by before the page of a linear system is not worth much.
_POOR = 1e-3


@click.command(
    "linearize", epilog="Example: softneck linearize Neck.fmu --at t=3.0 --set motor_setpoint_1=1.5 -o ss.mat"
)
@click.argument("file", metavar="MODEL|X.fmu")
@output_option("MATLAB file", "SS.mat")
@click.option(
    "--at", "moment", default="t=0", metavar="t=S", show_default=True, help="When, with inputs held until then."
)
@click.option(
    "--set",
    "values",
    multiple=True,
    metavar="NAME=VALUE",
    help="An input or parameter that is held at another value than its start value, in SI units, or NAME_deg=VALUE.",
)
@click.option("--sample-time", type=float, metavar="S", help="Of another tool's FMU [s].  [default: its own step]")
@robot_option
@force_option
@json_option
def command(
    file: str, output: Path | None, moment: str, values: tuple[str, ...], sample_time: float | None,
    robot: str | None, force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Write A, B, C, D of small changes near a moment, at the sample time.

    FILE is an FMU of any tool (FMI 2.0 or 3.0, Co-Simulation), or what `softneck fmu` takes. Exact for what is ours
    and has derivatives; else from pulses on a saved state, and what they miss is said.
    """
    from softneck.cosim.linear._linearize import linearize

    path, replace = target(output, f"linear/{Path(file).stem}.mat", force=force, ending=".mat")
    refuse_existing(path, force=replace)
    if Path(file).suffix == ".ssp":
        raise SettingsError(f"{file}: is several FMUs; unzip it and linearize one of those in `resources`.")
    source = Path(file) if Path(file).suffix == ".fmu" else open_buildable(file, robot).block()
    if sample_time is not None and not isinstance(source, Path):
        raise SettingsError("--sample-time is for FMUs; a file of softneck has its own.")
    system = linearize(source, at=_moment(moment), values=dict(map(_value, values)), sample_time=sample_time)
    system.to_mat(path, force=replace)
    if system.error > _POOR:
        click.echo(
            f"warning: no linear system answers its pulses better than to {100.0 * system.error:.2g} %: it is not "
            "linear there, or moves while its inputs are held.",
            err=True,
        )
    facts = {
        "mat": str(path), "states": len(system.A), "inputs": list(system.inputs), "outputs": list(system.outputs),
        "sample_time_s": system.sample_time, "time_s": system.time, "method": system.method, "error": system.error,
    }  # fmt: skip
    if as_json:
        print_json(facts)
        return
    how = "exact" if system.method == "exact" else f"by pulses, which it answers to {system.error:.1e} of the largest"
    click.echo(f"{path}: {len(system.A)} states at t = {system.time:g} s, {system.sample_time:g} s a sample, {how}")
    click.echo(f"from {', '.join(system.inputs)}\nto {', '.join(system.outputs)}")


def _moment(text: str) -> float:
    try:
        at = float(text.removeprefix("t="))
    except ValueError:
        at = math.nan
    if not math.isfinite(at) or at < 0.0:
        raise SettingsError(f"--at {text}: must be t=SECONDS, 0 or more, such as t=3.0.")
    return at


def _value(text: str) -> tuple[str, float]:
    name, sign, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not name or not sign or not math.isfinite(value):
        raise SettingsError(f"--set {text}: must be NAME=VALUE, a finite number.")
    return (name.removesuffix("_deg"), math.radians(value)) if name.endswith("_deg") else (name, value)
