"""Names of the command line that were, and what does the same now."""

from __future__ import annotations

import click

# Command, or command and option, as they were -> what to call instead.
_NOW = {
    "calibrate": "softneck.calibrate(recordings).save(NECK.toml) in Python",
    "frf": "softneck.frequency_response(recordings) in Python",
    "linearize": "softneck.linearize(MODEL, at=S).to_mat(SS.mat) in Python",
    "resample": "softneck import REC --resample S -o REC2",
    "adapt": "softneck identify KIND REC --from MODEL -o MODEL2",
    "excite": "softneck record MODEL -o NEXT.csv (of a recording: identify guarded first)",
    "ssp": "softneck fmu LOOP.toml -o X.ssp",
    "completion": 'eval "$(_SOFTNECK_COMPLETE=bash_source softneck)" (or zsh_source, fish_source)',
    "robot show": "softneck robot FILE",
    "robot check": "softneck robot FILE",
}


def now(ctx: click.Context, name: str) -> str | None:
    """Return what does now what command or option `name` did in the command of `ctx`; None where there was none."""
    return _NOW.get(" ".join([*ctx.command_path.split()[1:], name]))
