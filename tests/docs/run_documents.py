"""Run the pages as a reader would: each in a fresh folder, its blocks in order, with what README installs.

`make documents` makes that environment and runs them; `python tests/docs/run_documents.py --python PYTHON` takes one.
It needs only the standard library, so any Python can start it.

In a page,

- a block `console` holds commands, each behind `$ `, and no output. bash runs them one by one; a `cd` stays. A command
  ends with exit code 0, or with N where its comment says `# exit code N` (and no "if").
- a block `python` whose first line is `# NAME.py` is written to that file. Any other is run, all in one interpreter.
- a block `toml` or `yaml` whose first line is `# NAME.toml` is written to that file. Without a name it is only shown.
- `pip install` installs into a folder of the page's own: other pages do not see it.
- `<!-- fragment: why -->` before a block leaves it out. At most five blocks of all pages may have one.
- `<!-- documents: nightly -->` on a page leaves it to `--nightly`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).parents[2]
MAX_FRAGMENTS = 5
TIME_LIMIT_S = 1200.0
SHOWN_LINES = 40

_BLOCK = re.compile(r"^(?P<indent> *)```(?P<language>[\w-]+)\n(?P<text>.*?)^ *```$", flags=re.MULTILINE | re.DOTALL)
_FRAGMENT = re.compile(r"<!-- fragment: (.+?) -->\s*\Z", flags=re.DOTALL)
_NIGHTLY = "<!-- documents: nightly -->"
_NAMED = re.compile(r"# ([\w./-]+\.\w+)\n")
_EXIT_CODE = re.compile(r"#.*\bexit code (\d+)\b(?!.*\bif\b)")
_LOOKS_LIKE_COMMANDS = re.compile(r"^(\$ |softneck |python |pytest |make |pip )", flags=re.MULTILINE)

# Runs the blocks of a page in one namespace. It reads [folder, name, code] and answers with one line when it is done.
_INTERPRETER = """
import json, linecache, os, sys, traceback
names = {"__name__": "__main__"}
answers = os.fdopen(int(sys.argv[1]), "w")
for line in sys.stdin:
    folder, name, code = json.loads(line)
    os.chdir(folder)
    sys.path[0] = folder
    linecache.cache[name] = (len(code), None, code.splitlines(True), name)
    try:
        exec(compile(code, name, "exec"), names)
    except BaseException:
        traceback.print_exc()
        answers.write("failed\\n")
    else:
        answers.write("ok\\n")
    sys.stdout.flush()
    answers.flush()
"""


class PageError(Exception):
    """A page that is written in a way which cannot be run."""


class BlockError(Exception):
    """A block that did not do what the page says."""


@dataclass(frozen=True)
class Block:
    """One code block of a page; `line` is that of its first line of code."""

    language: str
    text: str
    line: int
    fragment: str = ""

    @property
    def file(self) -> str:
        """Name of the file that the block is, or nothing."""
        named = _NAMED.match(self.text)
        return named[1] if named and self.language in ("python", "toml", "yaml") else ""


@dataclass
class Outcome:
    """What running a page came to."""

    page: str
    blocks: int = 0
    seconds: float = 0.0
    processor_seconds: float = 0.0
    problem: str = ""
    steps: list[str] = field(default_factory=list)


def pages(root: Path = ROOT) -> list[Path]:
    """Return all pages in the order in which a newcomer reads them."""
    docs = root / "docs"
    return [
        root / "README.md",
        docs / "quickstart.md",
        *sorted((docs / "tutorials").glob("*.md")),
        *sorted((docs / "howto").glob("*.md")),
    ]


def read(page: Path) -> list[Block]:
    """Return the blocks of a page, fragments among them; raise `PageError` where one cannot be run as it is written."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _BLOCK.finditer(text):
        line = text.count("\n", 0, match.start()) + 2
        code = textwrap.dedent(match["text"])
        fragment = _FRAGMENT.search(text, 0, match.start())
        language = match["language"]
        where = f"{page.name}:{line}"
        if language in ("bash", "sh", "shell") or (language == "text" and _LOOKS_LIKE_COMMANDS.search(code)):
            raise PageError(f"{where}: commands stand in a block `console`, each behind `$ `")
        block = Block(language, code, line, " ".join(fragment[1].split()) if fragment else "")
        if language == "console" and not block.fragment:
            list(commands(block, page.name))
        found.append(block)
    return found


