"""What adapting a model to a neck that changed is worth, and how its numbers were chosen.

`python benchmarks/adaptation.py choose|free|lab [--necks NECK...] [--kinds KIND...]`

`choose` leaves each neck out in turn: models of 100 s of Eq. 22 without payload, adapted to 30 s with one, judged on
other motions under the same payload by the rms error of their free run over that of the choice in the code. `free`
prints fits [%] before, after, and of a refit on 140 s with that payload (oracle). `lab` does the same on the lab's
three payload logs, two runs to adapt to and the third to judge, in turn.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import cache
from pathlib import Path

import numpy as np

from softneck.core import Vector, load, resolve
from softneck.core._kinds import KINDS
from softneck.identification import WARM_UP, Model
from softneck.identification._adapt import Adaptation
from softneck.signals import Recording, concatenate, import_log, read_layout, signal
from tests.foreign_necks.choosing import leave_one_out
from tests.foreign_necks.necks import CHOOSING, ForeignNeck, record

OUT = Path("build/adaptation")
MOTIONS, WINDOWS, LOADS = ("steps", "sine", "rotation", "eq22"), ("rotation", "eq22"), (0.32, 1.0)
ROWS = 1500
CANDIDATES = [Adaptation(strength=s, block=b) for s in (0.01, 0.1, 1.0) for b in (2.0, 10.0)]
CHOSEN = ("oe", "play", "greybox")
# Nobody adapts to a kilogram that is not there: choices are made on one payload, others are for the tables.
CHOOSING_LOAD = 0.5


@cache
def log(neck: str, motion: str, payload: float, seed: int = 5) -> Recording:
    """Return a recording of one specimen, at most 60 s of it."""
    whole = record(signal(motion), ForeignNeck(name=neck, seed=1), seed=seed, payload=payload)
    return whole if seed == 1 else whole.rows(0, 3000)


def trained(neck: str, kind: str, payload: float = 0.0) -> Model:
    """Return a model of 140 s of Eq. 22, kept for the next time."""
    path = OUT / f"{neck}.{kind}.{payload:g}.npz"
    if not path.exists():
        OUT.mkdir(parents=True, exist_ok=True)
        small = {"nn": {"starts": 1}}.get(kind, {})
        resolve(KINDS[kind].settings)(**small).fit(log(neck, "eq22", payload, 1)).save(path)
    return load(path, role="model")


def errors(model: Model, run: Recording) -> Vector:
    """Return the rms error [rad] of the free run (outputs,)."""
    missed = (model.simulate(run)[:, : run.outputs.shape[1]] - run.outputs)[WARM_UP + 1 :]
    return np.sqrt(np.nanmean(missed**2, axis=0))


def fits(pairs: list[tuple[Model, Recording]]) -> str:
    """Return the fits [%] of all runs together, each by its model."""
    missed = np.concatenate([(model.simulate(run)[:, : run.outputs.shape[1]] - run.outputs) for model, run in pairs])
    measured = np.concatenate([run.outputs for _, run in pairs])
    late = np.concatenate([np.arange(len(run)) > WARM_UP for _, run in pairs])
    off, spread = np.sqrt(np.nanmean(missed[late] ** 2, axis=0)), np.nanstd(measured[late], axis=0)
    return "/".join(f"{100.0 * (1.0 - m / s):.1f}" for m, s in zip(off, spread, strict=True))


def scores(neck: str, kind: str, window: str) -> list[float]:
    """Return the rms error [rad] over the other motions of each candidate, kept for the next time."""
    path = OUT / f"{neck}.{kind}.{window}.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    model, seen = trained(neck, kind), log(neck, window, CHOOSING_LOAD).rows(0, ROWS)
    others = [log(neck, motion, CHOOSING_LOAD) for motion in MOTIONS if motion != window]
    found = []
    for candidate in CANDIDATES:
        new = candidate.of(model, seen)
        found.append(float(np.sqrt(np.mean([errors(new, run) ** 2 for run in others]))))
    path.write_text(json.dumps(found), encoding="utf-8")
    return found


def choose(necks: list[str], kinds: list[str]) -> None:
    """Print what each neck left out gets from the others' choice."""
    default = next(i for i, c in enumerate(CANDIDATES) if c == Adaptation())
    found: dict[str, np.ndarray] = {}
    for neck in necks:
        rows = [scores(neck, kind, window) for kind in kinds for window in WINDOWS]
        found[neck] = np.array(rows)
        print(neck, np.round(np.exp(np.mean(np.log(found[neck] / found[neck][:, [default]]), axis=0)), 3), flush=True)
    for fold in leave_one_out(found, default):
        chosen = CANDIDATES[fold.chosen]
        print(f"left out {fold.left_out:8} others choose strength {chosen.strength:g}, blocks of {chosen.block:g} s: "
              f"{fold.ratios[fold.chosen]:.3f} of the code's; its own best {fold.ratios[fold.best]:.3f}")  # fmt: skip
    mean = np.exp(np.mean([np.log(row / row[:, [default]]).mean(axis=0) for row in found.values()], axis=0))
    for candidate, value in zip(CANDIDATES, mean, strict=True):
        print(f"strength {candidate.strength:5g} blocks of {candidate.block:3g} s  {value:.3f}")


