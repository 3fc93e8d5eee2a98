"""Print what each kind of model is worth with its defaults on every neck, also on those that are held out.

`python benchmarks/baseline.py [--necks NECK...] [--seed N] [--seeds N] [--workers N] [--kept] [--fresh]`

The worst test axis in simulation (`seeds` seeds of noise and start), and what bounds hold. Nothing is chosen here: the
two necks that are held out are shown in a block of their own. Which kinds stay is asked of `earns_its_place.py`.
Results are kept in `build/baseline`: a run that was stopped goes on where it was. They are of the code that computed
them: use --fresh after a change.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import astuple, dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import softneck
from softneck.core import KINDS, SoftneckError, resolve
from softneck.identification import INFINITE, validate
from softneck.plant import NeckParameters, VirtualNeck
from softneck.signals import Excitation, Recording, signal
from tests.foreign_necks.held_out import HELD_OUT
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import NECKS, ForeignNeck, record

OURS = ("paper", "rough")
SHOWN = (*OURS, *NECKS)
OUT = Path("build/baseline")
TESTS = ("steps", "sine", "rotation")
# Kinds of model.
MODELS = ("rls", "oe", "nlsm", "play", "greybox", "nn")


@dataclass(frozen=True, slots=True)
class Job:
    """One figure to compute.

    Attributes:
        neck, kind: on which neck, and what.
        seed: of the noise of its recordings, and of starts at random.
    """

    neck: str
    kind: str
    seed: int


def recorded(neck: str, excitation: Excitation, seed: int, *, payload: float = 0.0, noise: bool = True) -> Recording:
    """Return a recording of one of our necks or of a foreign one."""
    if neck in OURS:
        own = VirtualNeck(NeckParameters.preset(neck))
        return softneck.record(excitation, own, seed=seed, payload=payload, noise=noise)
    return record(excitation, ForeignNeck(name=neck, noise=noise), seed=seed, payload=payload)


@lru_cache(1)
def training(neck: str, seed: int) -> Recording:
    """Return 140 s of Eq. 22."""
    return recorded(neck, signal("eq22"), 10 * seed + 1).rows(0, 7000)


@lru_cache(2)
def records_of_tests(neck: str, seed: int, *, noise: bool = True) -> list[Recording]:
    """Return steps, sine and rotation."""
    return [recorded(neck, signal(name), 10 * seed + n, noise=noise) for n, name in enumerate(TESTS, start=2)]


def model_of(job: Job) -> Any:
    """Return the model of that kind with its defaults."""
    settings = resolve(KINDS[job.kind].settings)
    seeded = {"seed": job.seed} if "seed" in settings.__dataclass_fields__ else {}
    return settings(**seeded).fit(training(job.neck, job.seed))


def models(job: Job) -> dict[str, Any]:
    """Return for each test the free-run fits [%], None where it diverged, and what part of the measured samples the
    kind's bounds hold [%], with their mean width [deg]."""
    model = model_of(job)
    judged = [validate(model, test) for test in records_of_tests(job.neck, job.seed)]
    return {
        "fits": [list(test.fits[INFINITE].values()) for test in judged],
        "held": [list((test.coverage_pct or {}).values()) for test in judged],
        "width": [list((test.mean_width_deg or {}).values()) for test in judged],
    }


def jobs(necks: Iterable[str], seed: int, seeds: int) -> list[Job]:
    """Return all there is to compute."""
    return [Job(neck, kind, seed + k) for k in range(seeds) for neck in necks for kind in MODELS]


def computed(unit: list[Job], kept: Path) -> list[dict[str, Any]]:
    """Return what the jobs of one neck and seed find, or why they find nothing, and their seconds; keep each."""
    results = []
    # One thread each: there are as many processes as cores.
    with threadpool_limits(1):
        for job in unit:
            begin = time.process_time()
            try:
                found = models(job)
            except SoftneckError as error:
                found = {"failed": str(error)}
            results.append({**found, "seconds": round(time.process_time() - begin, 1)})
            keep(kept, {"job": astuple(job), "found": results[-1]})
    return results


