"""The group of all subcommands, and the one place where errors become a line and an exit code."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module, metadata

import click

from softneck.core import SoftneckError

# Subcommand -> module; each is imported when it is called, so that `softneck --help` answers at once.
_COMMANDS = {
    "demo": "_demo",
    "doctor": "_doctor",
    "info": "_info",
    "record": "_record",
    "import": "_import",
    "identify": "_identify",
    "validate": "_validate",
    "fmu": "_fmu",
    "observer": "_observer",
    "design": "_design",
    "simulate": "_simulate",
}
_INTERRUPTED, _BAD_INPUT, _OUR_FAULT = 130, 2, 3


class _LazyGroup(click.Group):
    """A group whose subcommands are imported on demand."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the work."""
        del ctx
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return one subcommand."""
        del ctx
        module = _COMMANDS.get(cmd_name)
        return import_module(f"softneck.cli.{module}").command if module else None


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(metadata.version("softneck"), prog_name="softneck")
def group() -> None:
    """From a logged experiment on a tendon-driven soft robotic neck to a verified controller.

    \b
    Exit codes: 0 done, 1 a check that did not hold, 2 bad input, 3 a fault of ours, 130 Ctrl-C.
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    sys.exit(run(arguments))


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code; an error is one line on stderr."""
    try:
        code = group.main(args=arguments, prog_name="softneck", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return _BAD_INPUT
    except click.ClickException as error:
        return _fail(error.format_message(), _BAD_INPUT)
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted; files already finished are kept, none is half written", _INTERRUPTED)
    except SoftneckError as error:
        return _fail(str(error), error.exit_code)
    except BrokenPipeError:
        # The reader of a pipe went away: no error of the user's.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        return _fail(f"{error.filename or 'input/output'}: {error.strerror or error}", _BAD_INPUT)
    except Exception as error:  # the edge: anything unforeseen is our fault, and says so
        if os.environ.get("SOFTNECK_TRACEBACK"):
            traceback.print_exc()
        return _fail(
            f"a fault of softneck, not of yours: {type(error).__name__}: {error} "
            "(set SOFTNECK_TRACEBACK=1 and report what it prints)",
            _OUR_FAULT,
        )
    return code if isinstance(code, int) else 0


def _fail(message: str, code: int) -> int:
    click.echo("softneck: " + " ".join(message.split()), err=True)
    return code
