"""Print how the cost of each command grows with its size: `python benchmarks/scale.py [COMMAND...] [--sizes 1 4 16]`.

Sizes multiply rows of recordings, runs, draws and evaluations. Cost is processor time beyond that of `softneck --help`,
of a second run: the first fills the cache of compiled code. The exponent is the slope of log cost over log size; the
last column is that between the two largest sizes, where what a command does once weighs least.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

# Of size 1: 40 s at 50 Hz.
_SECONDS, _RUNS, _DRAWS, _EVALUATIONS = 40, 10, 8, 10
_KINDS = ("rls", "oe", "play", "nlsm", "nn", "greybox")
_ROWS = {
    "import": "import {n}.csv --guess --yes -o {n}_again.csv",
    **{kind: f"identify {kind} {{n}}.csv -o {{n}}_{kind}.npz" for kind in _KINDS},
    "validate": "validate rls.npz --data {n}.csv",
    "observer": "observer rls.npz --data {n}.csv -o {n}_kalman.npz",
    "family": "family {n}.csv --draws 0 -o {n}_rows.family.npz",
}  # fmt: skip
_LOOP = """duration_s = {seconds}.0
plant = {{ model = "rls.npz" }}
controller = {{ file = "pi.npz" }}
reference = {{ kind = "step", pitch_deg = 5.0, at_s = 1.0 }}
"""
_STUDY = """loop = "loop.toml"
runs = {runs}
[vary."reference.pitch_deg"]
uniform = [2.0, 8.0]
"""


def softneck(command: str) -> float:
    """Run a command and return its processor time [s]; a requirement that does not hold is no failure."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", "softneck", *command.split()], capture_output=True, text=True)
    if done.returncode not in (0, 1):
        raise SystemExit(f"`softneck {command}`: {done.stderr.strip()}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def commands(sizes: list[int]) -> dict[str, tuple[str, Callable[[int], str]]]:
    """Make the files of all sizes; return name -> what is multiplied, and the command of a size."""
    for n in sizes:
        softneck(f"record mixed --duration {_SECONDS * n} -o {n}.csv --force")
        Path(f"loop_{n}.toml").write_text(_LOOP.format(seconds=_SECONDS * n), encoding="utf-8")
        Path(f"study_{n}.toml").write_text(_STUDY.format(runs=_RUNS * n), encoding="utf-8")
    Path("loop.toml").write_text(_LOOP.format(seconds=10), encoding="utf-8")
    softneck("record mixed -o full.csv --force")
    softneck("identify rls full.csv -o rls.npz --force")
    softneck("design pi rls.npz -o pi.npz --force")
    made = {name: ("rows", lambda n, c=command: c.format(n=n)) for name, command in _ROWS.items()}
    drawn = {
        "family --draws": ("draws", lambda n: f"family full.csv --draws {_DRAWS * n} -o {n}.family.npz"),
        "verify": ("draws", lambda n: f"verify pi.npz {n}.family.npz -o {n}.certificate.json"),
        "tune": ("evaluations", lambda n: f"tune rls.npz --kinds pi --workers 0 --budget {_EVALUATIONS * n} -o {n}"),
        "simulate": ("rows", lambda n: f"simulate loop_{n}.toml -o {n}_loop.csv"),
        "study": ("runs", lambda n: f"study study_{n}.toml --workers 1 -o {n}_study"),
    }  # fmt: skip
    return made | drawn


def exponent(sizes: list[int], costs: list[float]) -> float:
    """Return the slope of log cost over log size, by least squares."""
    x, y = ([math.log(max(value, 1e-3)) for value in values] for values in (sizes, costs))
    mean = sum(x) / len(x)
    return sum((a - mean) * b for a, b in zip(x, y, strict=True)) / sum((a - mean) ** 2 for a in x)


def main() -> None:
    """Print a line for each command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("names", nargs="*", metavar="COMMAND")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        known, start = commands(asked.sizes), min(softneck("--help") for _ in range(3))
        print(f"{'command':16}{'times':13}" + "".join(f"{f'{n} x [s]':>10}" for n in asked.sizes) + "  exponent   last")
        for name in asked.names or known:
            grows, command = known[name]
            for n in asked.sizes if name == "verify" else ():
                if not Path(f"{n}.family.npz").is_file():
                    softneck(known["family --draws"][1](n))
            softneck(f"{command(asked.sizes[0])} --force")
            costs = [softneck(f"{command(n)} --force") - start for n in asked.sizes]
            told = "".join(f"{cost:10.2f}" for cost in costs)
            last = exponent(asked.sizes[-2:], costs[-2:])
            print(f"{name:16}{grows:13}{told}{exponent(asked.sizes, costs):10.2f}{last:7.2f}", flush=True)


if __name__ == "__main__":
    main()
