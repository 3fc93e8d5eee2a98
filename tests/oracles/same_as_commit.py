"""Compare the numbers of this checkout with those of an earlier commit, to the bit.

    python tests/oracles/same_as_commit.py [COMMIT] [--kinds rls pi loop ...]
    python tests/oracles/same_as_commit.py COMMIT --golden tests/golden

The earlier commit makes a file of every kind, once (`small_blocks.py`). Then each version, in a process of its own,
loads these files and runs them in every way there is (`every_run.py`): compiled, plain Python, free run, prediction,
loops, a study, a verification, FMUs. All numbers are compared bit by bit; the exit code is 1 if any differs.
`--golden` keeps the files and some outputs of the earlier commit instead.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
COMMIT = "58c2fd0"  # the last one before the five source roots became one package
OLD_ROOTS = ("kit", "identification", "fmu_src", "design", "deploy")


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """Give a worktree of `commit` in a temporary folder, and remove it."""
    git = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory(prefix="softneck-commit-") as folder:
        place = Path(folder) / "checkout"
        subprocess.run([*git, "add", "--quiet", "--detach", str(place), commit], check=True)
        try:
            yield place
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=True)


def start(source: Path, task: str, *arguments: str | Path) -> subprocess.Popen[bytes]:
    """Start `every_run.py TASK` with the version of softneck in `source`."""
    roots = [source] if (source / "softneck").is_dir() else [source / name for name in OLD_ROOTS]
    # One thread: sums in BLAS must not depend on how busy the machine is. FMUs in Python run the plain text.
    settings = {"PYTHONPATH": os.pathsep.join(map(str, roots)), "SOFTNECK_FMU_NUMBA": "0"}
    settings |= {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    script = Path(__file__).with_name("every_run.py")
    return subprocess.Popen([sys.executable, str(script), task, *map(str, arguments)], env=os.environ | settings)


def wait_for(*running: subprocess.Popen[bytes]) -> None:
    """Wait for all; exit with 2 if one failed, as then nothing was compared."""
    codes = [process.wait() for process in running]
    if any(codes):
        sys.exit(2)


def difference(old: np.ndarray, new: np.ndarray) -> str:
    """Return "equal" if all bits are, else how much the numbers differ."""
    if old.shape != new.shape:
        return f"DIFFERS: shapes {old.shape} and {new.shape}"
    bits = old.view(np.uint64) != new.view(np.uint64)
    if not bits.any():
        return "equal"
    with np.errstate(invalid="ignore"):
        return f"DIFFERS in {bits.sum()}: by {np.nanmax(np.abs(old - new), initial=0.0):.3g} at most"


def compare(commit: str, kinds: list[str], folder: Path) -> bool:
    """Run both versions on the same files, print the table, and return whether all is equal."""
    files, old, new = folder / "files", folder / "old.npz", folder / "new.npz"
    with checkout(commit) as earlier:
        wait_for(start(earlier, "make", files))
        wait_for(start(earlier, "run", files, old, *kinds), start(ROOT, "run", files, new, *kinds))
    equal = True
    with np.load(old) as before, np.load(new) as after:
        names = list(dict.fromkeys([*before.files, *after.files]))
        print(f"{'item':44} {'samples':>8}  today and at {commit}")
        for name in names:
            both = name in before.files and name in after.files
            result = difference(before[name], after[name]) if both else "DIFFERS: of one version only"
            equal &= result == "equal"
            print(f"{name:44} {(before if name in before.files else after)[name].size:8d}  {result}")
    print(f"{len(names)} items: {'all equal to the bit' if equal else 'NOT all equal'}")
    return equal


def main() -> int:
    """Read the command line; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("commit", nargs="?", default=COMMIT, help=f"what to compare with (default {COMMIT})")
    parser.add_argument("--kinds", nargs="+", default=[], help="names of `small_blocks.py`, or loop, study, ...")
    parser.add_argument("--golden", type=Path, metavar="FOLDER", help="write golden files of COMMIT and stop")
    asked = parser.parse_args()
    if asked.golden:
        with checkout(asked.commit) as earlier:
            wait_for(start(earlier, "make", asked.golden))
            wait_for(start(earlier, "golden", asked.golden))
        return 0
    with tempfile.TemporaryDirectory(prefix="softneck-same-") as folder:
        return 0 if compare(asked.commit, asked.kinds, Path(folder)) else 1


if __name__ == "__main__":
    sys.exit(main())
