"""Print what `softneck start` certifies of one recording, beside the loop that it delivers on the true plant.

`python benchmarks/promises.py [--necks NECK...]`

The recording is of `mixed` around 1.5 rad of co-contraction. Projects are kept in `build/promises`: remove them after a
change. Nothing is chosen here.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import softneck
from softneck.core import Vector
from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import Block
from softneck.signals import Excitation, Recording, SetPointLimits, prepare, signal
from softneck.signals.recording._files import write_recording
from softneck.verification import make_requirements
from softneck.verification._experiments import LoopUnderTest, crossing_values, crossings
from softneck.verification._neck_loops import SimulationModel, run_loops
from tests.foreign_necks.necks import NECKS, ForeignNeck
from tests.foreign_necks.necks import record as record_foreign

# Co-contraction of the recording [rad], the steps of the truth, and what is compared.
COCONTRACTION, LARGEST = 1.5, 6.0  # LARGEST is where motors end
STEPS_OF_TRUTH = {"payloads_kg": [0.0], "orientations_deg": [45.0 * k for k in range(8)], "duration_s": 6.0}
STEPS = ("sim.rise_s", "sim.overshoot_pct", "sim.settling_s", "sim.steady_rms_deg")
MARGINS = ("axes.gain_margin", "axes.delay_margin_ms")
OURS = ("paper", "rough")
SHOWN = (*OURS, *NECKS)
OUT = Path("build/promises")


def block_of(neck: str, noise: bool, seed: int = 0) -> Block:
    """Return one of our necks or a foreign one as a plant."""
    if neck in OURS:
        own = NeckParameters.preset(neck)
        return VirtualNeck(own if noise else own.without_noise()).block(noise_seed=seed)
    return ForeignNeck(name=neck, noise=noise).block(noise_seed=seed)


class Sensed(BlockPart):
    """A neck whose angles are those that its sensor tells: how the sensor is turned on it no recording knows."""

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the outputs at the start."""
        return self._told(super().start(time, parameters))

    def step(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the outputs."""
        return self._told(super().step(time, inputs))

    def _told(self, outputs: Vector) -> Vector:
        names = [port.name for port in self.outputs]
        told = outputs.copy()
        for axis in ("pitch", "roll"):
            told[names.index(axis)] = outputs[names.index(f"{axis}_measured")]
        return told


def recorded(neck: str, excitation: Excitation, seed: int, payload: float, common: float) -> Recording:
    """Return a recording of one of our necks or of a foreign one, played around a co-contraction [rad]."""
    around = replace(excitation, set_points=excitation.set_points + common)
    played, _ = prepare(around, SetPointLimits(position=LARGEST))
    if neck in OURS:
        return record(played, VirtualNeck(NeckParameters.preset(neck)), seed=seed, payload=payload)
    return record_foreign(played, ForeignNeck(name=neck), seed=seed, payload=payload)


def _number(value: Any) -> float:
    """Return a number; what is not known is none."""
    return math.inf if value == "inf" else math.nan if value is None else float(value)


def started(neck: str) -> Path:
    """Return the project that `softneck start` makes of one recording of a neck; made once and kept."""
    folder, log = OUT / f"{neck}_start", OUT / f"{neck}_start.csv"
    if not (folder / "start.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_recording(log, recorded(neck, signal("mixed", seed=1), 1, 0.0, COCONTRACTION), force=True)
        command = [sys.executable, "-m", "softneck", "start", str(log), "-o", str(folder), "--yes"]
        subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return folder


def delivered(neck: str, folder: Path) -> dict[str, float]:
    """Return metric -> the worst value of the loop that a project delivers, on the neck itself."""
    controller = softneck.load(folder / "tune/best.npz")
    told = tomllib.loads((folder / "tune/loop.toml").read_text(encoding="utf-8"))
    observer = softneck.load(folder / "tune/observer.npz").block() if "observer" in told else None
    order = str(getattr(controller, "order", "sequential"))
    own = SimulationModel(
        name=neck, payload="inputs", make=lambda seed, _: Sensed(block_of(neck, noise=True, seed=seed)),
        quiet=lambda _: Sensed(block_of(neck, noise=False)),
    )  # fmt: skip
    runs = run_loops(controller.block(), make_requirements({"sim": STEPS_OF_TRUTH}), order=order, observer=observer,
                     seed=0, progress=softneck.core.silent, own=[own])  # fmt: skip
    loop = LoopUnderTest(name=neck, plant=lambda: BlockPart(block_of(neck, noise=False)), controller=controller.block(),
                         observer=observer, order=order, constants={"plant_inputs": {"payload": 0.0}})  # fmt: skip
    margins = crossing_values(crossings([loop], overall=True))
    steps = {name: max(run.metrics[name.partition(".")[2]] for run in runs) for name in STEPS}
    return steps | {name: float(margins[name][0].min()) for name in MARGINS}


def table(necks: Sequence[str]) -> None:
    """Print certified and true values of what `softneck start` delivers, and how many are true."""
    names = (*STEPS, *MARGINS)
    head = " | ".join(f"{name}: certified, true" for name in names)
    print(f"| neck | loosened | {head} |\n|{'---|' * (2 + len(names))}")
    within, below, farthest, total = 0, 0, 0.0, 0
    for neck in necks:
        folder = started(neck)
        file, true = folder / "tune/best.certificate.json", delivered(neck, folder)
        told = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"requirements": [], "loosened": {}}
        rows = {row["metric"]: row for row in told["requirements"]}
        eased = ", ".join(told["loosened"]) or ("none" if rows else "no certificate")
        cells = [f"{_number(rows[n]['value']):.3g}, {true[n]:.3g}" if n in rows else f"-, {true[n]:.3g}" for n in names]
        print(f"| `{neck}` | {eased} | {' | '.join(cells)} |", flush=True)
        for name in (name for name in names if name in rows):
            limit, value = _number(rows[name]["limit"]), rows[name]["value"]
            value = math.inf if value is None and name in MARGINS else _number(value)  # no end of it was found
            sign = -1.0 if name in MARGINS else 1.0
            within += sign * true[name] <= sign * limit
            below += sign * true[name] <= sign * value
            farthest, total = max(farthest, sign * (true[name] - value) / limit), total + 1
    print(f"\ntrue within the certified limit: {within} of {total}; within the certified value: {below} of {total}, "
          f"the farthest by {100.0 * farthest:.0f} % of its limit")  # fmt: skip


def main() -> None:
    """Compute and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--necks", nargs="*", default=SHOWN, choices=SHOWN)
    table(parser.parse_args().necks)


if __name__ == "__main__":
    main()