def compute(wanted: list[Job], workers: int, *, fresh: bool) -> dict[Job, dict[str, Any]]:
    """Return the result of every job; what an earlier run has computed is read."""
    kept = OUT / "models.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        kept.unlink(missing_ok=True)
    results = _known(kept)
    # Those of one neck and seed share their recordings.
    units: dict[tuple[str, int], list[Job]] = {}
    for job in wanted:
        if job not in results:
            units.setdefault((job.neck, job.seed), []).append(job)
    print(f"{sum(job in results for job in wanted)} of {len(wanted)} results are in {kept}", flush=True)
    # Started anew: a forked process would hold the locks of ours.
    with ProcessPoolExecutor(min(workers, max(1, len(units))), mp_context=get_context("spawn")) as pool:
        running = {pool.submit(computed, unit, kept): unit for unit in units.values()}
        for number, done in enumerate(as_completed(running), start=1):
            unit = running[done]
            results |= zip(unit, done.result(), strict=True)
            spent = sum(results[job]["seconds"] for job in unit)
            print(
                f"  {number}/{len(units)} {unit[0].neck}, seed {unit[0].seed}: {len(unit)} in {spent:.0f} s", flush=True
            )
    return {job: results[job] for job in wanted}


def _known(kept: Path) -> dict[Job, dict[str, Any]]:
    """Return what is kept."""
    return {Job(*line["job"]): line["found"] for line in kept_lines(kept)}


def tables(found: dict[Job, dict[str, Any]], necks: list[str]) -> None:
    """Print the tables of all parts that were computed."""
    for title, cell in TABLES:
        rows = []
        for kind in dict.fromkeys(job.kind for job in found):
            each = [[r for job, r in found.items() if (job.kind, job.neck) == (kind, neck)] for neck in necks]
            # A dash for what is not computed yet; not every kind has bounds.
            cells = [cell(results) if results else "-" for results in each]
            if any(text not in ("", "-") for text in cells):
                rows.append(f"| `{kind}` | {' | '.join(cells)} |")
        if rows:
            print(f"\n{title}\n\n| | {' | '.join(necks)} |\n|---|{'---|' * len(necks)}")
            print("\n".join(rows))


def _worst_axis(results: list[dict[str, Any]]) -> str:
    # -inf stands for a free run that diverged or a fit that failed.
    worst = [
        min((-math.inf if fit is None else fit for test in r["fits"] for fit in test), default=-math.inf)
        if "fits" in r
        else -math.inf
        for r in results
    ]
    return f"{_number(median(worst))} ({_number(min(worst))})"


def _held(results: list[dict[str, Any]]) -> str:
    known = [r for r in results if r.get("held", [[]])[0]]
    if not known:
        return ""
    least = median(min(value for test in r["held"] for value in test) for r in known)
    return f"{least:.0f} ({median(float(np.mean(r['width'])) for r in known):.1f})"


def _number(value: float, places: int = 0) -> str:
    return f"{value:.{places}f}" if math.isfinite(value) else "-"


TABLES = (
    ("Models: worst axis of the tests in free run [%], median of the seeds (worst seed)", _worst_axis),
    ("Bounds: samples of the tests held in free run [%], least axis, and mean width [deg]", _held),
)


def main() -> None:
    """Read the command line, compute what is missing, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="+", choices=SHOWN, default=list(SHOWN))
    parser.add_argument("--seed", type=int, default=0, help="the first (0)")
    parser.add_argument("--seeds", type=int, default=5, help="how many (5)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (all cores)")
    parser.add_argument("--kept", action="store_true", help="compute nothing: print what is there")
    parser.add_argument("--fresh", action="store_true", help="compute everything again")
    wanted = parser.parse_args()
    asked = jobs(wanted.necks, wanted.seed, wanted.seeds)
    if wanted.kept:
        results = _known(OUT / "models.jsonl")
        found = {job: results[job] for job in asked if job in results}
    else:
        found = compute(asked, wanted.workers, fresh=wanted.fresh)
    for held_out in (False, True):
        necks = [neck for neck in wanted.necks if (neck in HELD_OUT) == held_out]
        if necks:
            print(f"\n## {'Held out from every choice' if held_out else 'Necks on which defaults are chosen'}")
            tables({job: result for job, result in found.items() if job.neck in necks}, necks)


if __name__ == "__main__":
    main()