def line(head: str, model: Model, oracle: Model | None, shown: list[tuple[Recording, list[Recording]]]) -> None:
    """Print one row of a table: of each window what it is judged on."""
    begun = time.process_time()
    adapted = [model.adapt(window) for window, _ in shown]
    took = (time.process_time() - begun) / len(shown)
    kept = [new.findings["adaptation"]["why"] for new in adapted if not new.findings["adaptation"]["adapted"]]
    before = [(model, run) for _, runs in shown for run in runs]
    after = [(new, run) for new, (_, runs) in zip(adapted, shown, strict=True) for run in runs]
    best = [(oracle, run) for _, run in before] if oracle is not None else [
        (resolve(KINDS[model.kind].settings)().fit(window), run) for window, runs in shown for run in runs]  # fmt: skip
    said = f"  kept: {kept[0]}" if kept else ""
    print(f"{head:40}{fits(before):>14}{fits(after):>14}{fits(best):>14}{took:8.2f} s{said}", flush=True)


def free(necks: list[str], kinds: list[str]) -> None:
    """Print free runs of foreign necks under a payload."""
    print(f"{'judged on':40}{'before':>14}{'after':>14}{'oracle':>14}")
    for neck, kind, payload in ((n, k, p) for n in necks for k in kinds for p in LOADS):
        model, oracle = trained(neck, kind), trained(neck, kind, payload)
        same = log(neck, "rotation", payload, 6)
        shown = [(same.rows(0, 750), [same.rows(750, 1500)])]
        line(f"{neck} {kind} {payload:g} kg, the same", model, oracle, shown)
        others = [log(neck, motion, payload) for motion in MOTIONS[:3]]
        shown = [(log(neck, "eq22", payload).rows(0, ROWS), others)]
        line(f"{neck} {kind} {payload:g} kg, other motion", model, oracle, shown)


def lab(folder: Path, kinds: list[str]) -> None:
    """Print free runs of the lab's logs with a payload, of models of the log without."""
    layout = read_layout(Path(__file__).parents[1] / "examples" / "layouts" / "neck_closedloop.toml")
    logs = {
        payload: import_log(folder / "neck_closedloop" / f"frontier_test_{payload:03}gr.csv", layout).recording
        for payload in (0, 400, 1000)
    }
    print(f"{'judged on the run left out, in turn':40}{'before':>14}{'after':>14}{'refit':>14}")
    for kind in kinds:
        model = resolve(KINDS[kind].settings)().fit(logs[0])
        for payload in (400, 1000):
            runs = logs[payload].runs()
            shown = [
                (concatenate([run for number, run in enumerate(runs) if number != left]), [runs[left]])
                for left in range(len(runs))
            ]
            line(f"{kind} {payload} g", model, None, shown)


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=["choose", "free", "lab"])
    parser.add_argument("--folder", type=Path, help="of the lab's logs")
    parser.add_argument("--necks", nargs="*", choices=CHOOSING)
    parser.add_argument("--kinds", nargs="*", default=list(CHOSEN))
    asked = parser.parse_args()
    if asked.what == "choose":
        choose(asked.necks or list(CHOOSING), asked.kinds)
    elif asked.what == "free":
        free(asked.necks or list(CHOOSING), asked.kinds)
    else:
        if asked.folder is None:
            parser.error("lab needs --folder, which holds `neck_closedloop`")
        lab(asked.folder, asked.kinds)


if __name__ == "__main__":
    main()
