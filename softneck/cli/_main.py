"""The group of all subcommands, and the one place where errors become a line and an exit code."""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import logging
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from importlib import import_module

import click

from softneck import __version__
from softneck.core import SoftneckError, missing_extra

from .shared._groups import NearGroup, now

# Subcommand -> module, with the command's name where it is not `command`, and what it does; imported when called, so
# that `softneck --help` answers at once.
_COMMANDS = {
    "start": ("start._start", "Go from a log to a verdict in one command, each step a plain command."),
    "demo": ("_projects:demo", "Run the main job: experiment, models, FMUs, controller, closed loop, report."),
    "doctor": ("_doctor", "Say which parts of this machine work."),
    "info": ("_info", "Say what a file is."),
    "robot": ("_robot", "Show and check a robot.toml, or start one."),
    "record": ("_record", "Record a signal on the virtual neck, or design what to record next."),
    "import": ("_import", "Turn any logger's table into a recording, or bring one to another sample time."),
    "identify": ("_identify", "Identify a model from recordings."),
    "validate": ("_validate", "Validate models on rows that they were not trained on."),
    "reproduce-paper": ("_projects:paper", "Reproduce the paper on the virtual neck, our numbers beside its own."),
    "family": ("_family", "Fit an uncertain linear plant over inclinations and payloads."),
    "fmu": ("_fmu", "Package models, observers, controllers, necks as FMUs, a loop as an SSP file."),
    "observer": ("_design:observer_command", "Build a Kalman filter over a linear model."),
    "design": ("_design", "Design a controller on a linear model."),
    "tune": ("_tune", "Search kinds and settings for the controller that keeps requirements."),
    "verify": ("_verify", "Verify a controller against requirements, or fail loudly."),
    "simulate": ("_simulate", "Close the loop that a TOML file describes and judge it; replay the log of a run."),
    "study": ("_simulate:study_command", "Run a loop many times over what varies: ranking, Pareto front, worst cases."),
    "drives": ("drives._commands", "Run controllers on CANopen drives, or on simulated ones."),
    "report": ("_projects:report", "Write one page on a whole project: data, models, certificates, loops, studies."),
    "new": ("_projects:new", "Start a project whose closed-loop test passes at once."),
}
_INTERRUPTED, _BAD_INPUT, _OUR_FAULT = 130, 2, 3


class _LazyGroup(NearGroup):
    """A group whose subcommands are imported on demand."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the work."""
        del ctx
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return one subcommand."""
        del ctx
        entry = _COMMANDS.get(cmd_name)
        module, _, name = entry[0].partition(":") if entry else ("", "", "")
        return getattr(import_module(f"softneck.cli.{module}"), name or "command") if module else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List all subcommands without importing them."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="softneck")
def group() -> None:
    """From a logged experiment on a tendon-driven soft robotic neck to a verified controller.

    \b
    Exit codes: 0 done, 1 a check that did not hold, 2 bad input, 3 an internal error, 130 Ctrl-C.
    """


# Products of our small matrices end sooner than threads wake up: these only wait for each other. Networks are trained
# with one thread of their own anyway.
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Compiling makes millions of objects that stay: to look for unused ones after each 700, as Python does, took 8 % of its
# time. With these 5 MB more are in use.
GARBAGE_THRESHOLDS = (50_000, 20, 50)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    for name in _BLAS_THREADS:  # read where numpy is imported, which no command has done yet
        os.environ.setdefault(name, "1")
    gc.set_threshold(*GARBAGE_THRESHOLDS)
    code = run(arguments)
    atexit.register(_ignore_signals)
    # Python looks for unused objects while it ends, which took a second after `start`; with the process all go.
    atexit.register(gc.freeze)
    sys.exit(code)


def _ignore_signals() -> None:
    """Let no signal change the exit code while the interpreter ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code; an error is one line on stderr."""
    try:
        with _without_remarks(), _saying_which_robot():
            code = group.main(args=arguments, prog_name="softneck", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return _BAD_INPUT
    except click.NoSuchOption as error:
        new = None if error.ctx is None else now(error.ctx, error.option_name)
        told = error.format_message() if new is None else f"there is no option {error.option_name} any more: {new}"
        return _fail(told, _BAD_INPUT)
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
    except ModuleNotFoundError as error:  # an extra that is not installed; any other is an internal error
        line = missing_extra(error)
        return _internal(error) if line is None else _fail(line, _BAD_INPUT)
    except OSError as error:
        return _fail(f"{error.filename or 'input/output'}: {error.strerror or error}", _BAD_INPUT)
    except Exception as error:  # the outermost frame: everything unforeseen is an internal error
        return _internal(error)
    return code if isinstance(code, int) else 0


@contextlib.contextmanager
def _without_remarks() -> Iterator[None]:
    """Suppress the warnings of libraries; softneck reports what matters itself."""
    with warnings.catch_warnings():
        if not os.environ.get("SOFTNECK_TRACEBACK"):
            warnings.showwarning = lambda *_, **__: None
        yield


@contextlib.contextmanager
def _saying_which_robot() -> Iterator[None]:
    """Print the robot file that was found and is applied without an option naming it."""
    said = functools.cache(functools.partial(click.echo, err=True))  # each line once

    def tell(record: logging.LogRecord) -> bool:
        said(record.getMessage())
        return False  # there is no more to do with it

    log, heard = logging.getLogger("softneck.robot"), logging.Handler()
    heard.addFilter(tell)
    log.addHandler(heard)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(heard)


def _internal(error: Exception) -> int:
    if os.environ.get("SOFTNECK_TRACEBACK"):
        traceback.print_exception(error)
    return _fail(
        f"internal error in softneck: {type(error).__name__}: {error} "
        "(set SOFTNECK_TRACEBACK=1 and report what it prints)",
        _OUR_FAULT,
    )


def _fail(message: str, code: int) -> int:
    click.echo("softneck: " + " ".join(message.split()), err=True)
    return code
