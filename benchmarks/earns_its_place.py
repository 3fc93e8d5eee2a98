"""Print which kinds earn their place: best by more than the spread of seeds on two robots or more.

`python benchmarks/earns_its_place.py [models|controllers] [--robots ROBOT...] [--kinds KIND...] [--data FOLDER]
[--table]`

`models`: kind by robot. Each excitation is left out in turn; a kind with its defaults is trained on 2,500 rows of the
others and judged by the simulation fit [%] of the worst axis on the one left out. Robots: the foreign necks that choose
(seed: specimen, noise, start of the fit), and with --data the recordings in that folder (seed: rows, start of the fit).
`controllers`: see `earns_its_place_controllers.py`.
Every finished cell is a line of `build/earns_its_place/*.jsonl`; a restart skips it. One core, some hours; --table
prints what is there. The necks that are held out choose nothing and are not here.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.public import pneumatic_trials
from softneck.core import KINDS, SettingsError, SoftneckError, resolve
from softneck.identification import INFINITE, Model, validate
from softneck.signals import Recording, concatenate, import_log, read_layout, signal
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import CHOOSING, ForeignNeck, record

OUT = Path("build/earns_its_place")
LAYOUTS = Path(__file__).parents[1] / "examples" / "layouts"
ROWS, SEEDS = 2500, (0, 1, 2)
EXCITATIONS = ("eq22", "aprbs", "multisine", "rotation")
# Of hardware: the number of parts that are left out in turn.
LOGS = {"openloop": 2, "closedloop": 3, "arm": 3, "pneumatic": 2}
# By cost: cheap ones of all robots first. What is behind the slash is a form, or what it is made of.
TIERS = (
    ("rls", "oe", "nlsm/paper_eq21", "nlsm/residual", "play"),
    ("greybox", "nn"),
    ("guarded/nn",),
)


@dataclass(frozen=True, slots=True)
class Cell:
    """One figure: a kind on a robot, one seed, one excitation or case."""

    robot: str
    kind: str
    seed: int
    case: str


def cells(robots: list[str], kinds: list[str]) -> Iterator[Cell]:
    """Yield all there is to compute, cheap kinds first, one robot after the other."""
    for tier in TIERS:
        for robot in robots:
            cases = [str(part) for part in range(LOGS[robot])] if robot in LOGS else EXCITATIONS
            yield from (
                Cell(robot, kind, seed, case) for seed in SEEDS for case in cases for kind in tier if kind in kinds
            )


@lru_cache(4)
def excitations(robot: str, seed: int, data: Path | None) -> dict[str, Recording]:
    """Return the recordings that are left out in turn."""
    if robot not in LOGS:
        neck = ForeignNeck(name=robot, seed=seed)
        return {
            name: record(signal(name, duration=30.0), neck, seed=10 * seed + n) for n, name in enumerate(EXCITATIONS)
        }
    if data is None:
        raise SettingsError(f"{robot} is a recording: say with --data where it is.")
    if robot == "pneumatic":
        parts = pneumatic_trials(data / "other_robots")
    elif robot == "closedloop":
        layout = read_layout(LAYOUTS / "neck_closedloop.toml")
        names = [f"frontier_test_{grams}gr.csv" for grams in ("000", "400", "1000")]
        parts = [import_log(data / "neck_closedloop" / name, layout).recording for name in names]
    else:
        file, rows = {"openloop": ("neck_openloop/spring_test_0gr.csv", None),
                      "arm": ("arm_multisine/arm_multisine_400s.csv", (0, 20_000))}[robot]  # fmt: skip
        layout = replace(read_layout(LAYOUTS / f"{file.partition('/')[0]}.toml"), rows=rows)
        whole, n = import_log(data / file, layout).recording, LOGS[robot]
        parts = [whole.rows(k * len(whole) // n, (k + 1) * len(whole) // n) for k in range(n)]
    return {str(number): part for number, part in enumerate(parts)}


def training(cell: Cell, data: Path | None) -> Recording:
    """Return 2,500 rows of the excitations but the one left out; those of hardware begin where the seed says."""
    others = [part for case, part in excitations(cell.robot, cell.seed, data).items() if case != cell.case]
    found = []
    for part in others:
        rows = min(len(part), ROWS // len(others))
        start = cell.seed * (len(part) - rows) // (len(SEEDS) - 1) if cell.robot in LOGS else 0
        found.append(part.rows(start, start + rows))
    return concatenate(found)


def trained(cell: Cell, train: Recording) -> Model:
    """Return the model of a cell."""
    kind, _, of = cell.kind.partition("/")
    settings = resolve(KINDS[kind].settings)
    values: dict[str, Any] = {"seed": cell.seed} if "seed" in settings.__dataclass_fields__ else {}
    if kind == "nlsm":
        values |= {"form": of}
    if kind == "guarded":
        values |= {"of": of, "workers": 1}
    return settings(**values).fit(train)


def model_cell(cell: Cell, data: Path | None) -> dict[str, Any]:
    """Return the simulation fits on the excitation left out, and of the worst axis; 0 is that of the mean."""
    model, test = trained(cell, training(cell, data)), excitations(cell.robot, cell.seed, data)[cell.case]
    fits = list(validate(model, test, horizons=(INFINITE,)).fits[INFINITE].values())
    # The arm's second axis drifts, which is in no input.
    judged = fits[:1] if cell.robot == "arm" else fits
    return {"fits": fits, "score": max(0.0, min(-1.0 if fit is None else fit for fit in judged))}


def compute(wanted: list[Cell], kept: Path, found_by: Callable[[Cell], dict[str, Any]]) -> None:
    """Compute the cells that are not kept yet; an error of ours is a result."""
    done = {Cell(**line["cell"]) for line in kept_lines(kept)}
    with threadpool_limits(1):
        for number, cell in enumerate(wanted, start=1):
            if cell in done:
                continue
            begin = time.process_time()
            try:
                found = found_by(cell)
            except SoftneckError as error:
                found = {"failed": str(error), "score": 0.0}
            found["seconds"] = round(time.process_time() - begin, 2)
            keep(kept, {"cell": asdict(cell), "found": found})
            print(f"{number}/{len(wanted)} {cell.robot} {cell.kind} {cell.seed} {cell.case}: {found['score']:.2f}",
                  flush=True)  # fmt: skip


def table(kept: Path, key: str = "score", *, least: bool = False) -> None:
    """Print for each kind and robot the mean over seeds and their standard deviation, then who is best by more.

    A kind is best on a robot where its mean lead over every other kind is above the standard deviation of that lead
    over the seeds; forms of one kind (what is behind the slash) are no rivals.
    """
    by: dict[tuple[str, str], dict[int, list[float]]] = {}
    spent: dict[str, list[float]] = {}
    for line in kept_lines(kept):
        cell, found = Cell(**line["cell"]), line["found"]
        by.setdefault((cell.kind, cell.robot), {}).setdefault(cell.seed, []).append(found.get(key, found["score"]))
        spent.setdefault(cell.kind, []).append(found["seconds"])
    # A seed counts once all its cases are there: half of them are not comparable.
    whole: dict[str, int] = {}
    for (_, robot), seeds in by.items():
        whole[robot] = max(whole.get(robot, 0), *map(len, seeds.values()))
    scores = {where: {seed: mean(cases) for seed, cases in seeds.items() if len(cases) == whole[where[1]]}
              for where, seeds in by.items()}  # fmt: skip
    scores = {where: seeds for where, seeds in scores.items() if seeds}
    kinds, robots = (list(dict.fromkeys(names)) for names in zip(*scores, strict=True))
    print(f"| kind | {' | '.join(robots)} | processor [s] |\n|---|{'---|' * len(robots)}---|")
    for kind in kinds:
        cells = [_shown(list(scores.get((kind, robot), {}).values())) for robot in robots]
        print(f"| `{kind}` | {' | '.join(cells)} | {mean(spent[kind]):.1f} |")
    won: dict[str, list[str]] = {}
    for robot in robots:
        if best := _best({kind: found for (kind, where), found in scores.items() if where == robot}, least):
            won.setdefault(best, []).append(robot)
    for kind, where in won.items():
        print(f"{kind}: best by more than the spread on {', '.join(where)}{'' if len(where) > 1 else ' alone'}")


def _best(scores: dict[str, dict[int, float]], least: bool) -> str:
    """Return the kind that leads over all others by more than the spread over seeds; empty where none does.

    What misses on a seed (an infinite score) loses to what misses on none.
    """
    sign = -1.0 if least else 1.0
    best = max(scores, key=lambda kind: sign * mean(scores[kind].values()))
    if math.inf in scores[best].values():
        return ""
    for kind, rival in scores.items():
        leads = [sign * (scores[best][seed] - rival[seed]) for seed in scores[best] if seed in rival]
        if kind.partition("/")[0] == best.partition("/")[0] or math.inf in leads:
            continue
        if len(leads) < 2 or mean(leads) <= stdev(leads):
            return ""
    return best.partition("/")[0]


def _shown(values: list[float]) -> str:
    missed = values.count(math.inf)
    if missed or not values:
        return f"misses {missed} of {len(values)}" if missed else "-"
    return f"{mean(values):.1f}" + (f" ({stdev(values):.1f})" if len(values) > 1 else "")


def main() -> None:
    """Compute what is missing and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("part", nargs="?", default="models", choices=["models", "controllers"])
    parser.add_argument("--robots", nargs="+", choices=[*CHOOSING, *LOGS])
    parser.add_argument("--kinds", nargs="+")
    parser.add_argument("--data", type=Path, help="folder of recordings from hardware")
    parser.add_argument("--table", action="store_true", help="print what is there, compute nothing")
    asked = parser.parse_args()
    kept = OUT / f"{asked.part}.jsonl"
    OUT.mkdir(parents=True, exist_ok=True)
    if asked.part == "controllers":
        from benchmarks import earns_its_place_controllers as controllers

        wanted = list(controllers.cells(asked.robots or list(CHOOSING), asked.kinds or list(controllers.KINDS_JUDGED)))
        found_by: Callable[[Cell], dict[str, Any]] = controllers.controller_cell
    else:
        robots = asked.robots or [*CHOOSING, *(LOGS if asked.data else ())]
        wanted = list(cells(robots, asked.kinds or [kind for tier in TIERS for kind in tier]))
        found_by = partial(model_cell, data=asked.data)
    if not asked.table:
        compute(wanted, kept, found_by)
    if asked.part == "models":
        table(kept)
    else:
        for key in ("score", "ahead"):
            print(f"\n{key}")
            table(kept, key, least=True)


if __name__ == "__main__":
    main()
