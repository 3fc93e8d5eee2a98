"""What `--set` takes is in the help of each kind, from the docstring of its settings alone."""

from __future__ import annotations

import dataclasses

import pytest

from softneck.cli.shared._options import meanings_in, settings_of
from softneck.core import KINDS, resolve
from softneck.core._kinds import kinds_of

from .conftest import Call

COMMANDS = {"identify": "model", "design": "controller"}


@pytest.mark.parametrize(("command", "kind"), [(c, kind) for c, role in COMMANDS.items() for kind in kinds_of(role)])
def test_help_of_a_kind_says_each_of_its_settings(call: Call, command: str, kind: str) -> None:
    said = call(command, kind, "--help")
    assert said.code == 0
    lines = said.out.partition(f"Settings of {kind} ")[2].partition("\n\n")[0].splitlines()
    settings = resolve(KINDS[kind].settings)
    for field in dataclasses.fields(settings):
        (line,) = (line for line in lines if line.startswith(f"  {field.name}="))
        # The least is what the shortest says, `order: of the loop`.
        assert len(" ".join(lines[lines.index(line) : lines.index(line) + 2]).split()) > 2, line
    assert all(meaning for _, _, meaning in settings_of(settings))


def test_help_takes_the_kind_on_either_side_and_without_one_lists_none(call: Call) -> None:
    assert call("design", "pi", "--help").out == call("design", "--help", "pi").out
    assert "Settings of" not in call("design", "--help").out
    assert "Settings of" not in call("identify", "pi", "--help").out
    assert "Settings of family" in call("family", "--help").out
    assert "Settings of kalman" in call("observer", "--help").out


def test_a_default_is_shown_as_set_takes_it(call: Call) -> None:
    said = call("identify", "rls", "--help").out
    assert all(f"  {shown} " in said for shown in ("delay=...", "forgetting=1", "structure=siso", "na=1"))


def test_a_kind_s_own_word_on_a_setting_goes_before_the_inherited_one() -> None:
    rows = {name: meaning for name, _, meaning in settings_of(resolve(KINDS["pi"].settings))}
    adaptive = {name: meaning for name, _, meaning in settings_of(resolve(KINDS["adaptive"].settings))}
    assert adaptive["max_sensitivity"] != rows["max_sensitivity"]
    assert adaptive["max_sensitivity"] == meanings_in(resolve(KINDS["adaptive"].settings).__doc__)["max_sensitivity"]
    assert rows["rise_s"].startswith("time [s] in which a step")


def test_a_meaning_ends_where_the_next_section_begins() -> None:
    doc = """What.

    Attributes:
        a, b: one [s],
            and more: of it.
        c: two.

    Raises:
        d: not a setting.
    """
    assert meanings_in(doc) == {"a": "one [s], and more: of it.", "b": "one [s], and more: of it.", "c": "two."}
