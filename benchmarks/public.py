"""Public benchmarks of system identification, from files that the user has: `python benchmarks/public.py DIR`.

Each is read in the format in which it is published, split as its authors say, and judged by the RMSE of a free run over
the test record, whose first samples (the benchmark's own window) align the model. Kind and settings are chosen
on parts of the training record that are left out: four in turn where it is short, else the last 30 %; the test record
is used once, at the end. Nothing is downloaded: of a file that is not
there it is said where it is described.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softneck import identify
from softneck.core import DataError, Matrix, SoftneckError, Vector
from softneck.identification import Model
from softneck.robot import Robot
from softneck.signals import Recording, concatenate

HOLD_OUT = 0.3
# A record of fewer rows is short: what its last rows happen to show decides nothing. So many blocks are left out then.
SHORT, BLOCKS = 5000, 4
Candidate = tuple[str, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Benchmark:
    """One data set.

    Attributes:
        name: on the command line.
        files: what must be in the folder.
        described: where it is described.
        read: makes the training record and the test records by name of the files in a folder.
        window: samples of a test record that align the model, by the benchmark's rules.
        unit: of the RMSE.
        published: figures of others, with their source.
    """

    name: str
    files: tuple[str, ...]
    described: str
    read: Callable[[Path], tuple[Recording, dict[str, Recording]]]
    window: int
    unit: str
    published: str


def recording(name: str, sample_time: float, U: Matrix, Y: Matrix, *, units: tuple[str, str] = ("V", "V")) -> Recording:
    """Return a recording of the robot `name` with inputs (time, motors) and outputs (time, outputs) in `units`."""
    if len(U) != len(Y):
        raise DataError(f"the record has {len(U)} inputs and {len(Y)} outputs; it must have as many of both.")
    if not (np.isfinite(U).all() and np.isfinite(Y).all()):
        raise DataError("the record has values that are not a number.")
    U, Y = U.reshape(len(U), -1), Y.reshape(len(Y), -1)
    names = ["y"] if Y.shape[1] == 1 else [f"y{i + 1}" for i in range(Y.shape[1])]
    robot = Robot.from_dict(
        {
            "name": name,
            "motors": {"names": [f"u{i + 1}" for i in range(U.shape[1])], "unit": units[0]},
            "outputs": {"names": names, "unit": units[1]},
            "directions": {"kind": "identified"},
        }
    )
    channels = dict(zip(robot.set_points, U.T, strict=True)) | dict(zip(names, Y.T, strict=True))
    return Recording(sample_time * np.arange(len(U)), sample_time, channels, robot=robot)


def _mat(path: Path, *names: str) -> list[Vector]:
    """Return the signals `names` of a MAT file, each (samples,)."""
    from scipy.io import loadmat

    try:
        content = loadmat(path, variable_names=names)
    except Exception as failure:  # scipy raises whatever its readers stumble over
        raise DataError(f"{path} cannot be read as a MAT file; download it again.") from failure
    if missing := [name for name in names if name not in content]:
        raise DataError(f"{path} has no `{'`, `'.join(missing)}`: it is not the published file.")
    for name in names:
        if content[name].dtype.kind not in "iuf" or not content[name].size:
            raise DataError(f"{path} has no numbers in `{name}`: it is not the published file.")
    return [np.asarray(content[name], dtype=np.float64).ravel() for name in names]


def _require_samples(u: Vector, count: int) -> None:
    if u.size < count:
        raise DataError(f"the record has {u.size} of {count} samples: it is not the published file.")


def tanks(folder: Path) -> tuple[Recording, dict[str, Recording]]:
    """Cascaded tanks: uEst, yEst to learn from, uVal, yVal to judge."""
    u, y, u_test, y_test, Ts = _mat(folder / "dataBenchmark.mat", "uEst", "yEst", "uVal", "yVal", "Ts")
    return recording("tanks", Ts[0], u, y), {"validation": recording("tanks", Ts[0], u_test, y_test)}


def silverbox(folder: Path) -> tuple[Recording, dict[str, Recording]]:
    """Silverbox: three quarters of the multisine to learn from; the rest and the arrow head, also without its tip."""
    u, y = _mat(folder / "SNLS80mV.mat", "V1", "V2")
    _require_samples(u, 127_400)
    Ts, edge = 1.0 / 610.35, 40650 + int(0.75 * (127400 - 40650))

    def part(first: int, stop: int) -> Recording:
        return recording("silverbox", Ts, u[first:stop], y[first:stop])

    test = {"multisine": part(edge, 127400), "arrow": part(100, 40575), "arrow without its tip": part(100, 32100)}
    return part(40650, edge), test


def wiener_hammerstein(folder: Path) -> tuple[Recording, dict[str, Recording]]:
    """Wiener-Hammerstein 2009: 100,000 samples from 5,200 on to learn from, the next 78,800 to judge."""
    u, y, fs = _mat(folder / "WienerHammerBenchMark.mat", "uBenchMark", "yBenchMark", "fs")
    _require_samples(u, 184_000)
    parts = [(5200, 105200), (105200, 184000)]
    train, test = (recording("wiener-hammerstein", 1.0 / fs[0], u[a:b], y[a:b]) for a, b in parts)
    return train, {"test": test}


_EMPS = ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")


def emps(folder: Path) -> tuple[Recording, dict[str, Recording]]:
    """EMPS: force `vir` to position `qm`; the pulses are the test."""
    found = []
    for name in _EMPS:
        u, y, t = _mat(folder / name, "vir", "qm", "t")
        if t.size < 2:
            raise DataError(f"{folder / name}: `t` must have two samples or more.")
        found.append(recording("emps", float(t[1] - t[0]), u, y, units=("N", "m")))
    return found[0], {"pulses": found[1]}


def pneumatic_trials(folder: Path) -> list[Recording]:
    """A pneumatic arm: pressure_1..3 to x, y; the trials (column `run`)."""
    path = folder / "pneumatic_arm_two_trials.csv"
    names = ("time [s]", "pressure_1", "pressure_2", "pressure_3", "x", "y", "run")
    try:
        with path.open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        table = {name: np.array([float(row[name]) for row in rows]) for name in names}
    except (KeyError, TypeError, ValueError) as failure:
        raise DataError(f"{path} must have numbers in the columns {', '.join(names)} ({failure!r}).") from failure
    U = np.column_stack([table[f"pressure_{j}"] for j in (1, 2, 3)])
    Y = np.column_stack([table["x"], table["y"]])
    Ts = float(np.median(np.diff(table["time [s]"])))
    trials = [table["run"] == number for number in np.unique(table["run"])]
    return [recording("pneumatic arm", Ts, U[there], Y[there], units=("1", "1")) for there in trials]


def pneumatic_arm(folder: Path) -> tuple[Recording, dict[str, Recording]]:
    """A pneumatic arm: of each trial the last 30 % is the test."""
    parts = [trial.split(0.7) for trial in pneumatic_trials(folder)]
    return concatenate([head for head, _ in parts]), {"ends": concatenate([tail for _, tail in parts])}


_SITE = "nonlinearbenchmark.org/benchmarks/"
# Windows: `state_initialization_window_length` of github.com/MaartenSchoukens/nonlinear_benchmarks.
# Figures of others, RMSE of simulation.
_BASELINES = "Champneys et al. 2024, arXiv 2405.10779"
BENCHMARKS = (
    Benchmark("tanks", ("dataBenchmark.mat",), _SITE + "cascaded-tanks", tanks, 50, "V",
              f"GRU 0.396, P-NARX 0.413 V ({_BASELINES})"),
    Benchmark("silverbox", ("SNLS80mV.mat",), _SITE + "silverbox", silverbox, 50, "V",
              f"GRU 0.00149, polynomial state space about 0.0003 V ({_BASELINES}, and what it quotes)"),
    Benchmark("wiener-hammerstein", ("WienerHammerBenchMark.mat",), _SITE + "wiener-hammerstein", wiener_hammerstein,
              50, "V", f"see {_BASELINES}"),
    Benchmark("emps", _EMPS, _SITE + "emps", emps, 20, "m", f"see {_BASELINES}"),
    Benchmark("pneumatic-arm", ("pneumatic_arm_two_trials.csv",), "Bruder, Gillespie, Remy and Vasudevan 2019, "
              "arXiv 1902.02827; github.com/ramvasudevan/soft-robot-koopman", pneumatic_arm, 25, "1", "-"),
)  # fmt: skip


def identified(kind: str, train: Recording, settings: dict[str, Any]) -> list[Model]:
    """Return the model of `kind`; `seeds` among the settings asks for so many, whose median is judged."""
    settings = dict(settings)
    seeds = settings.pop("seeds", 0)
    if not seeds:
        return [identify(kind, train, train=1.0, **settings)]
    return [identify(kind, train, train=1.0, **settings, seed=seed) for seed in range(seeds)]


def candidates_for(train: Recording) -> tuple[Candidate, ...]:
    """Return kinds and settings to choose from.

    Where a record is short a start decides: the median of five (`seeds`) stands for them.
    """
    starts = {"seeds": 5} if len(train) < SHORT else {}
    return (("nn", starts), ("play", {}), ("nlsm", {"form": "residual"}))


def left_out(train: Recording) -> list[tuple[Recording, Recording]]:
    """Return what to learn from and what to judge by, in turn: blocks of each run, or its end where there is much."""
    if len(train) >= SHORT:
        return [train.split(1.0 - HOLD_OUT)]
    found = []
    for block in range(BLOCKS):
        rest, judge = [], []
        for run in train.runs():
            a, b = block * len(run) // BLOCKS, (block + 1) * len(run) // BLOCKS
            judge.append(run.rows(a, b))
            rest += [run.rows(start, stop) for start, stop in ((0, a), (b, len(run))) if stop > start]
        found.append((concatenate(rest), concatenate(judge)))
    return found


def rmse(models: list[Model], test: Recording, window: int) -> Vector:
    """Return the RMSE (outputs,) of the models' median, without the first `window` samples of each run."""
    errors = []
    for run in test.runs():
        free = np.median([m.simulate(run, warm_up=window)[:, : run.outputs.shape[1]] for m in models], axis=0)
        errors.append((run.outputs - free)[window:])
    return np.sqrt(np.nanmean(np.concatenate(errors) ** 2, axis=0))