def commands(block: Block, page: str) -> Iterator[tuple[int, str]]:
    """Yield line number and text of each command of a block `console`."""
    lines = iter(enumerate(block.text.splitlines(), block.line))
    for number, line in lines:
        if not line.strip():
            continue
        if not line.startswith("$ "):
            raise PageError(f"{page}:{number}: not a command behind `$ `; output stands in a block `text`: {line}")
        command = line.removeprefix("$ ")
        while command.endswith("\\"):
            command += "\n" + next(lines, (0, ""))[1]
        yield number, command


def require_few_fragments(found: dict[str, list[Block]]) -> None:
    """Raise `PageError` if the pages together have more fragments than they may."""
    fragments = [f"{page}:{b.line}: {b.fragment}" for page, blocks in found.items() for b in blocks if b.fragment]
    if len(fragments) > MAX_FRAGMENTS:
        raise PageError("\n".join([f"{len(fragments)} fragments, at most {MAX_FRAGMENTS}:", *fragments]))


class Reader:
    """A reader of one page: a folder, an environment, and a Python that stays open."""

    def __init__(self, page: str, folder: Path, python: Path) -> None:
        self.page = page
        self.folder = folder
        self.python = python
        self.packages = folder.parent / f"{folder.name}.packages"
        self.processor_seconds = 0.0
        self.steps: list[str] = []  # with the seconds that each took
        self._log = folder.parent / f"{folder.name}.log"
        self._interpreter: subprocess.Popen[str] | None = None
        self._answers: IO[str] | None = None

    def environment(self) -> dict[str, str]:
        """Return what the page's processes find in their environment: nothing of the developer's Python."""
        kept = {
            k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "SOFTNECK_", "PYTEST"))
        }
        folders = [
            str(self.packages / "bin"),
            str(self.python.parent),
            "/usr/local/bin",
            "/usr/bin",
            "/bin",
            "/usr/sbin",
            "/sbin",
        ]
        found = {"PYTHONPATH": str(self.packages)} if self.packages.is_dir() else {}
        return {
            **kept,
            **found,
            "PATH": os.pathsep.join(folders),
            "MPLBACKEND": "Agg",  # no window opens where there is a screen
            "PIP_TARGET": str(self.packages),
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        }

    def run(self, block: Block) -> None:
        """Do with a block what a reader does."""
        if block.file:
            file = self.folder / block.file
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(block.text, encoding="utf-8")
        elif block.language == "console":
            for line, text in commands(block, self.page):
                self.command(line, text)
        elif block.language == "python":
            self.python_block(block)

    def command(self, line: int, text: str) -> None:
        """Run one command in bash, and stay in the folder that it leads to."""
        told = self._log.with_suffix(".cwd")
        # However the command ends, its shell says where it was then.
        script = f"trap 'pwd > \"{told}\"' EXIT\n{text}\n"
        with self._log.open("wb") as log:
            process = subprocess.Popen(
                ["bash", "-c", script],
                cwd=self.folder,
                env=self.environment(),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # so that what it leaves behind can be ended
            )
        started = time.monotonic()
        code = self._wait(process)
        self.steps.append(f"       {time.monotonic() - started:5.1f} s  {line}: {text}")
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        expected = _EXIT_CODE.search(text)
        wanted = int(expected[1]) if expected else 0
        if code != wanted:
            raise BlockError(self._failure(line, f"exit code {code}, not {wanted}: {text}"))
        self.folder = Path(told.read_text(encoding="utf-8").strip())

    def python_block(self, block: Block) -> None:
        """Run a block in the page's Python."""
        if self._interpreter is None:
            self._start_python()
        assert self._interpreter is not None
        assert self._interpreter.stdin is not None
        assert self._answers is not None
        os.truncate(self._log, 0)
        limit = threading.Timer(TIME_LIMIT_S, self._interpreter.kill)
        limit.start()
        self._interpreter.stdin.write(json.dumps([str(self.folder), f"{self.page}:{block.line}", block.text]) + "\n")
        self._interpreter.stdin.flush()
        started = time.monotonic()
        answer = self._answers.readline().strip()
        self.steps.append(f"       {time.monotonic() - started:5.1f} s  {block.line}: Python")
        limit.cancel()
        if answer != "ok":
            raise BlockError(self._failure(block.line, f"Python block: {answer or 'Python ended'}"))

    def _start_python(self) -> None:
        reading, writing = os.pipe()
        with self._log.open("ab") as log:
            self._interpreter = subprocess.Popen(
                [str(self.python), "-c", _INTERPRETER, str(writing)],
                env=self.environment(),
                cwd=self.folder,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                pass_fds=(writing,),
                text=True,
            )
        os.close(writing)
        self._answers = os.fdopen(reading)

    def _wait(self, process: subprocess.Popen[Any]) -> int:
        """Return the exit code, and add up the processor time of all that the process has waited for."""
        limit = threading.Timer(TIME_LIMIT_S, process.kill)
        limit.start()
        _, status, used = os.wait4(process.pid, 0)
        limit.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        self.processor_seconds += used.ru_utime + used.ru_stime
        return process.returncode

    def close(self) -> None:
        """End the page's Python."""
        if self._interpreter is not None and self._interpreter.stdin is not None and self._answers is not None:
            with contextlib.suppress(BrokenPipeError):
                self._interpreter.stdin.close()
            self._wait(self._interpreter)
            self._answers.close()

    def _failure(self, line: int, what: str) -> str:
        output = self._log.read_text(encoding="utf-8", errors="replace").splitlines()[-SHOWN_LINES:]
        return "\n".join([f"{self.page}:{line}: {what}", *("    " + text for text in output)])


