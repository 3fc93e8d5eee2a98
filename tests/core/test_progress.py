"""A bar is drawn in a terminal for what takes long, and nowhere else."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console
from rich.progress import Progress

from softneck.core import silent
from softneck.core._display import bar_columns, shown_progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def terminal_of(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Let errors go to a terminal; no fixture, since pytest sets `sys.stderr` once more before it calls a test."""
    made = Terminal()
    monkeypatch.setattr(sys, "stderr", made)
    monkeypatch.setenv("TERM", "xterm")
    return made


def later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let two seconds have passed."""
    monkeypatch.setattr("softneck.core._display._DELAY_S", -1.0)


def test_what_takes_long_has_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_of(monkeypatch)
    with shown_progress("identify nn", None) as tell:
        tell(0.1, "quick")
        assert terminal.getvalue() == ""
        later(monkeypatch)
    with shown_progress("identify nn", None) as tell:
        tell(0.5, "run[1].csv")
    assert "identify nn: run[1].csv" in terminal.getvalue()


def test_the_rest_takes_as_long_for_each_part_as_what_was_done_since_the_first() -> None:
    clock = [0.0]
    bar = Progress(*bar_columns(), get_time=lambda: clock[0], auto_refresh=False)
    task = bar.add_task("identify nn", total=1.0)
    for clock[0], done in ((30.0, 0.1), (40.0, 0.3), (50.0, 0.5)):  # 30 s before the first part, then 5 s a tenth
        bar.update(task, completed=done)
    shown = io.StringIO()
    Console(width=100, file=shown).print(bar)
    assert "0:00:50 0:00:25 left" in shown.getvalue()


@pytest.mark.parametrize("off", ["no terminal", "silent"])
def test_it_can_be_turned_off(monkeypatch: pytest.MonkeyPatch, off: str) -> None:
    terminal = terminal_of(monkeypatch)
    if off == "no terminal":
        monkeypatch.setattr(terminal, "isatty", lambda: False)
    later(monkeypatch)
    with shown_progress("study", silent if off == "silent" else None) as tell:
        tell(0.1, "a")
        tell(0.5, "b")
    assert tell is silent
    assert terminal.getvalue() == ""


def test_a_callback_of_ones_own_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_of(monkeypatch)
    told: list[tuple[float, str]] = []
    with shown_progress("verify", lambda done, word: told.append((done, word))) as tell:
        tell(0.5, "half")
    assert told == [(0.5, "half")]
    assert terminal.getvalue() == ""
