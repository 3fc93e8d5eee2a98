"""Print what everything is worth today, with its defaults, on every neck: the tables of docs/theory/foreign_necks.md.

`python benchmarks/baseline.py [PART...] [--necks NECK...] [--seed N] [--seeds N] [--workers N] [--kept] [--fresh]`

Parts: `models` (worst test axis in free run, `seeds` seeds of noise and start, and what bounds hold), `observer`,
`controllers` (steps of 10 deg), `gains` (by which the tilt must grow until the loop oscillates). Nothing is chosen
here: the two necks that are held out are shown in a block of their own.
Results are kept in `build/baseline`: a run that was stopped goes on where it was. They are of the code that computed
them: use --fresh after a change.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable, Iterable, Mapping
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
from softneck.core import KINDS, SoftneckError, Vector, resolve
from softneck.core._kinds import kinds_of
from softneck.estimation import KalmanSettings
from softneck.identification import INFINITE, Family, FamilySettings, OutputError, validate
from softneck.loop import BlockPart, Loop, LoopResult, Part, StepReference, metrics, run_loop
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block
from softneck.signals import Excitation, Recording, signal
from tests.foreign_necks.held_out import HELD_OUT
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import NECKS, ForeignNeck, record

OURS = ("paper", "rough")
SHOWN = (*OURS, *NECKS)
OUT = Path("build/baseline")
TESTS = ("steps", "sine", "rotation")
AXES = ("pitch", "roll")
# Kinds of model; `srivc` finds what `oe` does here, and `residual` and `ensemble` are made of others.
MODELS = ("rls", "oe", "subspace", "nlsm", "play", "greybox", "nss", "nn")
# What `custom` is made of is one's own.
CONTROLLERS = tuple(kind for kind in kinds_of("controller") if kind != "custom")
# What is judged in loops.
LOOPS = ("controllers", "gains")
# The step, within what every neck can lean under 1 kg; the orientations and payloads at which it is judged.
SIZE = math.radians(10.0)
CASES = [(0.0, 0.0), (90.0, 0.0), (0.0, 1.0), (90.0, 1.0)]
# Factors on the tilt that the controller asks for, and what is called oscillation [deg], peak to peak at the end.
GAINS = [2.0 ** (k / 4) for k in range(1, 17)]
OSCILLATES = 2.0


@dataclass(frozen=True, slots=True)
class Job:
    """One figure to compute.

    Attributes:
        part: one of `PARTS`.
        neck, kind: on which neck, and what.
        seed: of the noise of its recordings, and of starts at random.
    """

    part: str
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


def observer(job: Job) -> dict[str, Any]:
    """Return rms errors over the measured angles without their noise [deg]: of the filter, of the sensor itself."""
    filter_ = KalmanSettings().design(OutputError().fit(training(job.neck, job.seed)))
    errors, raw = [], []
    for noisy, clean in zip(
        records_of_tests(job.neck, job.seed), records_of_tests(job.neck, job.seed, noise=False), strict=True
    ):
        told = filter_.estimate(noisy)
        # A second for the filter to find its feet.
        errors.append((np.column_stack([told.pitch, told.roll]) - clean.outputs)[50:])
        raw.append((noisy.outputs - clean.outputs)[50:])
    return {"filter": _rms_deg(errors), "sensor": _rms_deg(raw)}


@lru_cache(1)
def known(neck: str, seed: int) -> tuple[Recording, Family, Block]:
    """Return what a controller is designed on: 80 s of Eq. 22, the family over payloads to 1 kg, and its observer."""
    excitation = signal("eq22", duration=80.0)
    runs = [recorded(neck, excitation, 10 * seed + 6 + i, payload=kg) for i, kg in enumerate((0.0, 0.5, 1.0))]
    return runs[0], FamilySettings().fit(runs), KalmanSettings().design(OutputError().fit(runs[0])).block()


def controllers(job: Job) -> dict[str, Any]:
    """Return overshoot [%], rise [s] and steady rms [deg] of each case."""
    controller, filter_ = loop_of(job)
    return {"steps": [_figures(_step(job, controller, filter_, angle, kg, 1.0), angle) for angle, kg in CASES]}


def gains(job: Job) -> dict[str, Any]:
    """Return the gain at which the loop oscillates after a step of pitch, without payload."""
    controller, filter_ = loop_of(job)
    return {"gain": _oscillates_at(lambda gain: _step(job, controller, filter_, 0.0, 0.0, gain))}


def loop_of(job: Job) -> tuple[Block, Block]:
    """Return the controller of that kind with its defaults, and the observer."""
    run, family, filter_ = known(job.neck, job.seed)
    # `nmpc` is over a nonlinear model; all others take the uncertain plant.
    plant = softneck.identify("play", run) if job.kind == "nmpc" else family
    return resolve(KINDS[job.kind].settings)().design(plant).block(), filter_


PARTS: dict[str, Callable[[Job], dict[str, Any]]] = {
    "observer": observer, "controllers": controllers, "gains": gains, "models": models,
}  # fmt: skip


class Louder:
    """A plant whose tilt answers `gain` times as much: the tilt in the set-points is multiplied, their mean is not.

    The motors that it shows are those of the set-points it was given: to a controller they follow as ever.
    """

    def __init__(self, plant: Part, gain: float) -> None:
        """Wrap `plant`."""
        self.inputs, self.outputs, self.role = plant.inputs, plant.outputs, plant.role
        self.sample_time = plant.sample_time
        self._plant, self._gain = plant, gain
        names = [port.name for port in plant.outputs]
        self._motors = [names.index(f"motor_position_{j}") for j in (1, 2, 3)]
        self.close = plant.close

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Begin a run."""
        return self._shown(self._plant.start(time, parameters))

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once."""
        mean = inputs[:3].mean()
        return self._shown(
            self._plant.advance(time, np.concatenate([mean + self._gain * (inputs[:3] - mean), inputs[3:]]))
        )

    def _shown(self, outputs: Vector) -> Vector:
        motors = outputs[self._motors]
        outputs[self._motors] = motors.mean() + (motors - motors.mean()) / self._gain
        return outputs


def _step(job: Job, controller: Block, filter_: Block, angle: float, payload: float, gain: float) -> LoopResult:
    own = VirtualNeck(NeckParameters.preset(job.neck)) if job.neck in OURS else ForeignNeck(name=job.neck)
    plant = BlockPart(own.block(noise_seed=job.seed))
    pitch, roll = (SIZE, 0.0) if angle == 0.0 else (0.0, SIZE)
    return run_loop(
        Loop(
            # A block of ours runs compiled with the rest of the loop, a wrapped one does not.
            plant=plant if gain == 1.0 else Louder(plant, gain),
            controller=BlockPart(controller),
            observer=BlockPart(filter_),
            reference=StepReference(pitch=pitch, roll=roll, at=2.0),
            duration=10.0,
            plant_inputs={"payload": payload},
        )
    )


def _figures(result: LoopResult, angle: float) -> list[float | None]:
    found = metrics(result)
    stepped = found[AXES[0] if angle == 0.0 else AXES[1]]
    steady = [found[axis]["steady_rms_deg"] for axis in AXES]
    return [stepped["overshoot_pct"], stepped["rise_s"], max(value for value in steady if value is not None)]


def _oscillates_at(run: Callable[[float], LoopResult]) -> float | None:
    """Return the least of `GAINS` at which the angles do not come to rest, by bisection; None where all do."""
    low, high = -1, len(GAINS)
    while high - low > 1:
        middle = (low + high) // 2
        late = {axis: np.degrees(run(GAINS[middle])[axis][-100:]) for axis in AXES}
        if max(np.ptp(y) for y in late.values()) > OSCILLATES:
            high = middle
        else:
            low = middle
    return None if high == len(GAINS) else GAINS[high]


def _rms_deg(errors: list[np.ndarray]) -> float:
    return float(np.degrees(np.sqrt(np.nanmean(np.concatenate(errors) ** 2))))


def jobs(parts: Iterable[str], necks: Iterable[str], seed: int, seeds: int) -> list[Job]:
    """Return all there is to compute."""
    kinds = {"models": MODELS, "observer": ("kalman",), "controllers": CONTROLLERS, "gains": CONTROLLERS}
    return [
        Job(part, neck, kind, seed + k)
        for k in range(seeds)
        for neck in necks
        for part in parts
        for kind in kinds[part]
        # Noise is small beside a step: one loop says how a controller does.
        if part not in LOOPS or k == 0
    ]


def computed(unit: list[Job], kept: Path) -> list[dict[str, Any]]:
    """Return what the jobs of one neck and seed find, or why they find nothing, and their seconds; keep each."""
    results = []
    # One thread each: there are as many processes as cores.
    with threadpool_limits(1):
        for job in unit:
            begin = time.process_time()
            try:
                found = PARTS[job.part](job)
            except SoftneckError as error:
                found = {"failed": str(error)}
            results.append({**found, "seconds": round(time.process_time() - begin, 1)})
            keep(kept, {"job": astuple(job), "found": results[-1]})
    return results


def compute(wanted: list[Job], workers: int, *, fresh: bool) -> dict[Job, dict[str, Any]]:
    """Return the result of every job; what an earlier run has computed is read."""
    kept = OUT / "results.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        kept.unlink(missing_ok=True)
    results = _known(kept)
    # Those of one neck and seed share their recordings.
    units: dict[tuple[str, bool, int], list[Job]] = {}
    for job in wanted:
        if job not in results:
            units.setdefault((job.neck, job.part in LOOPS, job.seed), []).append(job)
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
    for part, title, cell in TABLES:
        rows = []
        for kind in dict.fromkeys(job.kind for job in found if job.part == part):
            each = [
                [r for job, r in found.items() if (job.part, job.kind, job.neck) == (part, kind, neck)]
                for neck in necks
            ]
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


def _observed(results: list[dict[str, Any]]) -> str:
    return " / ".join(f"{median(r[name] for r in results):.3f}" for name in ("filter", "sensor"))


def _controlled(results: list[dict[str, Any]]) -> str:
    if "failed" in results[0]:
        return "no design"
    over, rise, steady = (
        max(math.inf if value is None else value for value in column)
        for column in zip(*results[0]["steps"], strict=True)
    )
    return f"{_number(over)}, {_number(rise, 2)}, {_number(steady, 2)}"


def _oscillating(results: list[dict[str, Any]]) -> str:
    if "failed" in results[0]:
        return "no design"
    gain = results[0]["gain"]
    if gain is None:
        return f"> {GAINS[-1]:g}"
    # At the least that was tried: perhaps it does so as it is.
    return f"<= {gain:.1f}" if gain == GAINS[0] else f"{gain:.1f}"


def _number(value: float, places: int = 0) -> str:
    return f"{value:.{places}f}" if math.isfinite(value) else "-"


TABLES = (
    ("models", "Models: worst axis of the tests in free run [%], median of the seeds (worst seed)", _worst_axis),
    ("models", "Bounds: samples of the tests held in free run [%], least axis, and mean width [deg]", _held),
    ("observer", "Observer: rms error on the tests [deg], filter / sensor", _observed),
    ("controllers", "Controllers: worst overshoot [%], rise [s] and steady rms [deg] of steps of 10 deg", _controlled),
    ("gains", "Controllers: factor on the tilt at which the loop oscillates", _oscillating),
)


def main() -> None:
    """Read the command line, compute what is missing, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--necks", nargs="+", choices=SHOWN, default=list(SHOWN))
    parser.add_argument("--seed", type=int, default=0, help="the first (0)")
    parser.add_argument("--seeds", type=int, default=5, help="how many (5)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (all cores)")
    parser.add_argument("--kept", action="store_true", help="compute nothing: print what is there")
    parser.add_argument("--fresh", action="store_true", help="compute everything again")
    wanted = parser.parse_args()
    if unknown := set(wanted.parts) - set(PARTS):
        parser.error(f"unknown part `{sorted(unknown)[0]}`; use {', '.join(PARTS)}")
    asked = jobs(wanted.parts or list(PARTS), wanted.necks, wanted.seed, wanted.seeds)
    if wanted.kept:
        results = _known(OUT / "results.jsonl")
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