def run_page(page: Path, python: Path, parent: Path) -> Outcome:
    """Run all blocks of a page up to the first that fails."""
    name = name_of(page)
    folder = parent / name.removesuffix(".md").replace("/", "-")
    folder.mkdir(parents=True)
    outcome = Outcome(name)
    reader = Reader(name, folder, python)
    started = time.monotonic()
    try:
        for block in read(page):
            if block.fragment:
                continue
            reader.run(block)
            outcome.blocks += runs(block)
    except (PageError, BlockError) as problem:
        outcome.problem = str(problem)
    finally:
        reader.close()
    outcome.seconds = time.monotonic() - started
    outcome.processor_seconds = reader.processor_seconds
    outcome.steps = reader.steps
    return outcome


def name_of(page: Path) -> str:
    """Return a page's path in the checkout, or its name if it lies elsewhere."""
    return page.relative_to(ROOT).as_posix() if page.is_relative_to(ROOT) else page.name


def main(arguments: list[str] | None = None) -> int:
    """Run the pages; return 1 if one breaks."""
    parser = argparse.ArgumentParser(description="Run the blocks of the pages as a reader would.")
    parser.add_argument("--python", type=Path, required=True, help="the Python of the environment that README installs")
    parser.add_argument("--page", type=Path, action="append", help="run only this page (again for more)")
    parser.add_argument("--jobs", type=int, default=1, help="pages at a time")
    parser.add_argument("--nightly", action="store_true", help="only the pages that are marked as nightly")
    parser.add_argument("--keep", type=Path, help="a folder for what the pages leave behind; it must not exist")
    parser.add_argument("--verbose", action="store_true", help="the seconds of each block too")
    options = parser.parse_args(arguments)
    python = options.python.absolute()  # not resolved: a link in an environment is how Python finds its packages

    try:
        found = {page: read(page) for page in map(Path.resolve, options.page or pages())}
        require_few_fragments({name_of(page): blocks for page, blocks in found.items()})
    except PageError as problem:
        print(problem)
        return 1
    chosen = [
        page
        for page, blocks in found.items()
        if any(runs(block) for block in blocks)
        and (options.page or (_NIGHTLY in page.read_text(encoding="utf-8")) == options.nightly)
    ]

    broken = 0
    with contextlib.ExitStack() as stack:
        parent = (options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))).resolve()
        pool = stack.enter_context(ThreadPoolExecutor(options.jobs))
        for outcome in pool.map(lambda page: run_page(page, python, parent), chosen):
            broken += bool(outcome.problem)
            verdict = "FAILED" if outcome.problem else "ok"
            times = f"{outcome.seconds:5.0f} s {outcome.processor_seconds:5.0f} s of processor"
            print(f"{verdict:6} {times}  {outcome.page} ({outcome.blocks} blocks)")
            if options.verbose:
                print(*outcome.steps, sep="\n")
            if outcome.problem:
                print(outcome.problem)
            sys.stdout.flush()
    print(f"{len(chosen)} pages, {broken} broken")
    return bool(broken)


def runs(block: Block) -> bool:
    """Whether the block does something, and is not only a file or a picture of one."""
    return block.language in ("console", "python") and not block.fragment


if __name__ == "__main__":
    sys.exit(main())
