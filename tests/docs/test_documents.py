"""The runner of the pages reads them as they are meant, and fails when one breaks; `make documents` runs them all."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from softneck.cli._main import group
from tests.docs import run_documents
from tests.docs.run_documents import Block, PageError, commands, name_of, pages, read, require_few_fragments

SOUND = """# A page

```console
$ echo "1 2" > numbers.txt   # a remark
$ mkdir inner && cd inner
$ false   # exit code 1: that is what it is for
$ echo \\
  two lines > two.txt
```

```python
from pathlib import Path

numbers = [int(word) for word in Path("../numbers.txt").read_text().split()]
```

Words between.

```python
# twice.py
print(6)
```

```python
assert sum(numbers) * 2 == 6 and Path("two.txt").read_text() == "two lines\\n"
```

```toml
# deep/settings.toml
a = 1
```

```toml
shown = "only"
```

<!-- fragment: needs a robot -->
```console
$ no-such-command
```

```console
$ test "$(python twice.py)" = 6 && test -f deep/settings.toml   # exit code 1 if it is not
```
"""


def run(page: Path, text: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    page.write_text(text, encoding="utf-8")
    code = run_documents.main(["--python", sys.executable, "--page", str(page)])
    return code, capsys.readouterr().out


def test_a_page_that_does_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, said = run(tmp_path / "page.md", SOUND, capsys)
    assert code == 0, said
    assert "page.md (5 blocks)" in said


@pytest.mark.parametrize(
    ("sound", "broken", "message"),
    [
        ("$ false ", "$ true ", "page.md:6: exit code 0, not 1: true"),
        ("two.txt\n", "/no/such/two.txt\n", "page.md:7: exit code 1, not 0: echo"),
        ("sum(numbers)", "sum(number)", "NameError: name 'number' is not defined"),
        ("print(6)", "print(7)", "page.md:43: exit code 1, not 0: test"),
        ("<!-- fragment: needs a robot -->\n", "", "no-such-command: command not found"),
    ],
    ids=["exit code", "command", "Python", "file", "no fragment"],
)
def test_a_page_that_breaks(
    sound: str, broken: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = run(tmp_path / "page.md", SOUND.replace(sound, broken), capsys)
    assert code == 1
    assert message in said


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("```bash\nls\n```\n", "page.md:2: commands stand in a block `console`"),
        ("```text\nsoftneck info x.csv\n```\n", "page.md:2: commands stand in a block `console`"),
        ("```console\n$ ls\na.csv\n```\n", "page.md:3: not a command behind `\\$ `.*a.csv"),
    ],
    ids=["bash", "text", "output"],
)
def test_commands_that_would_not_be_run_are_refused(block: str, message: str, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(block, encoding="utf-8")
    with pytest.raises(PageError, match=message):
        read(page)


def test_a_sixth_fragment_is_refused() -> None:
    block = Block("console", "$ ls\n", 3, fragment="needs a robot")
    require_few_fragments({"a.md": [block] * 2, "b.md": [block] * 3})
    with pytest.raises(PageError, match=r"6 fragments.*\na\.md:3: needs a robot"):
        require_few_fragments({"a.md": [block] * 2, "b.md": [block] * 4})


def test_a_page_starts_with_nothing_of_the_tests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = run_documents.Reader("page.md", tmp_path / "page", Path(sys.executable)).environment()
    assert not {key for key in found if key.startswith(("PYTHON", "PYTEST"))}
    assert found["PATH"].split(os.pathsep)[1] == str(Path(sys.executable).parent)


def test_the_pages_can_be_run() -> None:
    require_few_fragments({name_of(page): read(page) for page in pages()})


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_commands_and_options_of_a_page_exist(page: Path) -> None:
    """What `make documents` tells in minutes, and fragments and nightly pages too. Other programs are not looked at."""
    for block in read(page):
        for number, text in commands(block, page.name) if block.language == "console" else ():
            typed = re.sub(r"\s#\s.*", "", text.replace("\\\n", " "))
            for words in map(shlex.split, re.split("&&|[;|]", typed)):
                if words[:1] != ["softneck"]:
                    continue
                command: click.Command = group
                rest = words[1:]
                while isinstance(command, click.Group) and rest:
                    # `robot` takes what names no command for the argument of FILE.
                    found = command.get_command(click.Context(command), rest[0]) or command.commands.get("FILE")
                    assert found is not None, f"{page.name}:{number}: no command {rest[0]}"
                    command, rest = found, rest[1:]
                known = {option for parameter in command.params for option in parameter.opts} | {"-h", "--help"}
                unknown = {word for word in rest if re.match("--?[a-z]", word)} - known
                assert not unknown, f"{page.name}:{number}: {text}"


def test_the_runner_needs_no_package() -> None:
    script = Path(run_documents.__file__)
    # -I -S: without site-packages.
    done = subprocess.run([sys.executable, "-I", "-S", script, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
