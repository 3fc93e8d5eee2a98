"""softneck completion: the script by which a shell completes our commands and options."""

from __future__ import annotations

import click
from click.shell_completion import BashComplete, FishComplete, ZshComplete

from ._console import print_json
from ._options import json_option

_SHELLS = {"bash": BashComplete, "zsh": ZshComplete, "fish": FishComplete}


@click.command("completion", epilog="Example: softneck completion bash >> ~/.bashrc")
@click.argument("shell", type=click.Choice(list(_SHELLS)))
@json_option
@click.pass_context
def command(ctx: click.Context, shell: str, as_json: bool) -> None:
    """Print the script that makes SHELL complete commands, options and kinds.

    \b
    bash   softneck completion bash >> ~/.bashrc
    zsh    softneck completion zsh >> ~/.zshrc
    fish   softneck completion fish > ~/.config/fish/completions/softneck.fish
    """
    complete = _SHELLS[shell](ctx.find_root().command, {}, "softneck", "_SOFTNECK_COMPLETE")
    # Not `source()`, which starts a bash to ask for its version.
    script = complete.source_template % complete.source_vars()
    if as_json:
        print_json({"shell": shell, "script": script})
        return
    click.echo(script)
