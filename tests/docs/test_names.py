"""What the pages name exists: modules and what is in them, commands with their options and settings, files, tests."""

from __future__ import annotations

import ast
import dataclasses
import re
import shlex
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import click
import pytest

from softneck.cli._main import group
from softneck.core import KINDS, resolve
from softneck.drives.logs._run_log import _SCHEMAS, METADATA

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
# The settings behind `--set` where no kind is named.
SETTINGS = {"observer": "kalman", "family": "family"}


def of_all_pages(pattern: str) -> list[tuple[str, str]]:
    """Return page and text of each match, without repeats."""
    found = {
        (str(page.relative_to(ROOT)), match[1]): None
        for page in PAGES
        for match in re.finditer(pattern, page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    }
    return list(found)


def resolves(dotted: str) -> bool:
    """Return whether a dotted name is a module, or something in one."""
    parts = dotted.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            value = import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for name in parts[cut:]:
            if not hasattr(value, name):
                return False
            value = getattr(value, name)
        return len(parts) > 1
    return False


def test_every_dotted_name_is_there() -> None:
    names = of_all_pages(r"\b(softneck(?:\.[A-Za-z_][A-Za-z0-9_]*)+)")
    assert len(names) > 50
    # Names inside a log, not in Python.
    names = [item for item in names if item[1] not in {METADATA, *_SCHEMAS}]
    assert [item for item in names if not resolves(item[1])] == []


def imports(page: Path) -> Iterator[tuple[str, str]]:
    """Yield module and name of what the page's Python imports from softneck."""
    for block in re.findall(
        r"^```(?:python|py)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("softneck"):
                yield from ((node.module, alias.name) for alias in node.names)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_python_on_a_page_imports_is_there(page: Path) -> None:
    assert [f"{module}.{name}" for module, name in imports(page) if not resolves(f"{module}.{name}")] == []


def commands() -> list[tuple[str, str]]:
    """Return page and arguments of every command line, in blocks and in sentences."""
    found = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        blocks = re.findall(r"^ *```\w*\n(.*?)^ *```$", text, re.MULTILINE | re.DOTALL)
        lines = [
            line for block in blocks for line in re.findall(r"(?:^ *\$? ?|: |&& )softneck ([a-z-][^#\n]*)", block, re.M)
        ]
        spoken = re.findall(r"`softneck ([a-z-][^`#\n]*)`", text)
        found |= {(str(page.relative_to(ROOT)), line): None for line in (*lines, *spoken)}
    return list(found)


def wrong(line: str) -> str | None:
    """Return what of a command line does not exist, None where all does."""
    words = shlex.split(line.replace("[", "").replace("]", ""), posix=True)
    command: click.Command = group
    context = click.Context(group)
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        if command.name == "robot" and words[0] != "new":
            words.insert(0, "FILE")
        names = words.pop(0).split("|")
        found = {name: command.get_command(context, name) for name in names}
        if missing := [name for name, value in found.items() if value is None]:
            return f"no command {missing[0]}"
        command = found[names[-1]] or command
    options = {"--help", "-h", "--version"} | {
        name for item in command.params for name in (*item.opts, *item.secondary_opts)
    }
    for word in words:
        for name in word.split("|"):
            if name.startswith("-") and len(name) > 1 and name.split("=")[0] not in options:
                return f"no option {name}"
    return wrong_setting(line.split()[0], words)


def wrong_setting(command: str, words: list[str]) -> str | None:
    """Return what `--set` names that the kind does not have."""
    kind = SETTINGS.get(command) or (words[0] if words else "")
    if kind not in KINDS:
        return None
    for option, word in pairwise(words):
        key = word.partition("=")[0]
        if option == "--set" and key.islower() and not {key, key.removesuffix("_deg")} & fields(kind):
            return f"{kind} has no setting {key}"
    return None


@cache
def fields(kind: str) -> set[str]:
    """Return the names of a kind's settings."""
    return {field.name for field in dataclasses.fields(resolve(KINDS[kind].settings))}


def test_every_command_line_has_its_command_options_and_settings() -> None:
    lines = commands()
    assert len(lines) > 100
    assert [(page, line, why) for page, line in lines if (why := wrong(line.rstrip(" \\)"))) is not None] == []


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("desing pi rls.npz", "no command desing"),
        ("design pi rls.npz --ouput x", "no option --ouput"),
        ("design pi rls.npz --set slew=3", "pi has no setting slew"),
        ("drives stop|chek", "no command chek"),
        ("observer rls.npz --set gamma=1", "kalman has no setting gamma"),
        ("design pi rls.npz -o pi.npz --set phase_margin_deg=50", None),
    ],
)
def test_what_is_not_there_is_found(line: str, why: str | None) -> None:
    assert wrong(line) == why


def test_every_file_of_the_source_tree_that_a_page_names_is_there() -> None:
    named = of_all_pages(r"(?<!/)\b((?:tests|benchmarks|examples|softneck|design|identification|fmu_src)/[\w./-]*\w)")
    assert len(named) > 20
    # What was tried and left is named there by its old place.
    assert [item for item in named if not (ROOT / item[1]).exists() and "tried" not in str(item[0])] == []


def test_every_test_that_a_page_names_is_there() -> None:
    named = of_all_pages(r"`(test_\w+)`")
    text = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    known = set(re.findall(r"^\s*def (test_\w+)", text, re.MULTILINE))
    assert [item for item in named if item[1] not in known] == []


def test_every_target_of_make_that_a_page_names_is_there() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert [item for item in of_all_pages(r"`make ([\w-]+)") if item[1] not in targets] == []


def test_every_page_that_a_page_links_to_is_there() -> None:
    for page in PAGES:
        for link in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
            if "://" not in link:
                assert (page.parent / link).exists(), f"{page.relative_to(ROOT)}: {link}"
