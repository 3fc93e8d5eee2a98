"""Change one thing in the source at a time and see whether a test fails: `make mutate`.

The mutants are cosmic-ray's: its operators, applied at every place of an area's files, of which a seeded sample is
tried. Cosmic-ray's own runner starts an interpreter for each mutant, which takes longer than most tests here; this one
forks from a process that has numpy, scipy and numba already. Nothing of the tree that it is started in is touched: it
works in a copy.

    python tests/mutation/run.py [AREA ...] [--count 40] [--seed SEED] [--out build/mutation.json] [--again FILE]

Without a seed a new one is drawn and printed: tests that were written against one sample say little about the next.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import tomllib
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
# What tests import and no mutant changes: imported once, before the first fork.
HEAVY = ("numpy", "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.stats", "control", "numba",
         "pytest", "fmpy", "pandas", "jinja2", "click", "rich")  # fmt: skip
# Tests that take this many times as long as without a mutant hang, which is noticed; never before so many seconds.
PATIENCE, LEAST = 5.0, 60.0
OUTCOMES = ("killed", "hung", "survived", "equivalent")


@dataclass(frozen=True)
class Area:
    """Files whose mutants must die, and the tests that should kill them, the fastest first."""

    name: str
    files: tuple[str, ...]
    tests: tuple[str, ...]


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    path: str
    operator: str
    arguments: dict[str, Any]
    occurrence: int
    line: int


@dataclass(frozen=True)
class Outcome:
    """What came of a mutant: "killed", "hung", "survived", or "equivalent" where `areas.toml` says so."""

    mutant: Mutant
    outcome: str
    seconds: float
    diff: str


def read_areas(path: Path = HERE / "areas.toml") -> tuple[dict[str, Area], dict[str, Any]]:
    """Return name -> area, and the rest of the settings."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    areas = {name: Area(name, tuple(part["files"]), tuple(part["tests"])) for name, part in table.pop("areas").items()}
    return areas, table


def cosmic_ray(name: str) -> Any:
    """Return one of its modules; it is installed by `make mutate` alone."""
    return importlib.import_module(f"cosmic_ray.{name}")


def operator_of(name: str) -> Any:
    """Return an operator: one of ours beside this file, or one of cosmic-ray's."""
    own = importlib.import_module("operators").OWN
    return own.get(name) or cosmic_ray("plugins").get_operator(f"core/{name}")


def mutants_of(root: Path, area: Area, settings: dict[str, Any]) -> Iterator[Mutant]:
    """Yield every mutant of an area, in the order of files, operators and places."""
    ast = cosmic_ray("ast")
    files = sorted({path for pattern in area.files for path in root.glob(pattern)})
    if not files:
        raise SystemExit(f"area {area.name}: no file fits {area.files}")
    for path in files:
        tree = ast.get_ast_from_path(path)
        lines = path.read_text(encoding="utf-8").splitlines()
        for name in settings["operators"]:
            operator = operator_of(name)()
            places = [start for node in ast.ast_nodes(tree) for start, _ in operator.mutation_positions(node)]
            for occurrence, (line, column) in enumerate(places):
                before = lines[line - 1][:column].rstrip()
                # A star that opens a signature or unpacks is no product, though cosmic-ray takes it for one.
                star = lines[line - 1][column : column + 1] in ("*", "/") and (not before or before[-1] in "(,[{")
                words = () if name == "NotRaised" else settings["skip_lines_with"]
                # What guards against our own slips: `strict=` of equally long lists, flags of dataclasses.
                guard = before.endswith("strict=") or before.startswith("@dataclass(")
                if star or guard or any(word in lines[line - 1] for word in words):
                    continue
                yield Mutant(str(path.relative_to(root)), name, {}, occurrence, line)