def choose(train: Recording, candidates: Sequence[Candidate], window: int) -> tuple[Candidate, float]:
    """Return what runs freest of error over what is left out of the training record, and its RMSE over its spread."""
    spread = np.nanstd(train.outputs, axis=0)
    scored = []
    for number, (kind, settings) in enumerate(candidates):
        try:
            errors = [rmse(identified(kind, rest, settings), part, window) for rest, part in left_out(train)]
        except SoftneckError as failure:
            print(f"  {kind} {settings}: {failure}")
            continue
        error = float(np.mean(np.sqrt(np.mean(np.square(errors), axis=0)) / spread))
        each = ", ".join(f"{100.0 * np.mean(one / spread):.3g}" for one in errors)
        print(f"  {kind} {settings}: {100.0 * error:.3g} % of the spread ({each}) where left out", flush=True)
        scored.append((error, number))
    if not scored:
        raise DataError("no kind could be identified from this record.")
    error, number = min(scored)
    return candidates[number], error


def run(benchmark: Benchmark, folder: Path, candidates: Sequence[Candidate] | None = None) -> dict[str, Vector]:
    """Choose, identify from the whole training record, print and return the RMSE of each test record."""
    train, tests = benchmark.read(folder)
    print(f"{benchmark.name}: {len(train)} rows to learn from")
    (kind, settings), _ = choose(train, candidates or candidates_for(train), benchmark.window)
    models = identified(kind, train, settings)
    found = {name: rmse(models, test, benchmark.window) for name, test in tests.items()}
    for name, error in found.items():
        shown = ", ".join(f"{value:.4g}" for value in error)
        print(f"  {name}: RMSE {shown} {benchmark.unit} by {kind}; published: {benchmark.published}", flush=True)
    return found


def main() -> None:
    """Run what is there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, metavar="DIR", help="where the files are")
    parser.add_argument("--only", choices=[benchmark.name for benchmark in BENCHMARKS])
    arguments = parser.parse_args()
    if not arguments.folder.is_dir():
        parser.error(f"{arguments.folder} is not a folder; give the one in which the benchmarks' files are.")
    refused = False
    for benchmark in BENCHMARKS:
        if arguments.only not in (None, benchmark.name):
            continue
        missing = [name for name in benchmark.files if not (arguments.folder / name).is_file()]
        if missing:
            said = f"no {' and no '.join(missing)} in {arguments.folder}; described at {benchmark.described}."
            print(f"{benchmark.name}: {said}", flush=True)
            refused |= arguments.only is not None
            continue
        try:
            run(benchmark, arguments.folder)
        except SoftneckError as failure:
            print(f"{benchmark.name}: {failure} Described at {benchmark.described}.", file=sys.stderr)
            refused = True
    if refused:
        raise SystemExit(2)


if __name__ == "__main__":
    main()
