"""Print what a second recording is worth: that which `next_experiment` designs beside more of the same, and `mixed`.

`python benchmarks/excite.py [--necks NECK...] [--kinds KIND...] [--seconds S] [--seed N] [--fresh]`

Each neck is recorded for so many seconds of Eq. 22, then again as long: more of Eq. 22, `mixed`, or what four quick
`nn` ask for after the first. Models of both together run free over steps, sine and rotation, which none of them has
seen: mean and worst axis [%]. The first alone stands beside. What is computed is kept in `build/excite`.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.baseline import recorded, records_of_tests
from softneck.identification import INFINITE, Model, Network, Play, validate
from softneck.identification.selection._experiment_design import Known, next_experiment
from softneck.identification.uncertainty._guarded import Guarded, covering, left_out
from softneck.signals import Excitation, Recording, concatenate, signal
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import CHOOSING

OUT = Path("build/excite")
# One start: what is compared are the recordings.
KINDS = {"play": Play(), "nn": Network(starts=1)}
SECOND = ("none", "eq22", "mixed", "excite")


def second(what: str, first: Recording, neck: str, seconds: float, seed: int) -> Recording | None:
    """Return the second recording, None for none."""
    if what == "none":
        return None
    if what == "eq22":
        # What follows the first.
        whole = recorded(neck, signal("eq22", duration=2.0 * seconds), 10 * seed + 7)
        return whole.rows(len(whole) // 2, len(whole))
    if what == "mixed":
        return recorded(neck, signal("mixed", duration=seconds, seed=seed), 10 * seed + 8)
    asked = next_experiment(quickly_known(first, seed), duration=seconds, seed=seed)
    print(f"{neck}: {', '.join(str(part.motion) for part in asked.parts)}", flush=True)
    played = Excitation("excite", asked.recording.time, asked.recording.set_points)
    return recorded(neck, played, 10 * seed + 9)


def quickly_known(first: Recording, seed: int) -> Known:
    """Return what four quick models of a recording know, each without another part of it."""
    quick = partial(Network, starts=1, iterations=8, refine=6, prior=0.0)
    parts = enumerate(left_out(first, 4))
    models = [quick(seed=seed + i).fit(a, hold_out=b) for i, (a, b) in parts]
    seen, reach = covering(first.set_points, 200)
    moved = np.sqrt(np.mean(first.set_points.var(axis=0)))
    return Known(
        models=tuple(models), seen=seen, reach=reach, slope=Guarded().unseen * np.nanstd(first.outputs, axis=0) / moved,
        sample_time=first.sample_time, robot=first.robot, said="4 quick models",
    )  # fmt: skip


def worth(model: Model, neck: str, seed: int) -> tuple[float, float]:
    """Return the mean and the least fit [%] over tests and axes, each -100 at least."""
    judged = [validate(model, test, horizons=(INFINITE,)) for test in records_of_tests(neck, seed)]
    fits = [-100.0 if fit is None else max(fit, -100.0) for test in judged for fit in test.fits[INFINITE].values()]
    return float(np.mean(fits)), float(np.min(fits))


def main() -> None:
    """Read the command line, compute what is missing, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="+", choices=CHOOSING, default=["chain", "column"])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seconds", type=float, default=70.0, help="of each recording (70)")
    parser.add_argument("--seed", type=int, default=0, help="of noise, signals and starts (0)")
    parser.add_argument("--fresh", action="store_true", help="compute everything again")
    wanted = parser.parse_args()
    kept = OUT / f"{wanted.seconds:g}s-seed{wanted.seed}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if wanted.fresh:
        kept.unlink(missing_ok=True)
    known = {tuple(line["job"]): line["found"] for line in kept_lines(kept)}
    for neck in wanted.necks:
        first = recorded(neck, signal("eq22", duration=wanted.seconds), 10 * wanted.seed + 1)
        for what in SECOND:
            missing = [kind for kind in wanted.kinds if (neck, what, kind) not in known]
            more = second(what, first, neck, wanted.seconds, wanted.seed) if missing else None
            for kind in missing:
                with threadpool_limits(1):
                    model = KINDS[kind].fit(first if more is None else concatenate([first, more]))
                known[neck, what, kind] = worth(model, neck, wanted.seed)
                keep(kept, {"job": [neck, what, kind], "found": known[neck, what, kind]})
    print(f"\n{'neck':8} {'kind':5} " + " ".join(f"{what:>14}" for what in SECOND) + "   mean (worst axis) [%]")
    for neck in wanted.necks:
        for kind in wanted.kinds:
            cells = [f"{mean:.1f} ({least:.1f})" for mean, least in (known[neck, what, kind] for what in SECOND)]
            print(f"{neck:8} {kind:5} " + " ".join(f"{cell:>14}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
