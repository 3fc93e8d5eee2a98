"""A bar is drawn in a terminal for what takes long, and nowhere else."""

from __future__ import annotations

import io
import sys

import pytest

from softneck.core import silent
from softneck.core._display import shown_progress, time_left


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


@pytest.mark.parametrize(
    ("done", "elapsed", "said"),
    [(0.5, 10.0, "0:00:10 left"), (0.25, 1800.0, "1:30:00 left"), (0.75, 300.0, "0:01:40 left"), (1.0, 10.0, ""),
     (0.05, 10.0, "0:03:10 left"), (0.04, 10.0, ""), (0.5, 2.0, "0:00:02 left"), (0.5, 1.9, "")],
)  # fmt: skip
def test_the_rest_takes_as_long_for_each_part_as_what_is_done(done: float, elapsed: float, said: str) -> None:
    assert time_left(done, elapsed) == said


@pytest.mark.parametrize("off", ["no terminal", "variable", "silent"])
def test_it_can_be_turned_off(monkeypatch: pytest.MonkeyPatch, off: str) -> None:
    terminal = terminal_of(monkeypatch)
    if off == "no terminal":
        monkeypatch.setattr(terminal, "isatty", lambda: False)
    if off == "variable":
        monkeypatch.setenv("SOFTNECK_PROGRESS", "0")
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