def sample(mutants: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """Return `count` of them: a line, then an operator, then a place, so that nothing crowded takes the sample."""
    generator = random.Random(seed)
    by_line: dict[tuple[str, int], dict[str, list[Mutant]]] = {}
    for mutant in mutants:
        by_line.setdefault((mutant.path, mutant.line), {}).setdefault(mutant.operator, []).append(mutant)
    keys = sorted(by_line)
    generator.shuffle(keys)
    chosen = (generator.choice(list(by_line[key].values())) for key in keys[:count])
    return [generator.choice(places) for places in chosen]


def mutated(root: Path, mutant: Mutant) -> tuple[str, str]:
    """Return the file's text before and after."""
    mutate_code = cosmic_ray("mutating").mutate_code
    before = (root / mutant.path).read_text(encoding="utf-8")
    after = mutate_code(before, operator_of(mutant.operator)(**mutant.arguments), mutant.occurrence)
    if after is None:
        raise SystemExit(f"{mutant} does not change anything")
    return before, after


def run_tests(root: Path, tests: tuple[str, ...], log: Path, patience: float) -> int | None:
    """Run `tests` in a child; return pytest's exit code, negative where it crashed, None after `patience` [s]."""
    child = os.fork()
    if child == 0:
        _child(root, tests, log)
    until = time.monotonic() + patience
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    # Its own process group: what the tests started goes with it.
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def _child(root: Path, tests: tuple[str, ...], log: Path) -> None:
    import pytest

    code = 3
    try:
        os.setpgid(0, 0)
        os.chdir(root)
        sys.path.insert(0, str(root))
        os.environ["PYTHONPATH"] = str(root)
        sink = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        # Hypothesis draws the same examples for every mutant, and looks for no smaller ones.
        options = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:randomly", "--tb=line", "-m", "not slow"]
        code = int(pytest.main([*options, "--hypothesis-seed=0", *tests]))
    except BaseException:  # Nothing may return into the parent's loop.
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def try_mutant(root: Path, area: Area, mutant: Mutant, equivalent: list[dict[str, str]], patience: float) -> Outcome:
    """Apply a mutant in the copy, run the area's tests, put the file back."""
    path = root / mutant.path
    before, after = mutated(root, mutant)
    diff = "".join(difflib.unified_diff(before.splitlines(True), after.splitlines(True), mutant.path, mutant.path, n=0))
    begin = time.monotonic()
    _write(path, after)
    try:
        code = run_tests(root, area.tests, root / "mutation.log", patience)
    finally:
        _write(path, before)
    if code == 5:
        raise SystemExit(f"area {area.name} has no tests")
    outcome = "hung" if code is None else "survived" if code == 0 else "killed"
    changed = {line[1:].strip() for line in diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")}
    if outcome == "survived" and any(item["file"] == mutant.path and item["line"] in changed for item in equivalent):
        outcome = "equivalent"
    return Outcome(mutant, outcome, time.monotonic() - begin, diff)


def _write(path: Path, text: str) -> None:
    """Write a text with a time of its own: a .pyc goes by second and size, which two mutants may share."""
    later = int(path.stat().st_mtime) + 2
    path.write_text(text, encoding="utf-8")
    os.utime(path, (later, later))


def copy_of(root: Path, folder: Path) -> Path:
    """Return a copy of the tree's source and tests in `folder`."""
    keep = ("softneck", "tests", "benchmarks", "docs", "examples", "pyproject.toml", "Makefile", "README.md")
    for name in keep:
        source = root / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "_build"))
        elif source.exists():
            shutil.copy2(source, folder / name)
    return folder


def run_area(area: Area, settings: dict[str, Any], chosen: list[Mutant]) -> list[Outcome]:
    """Return what came of each mutant."""
    results = []
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copy = copy_of(ROOT, Path(folder))
        begin = time.monotonic()
        if run_tests(copy, area.tests, copy / "mutation.log", 1800.0) != 0:
            raise SystemExit(
                f"area {area.name}: the tests fail without a mutant\n{(copy / 'mutation.log').read_text()}"
            )
        patience = max(LEAST, PATIENCE * (time.monotonic() - begin))
        print(f"{area.name}: without a mutant {time.monotonic() - begin:.0f} s", flush=True)
        for number, mutant in enumerate(chosen, start=1):
            found = try_mutant(copy, area, mutant, settings.get("equivalent", []), patience)
            print(f"{area.name} {number}/{len(chosen)}: {found.outcome} in {found.seconds:.0f} s", flush=True)
            if found.outcome in ("survived", "hung"):
                print(found.diff, flush=True)
            results.append(found)
    return results


def main() -> None:
    """Try the areas' samples and print a table."""
    areas, settings = read_areas()
    parser = argparse.ArgumentParser(description="Mutate areas and see which mutants survive their tests.")
    parser.add_argument("areas", nargs="*", help=f"of {', '.join(areas)}; all if not given")
    parser.add_argument("--count", type=int, default=settings["count"], help="mutants an area")
    parser.add_argument("--seed", type=int, help="of the sample; a new one each time if not given")
    parser.add_argument("--out", type=Path, help="JSON of every mutant and what came of it")
    parser.add_argument("--again", type=Path, help="try only what survived there, a file that --out wrote")
    asked = parser.parse_args()
    before = json.loads(asked.again.read_text(encoding="utf-8")) if asked.again else {}
    seed = random.SystemRandom().randrange(2**31) if asked.seed is None else asked.seed
    print(f"seed {seed}", flush=True)
    importlib.import_module("operators")
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() not in (HERE, ROOT)]
    for name in HEAVY:
        importlib.import_module(name)
    table, everything = [], {}
    for name in asked.areas or list(before or areas):
        possible = list(mutants_of(ROOT, areas[name], settings))
        chosen = sample(possible, asked.count, seed)
        if asked.again:
            lived = [item["mutant"] for item in before[name] if item["outcome"] == "survived"]
            chosen = [mutant for mutant in chosen if asdict(mutant) in lived]
        found = run_area(areas[name], settings, chosen)
        counts = {kind: sum(item.outcome == kind for item in found) for kind in OUTCOMES}
        meant = len(found) - counts["equivalent"]
        table.append((name, len(possible), counts, counts["survived"] / max(meant, 1)))
        everything[name] = [asdict(item) for item in found]
        if asked.out:
            asked.out.parent.mkdir(parents=True, exist_ok=True)
            asked.out.write_text(json.dumps(everything, indent=1), encoding="utf-8")
    print(f"{'area':<14}{'possible':>10}" + "".join(f"{kind:>12}" for kind in OUTCOMES) + f"{'survival':>10}")
    for name, possible, counts, share in table:
        print(f"{name:<14}{possible:>10}" + "".join(f"{counts[kind]:>12}" for kind in OUTCOMES) + f"{share:>10.0%}")


if __name__ == "__main__":
    main()
