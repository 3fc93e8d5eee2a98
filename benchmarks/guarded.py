"""Print what guarded models are worth on necks that nobody tuned to: the table of docs/theory/models.md.

`python benchmarks/guarded.py [--necks NECK...] [--of KIND...] [--seeds N] [--kept] [--fmu]`

Trained on 140 s of Eq. 22 with the kind's defaults; judged in free run from set-points alone, worst axis: on the rows
of Eq. 22 that follow (validation), and on steps, sine and rotation. A seed is that of noise and of starts. Results and
models are kept in `build/guarded`: a run that was stopped goes on where it was. They are of the code that made them.
With --fmu it prints what a `doStep` of the kept models costs as compiled FMUs, and that of a line beside them.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.baseline import SHOWN, TESTS, recorded, records_of_tests, training
from softneck.core import load
from softneck.fmu import build_compiled_fmu
from softneck.identification import INFINITE, Model, OutputError, validate
from softneck.identification.uncertainty._guarded import Guarded
from softneck.signals import Recording, signal
from tests.foreign_necks.kept import keep, kept_lines

SEEN = ("chain", "column", "spring", "foam", "paper")
OUT = Path("build/guarded")


def worst_axis(model: Model, recording: Recording) -> float:
    """Return the fit [%] of the free run on the worse axis; -100 where it diverged."""
    fits = validate(model, recording, horizons=(INFINITE,)).fits[INFINITE].values()
    return min(-100.0 if fit is None else max(fit, -100.0) for fit in fits)


def computed(of: str, neck: str, seed: int) -> dict[str, Any]:
    """Return the fits of one guarded model and the processor time [s] of its training; the model is kept."""
    begin = time.process_time()
    model = Guarded(of=of, seed=100 * seed, workers=1).fit(training(neck, seed))
    seconds = time.process_time() - begin
    model.save(OUT / f"{of}-{neck}-{seed}.npz", force=True)
    follows = recorded(neck, signal("eq22"), 10 * seed + 1).rows(7000, 10000)
    tests = dict(zip(("validation", *TESTS), (follows, *records_of_tests(neck, seed)), strict=True))
    return {
        "base": model.findings["base"],
        "seconds": round(seconds),
        "fits": {name: round(worst_axis(model, test), 1) for name, test in tests.items()},
    }


def table(results: dict[tuple[str, str, int], dict[str, Any]]) -> None:
    """Print what is there, and the medians."""
    print(f"\n| of | neck | seed | base | validation | {' | '.join(TESTS)} | cpu s |\n|{'---|' * 9}")
    for (of, neck, seed), found in sorted(results.items()):
        cells = " | ".join(f"{fit:.1f}" for fit in found["fits"].values())
        print(f"| `{of}` | `{neck}` | {seed} | `{found['base']}` | {cells} | {found['seconds']} |")
    for of in sorted({key[0] for key in results}):
        worst = [min(found["fits"][test] for test in TESTS) for key, found in results.items() if key[0] == of]
        print(f"`{of}`: worst axis of the tests, median {np.median(worst):.1f}, least {min(worst):.1f} of {len(worst)}")


def do_step_us(model: Model) -> float:
    """Return the processor time of a `doStep` of the compiled FMU [us], with fmpy's call: least mean of seven."""
    import fmpy
    from fmpy.fmi2 import FMU2Slave

    path = OUT / f"{model.kind}.fmu"
    build_compiled_fmu(model.block(), path, force=True)
    told = fmpy.read_model_description(str(path))
    folder = fmpy.extract(str(path))
    fmu = FMU2Slave(guid=told.guid, unzipDirectory=folder, instanceName="one", modelIdentifier=path.stem)
    fmu.instantiate()
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    found, steps = [], 2000
    for number in range(7):
        begin = time.process_time()
        for k in range(steps):
            fmu.doStep((number * steps + k) * model.sample_time, model.sample_time)
        found.append((time.process_time() - begin) / steps)
    return 1e6 * min(found)


def main() -> None:
    """Read the command line, compute what is missing, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="+", choices=SHOWN, default=list(SEEN))
    parser.add_argument("--of", nargs="+", default=["nn"], help="kinds of the members")
    parser.add_argument("--seeds", type=int, default=2, help="how many (2)")
    parser.add_argument("--kept", action="store_true", help="compute nothing: print what is there")
    parser.add_argument("--fmu", action="store_true", help="compute nothing: print the time of a doStep")
    wanted = parser.parse_args()
    if wanted.fmu:
        line = OutputError().fit(training(wanted.necks[0], 0))
        print(f"oe: {do_step_us(line):.2f} us a doStep, fmpy's call with it")
        for of in wanted.of:
            model = load(OUT / f"{of}-{wanted.necks[0]}-0.npz", role="model")
            print(f"guarded of {of}, {model.findings['members']}: {do_step_us(model):.2f} us")
        return
    kept = OUT / "results.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    results = {tuple(line["job"]): line["found"] for line in kept_lines(kept)}
    for seed in [] if wanted.kept else range(wanted.seeds):
        for neck in wanted.necks:
            for of in wanted.of:
                if (of, neck, seed) not in results:
                    with threadpool_limits(1):
                        results[of, neck, seed] = found = computed(of, neck, seed)
                    keep(kept, {"job": (of, neck, seed), "found": found})
                    print(f"{of} {neck} {seed}: {found}", flush=True)
    table(results)


if __name__ == "__main__":
    main()
