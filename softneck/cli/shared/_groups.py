"""Groups of commands: hints for unknown and renamed commands, and completion of kinds in a shell."""

from __future__ import annotations

from collections.abc import Callable

import click

from softneck import core
from softneck.core import did_you_mean

# Command, or command and option, as they were -> what to call instead.
_NOW = {
    "calibrate": "softneck.calibrate(recordings).save(NECK.toml) in Python",
    "frf": "softneck.frequency_response(recordings) in Python",
    "linearize": "softneck.linearize(MODEL, at=S).to_mat(SS.mat) in Python",
    "resample": "softneck import REC --resample S -o REC2",
    "adapt": "softneck identify KIND REC --from MODEL -o MODEL2",
    "excite": "softneck record MODEL -o NEXT.csv (of a recording: identify guarded first)",
    "drives scan": "softneck drives commission --only scan",
    "drives zero": "softneck drives commission --only zero",
    "drives jog": "softneck drives commission --only jog --motor N",
    "drives replay": "softneck simulate LOG.mcap",
    "drives record --supervision": "softneck.drives.baseline(LOGS).save(FILE) in Python",
    "drives record --beside": "softneck.drives.baseline(LOGS).save(FILE) in Python",
    "drives record --runs": "play a longer signal, or a recording of several runs",
    "drives record --ramp": "it is 2 s",
    "drives record --max-speed": "[limits] of the drives file, or a recording of `softneck record` that is slower",
    "drives record --max-slack": "[limits] slack_unwind_rad of the drives file",
    "drives commission --neck": "[plant] neck of the robot file (--robot)",
    "drives commission --no-log": "--log none",
    "drives record --neck": "[plant] neck of the robot file (--robot)",
    "drives record --no-log": "--log none",
    "drives run --neck": "[plant] neck of the robot file (--robot)",
    "drives run --no-log": "--log none",
    "record --realisations": "it is 4",
    "record --no-noise": "softneck.record(signal, neck, noise=False) in Python",
    "record --ramp": "softneck.signals.prepare(signal, limits, ramp_s=S) in Python; `drives record` ramps by itself",
    "record --max-speed": "[motors] rate_limit of the robot file",
    "record --max-slack": "[motors] setpoint_min of the robot file",
    "validate --initial": "cold_fits of --json",
    "validate --training": "leave it out: `validity` says how far a model is beyond its training",
    "observer --sensor": "--set sensor=NAME",
    "observer --gyro": "--set form=gyro",
    "identify --search": "a loop over `identify KIND --set` and `validate`",
    "identify --refit": "softneck identify KIND REC --train 1",
    "identify --hold-out": "softneck validate MODEL --data REC",
    "identify --strategy": "a loop over `identify KIND --set` and `validate`",
    "identify --plot": "softneck validate MODEL --data REC --html PAGE.html",
    "demo --out": "-o",
    "design --mat": "softneck.load(CONTROLLER).to_mat(FILE) in Python",
    "doctor --compile": "softneck demo --quick",
    "report --no-run": "leave it out: loops are run",
    "fmu --all": "softneck fmu FOLDER",
    "study --dask": '`dask = "tcp://head:8786"` in the study file',
    "study --resume": "leave it out: the same command goes on where it was",
    "study --worst": "three are written; softneck.cosim.write_worst in Python",
    "tune --resume": "leave it out: the same command goes on where it was",
    "ssp": "softneck fmu LOOP.toml -o X.ssp",
    "completion": 'eval "$(_SOFTNECK_COMPLETE=bash_source softneck)" (or zsh_source, fish_source)',
    "robot show": "softneck robot FILE",
    "robot check": "softneck robot FILE",
}


def now(ctx: click.Context, name: str) -> str | None:
    """Return the replacement of the former command or option `name` of `ctx`; None if there was none."""
    return _NOW.get(" ".join([*ctx.command_path.split()[1:], name]))


class NearGroup(click.Group):
    """A group whose error on an unknown command names the new one of an old name, else the nearest one."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that `args` begin with, as click does."""
        name, known = args[0], self.list_commands(ctx)
        if not ctx.resilient_parsing and not name.startswith("-") and name not in known:
            if new := now(ctx, name):
                raise click.UsageError(f"there is no command `{name}` any more: {new}", ctx)
            hint = did_you_mean(name, known) or f"the commands are {', '.join(known)}."
            raise click.UsageError(f"no such command `{name}`; {hint.rstrip()}", ctx)
        return super().resolve_command(ctx, args)


def kinds_complete(role: str, *more: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """Return a completion function for the kinds of `role` and `more`."""

    def complete(_ctx: click.Context, _param: click.Parameter, begun: str) -> list[str]:
        return [name for name in (*core.kinds_of(role), *more) if name.startswith(begun)]

    return complete
