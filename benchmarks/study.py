"""Print the figures of studies: `python benchmarks/study.py [speed|memory|rows]`.

`speed`: 1,000 loops of 10 s at 100 Hz over the virtual neck, on one and on two workers, with the processor's share.
`memory`: resident memory of the parent and of its worker over 10,000 short runs.
`rows`: what a loop costs in Python and as compiled rows, over the virtual neck and over an identified model.
Times are wall time, which other work on the machine lengthens: the load is printed beside.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import control
import psutil

from softneck.core import file_hash
from softneck.cosim import make_loop, simulate, study
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings, LinearNeck
from softneck.identification import Rls
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import signal


def loop(sample_time: float, duration: float) -> dict[str, Any]:
    """Return a loop of the virtual neck, a Kalman filter and a PI controller on Eq. 31's plant."""
    pole = math.exp(-5.293 * sample_time)
    tf = control.TransferFunction([0.09 * (1.0 - pole)], [1.0, -pole] + [0.0] * round(0.04 / sample_time), sample_time)
    model = LinearNeck(pitch=tf, roll=tf)
    return {
        "duration_s": duration, "sample_time_s": sample_time, "plant": "paper",
        "observer": KalmanSettings(sensor="paper").design(model), "controller": PiSettings().design(model),
        "reference": {"kind": "step", "pitch_deg": 10.0, "at_s": 0.1 * duration},
    }  # fmt: skip


VARY: dict[str, Any] = {
    "plant.parameters.payload": {"uniform": [0.0, 0.3]},
    "plant.parameters.bending_stiffness": {"normal": [0.61, 0.05]},
    "plant.parameters.noise_seed": {"seed": True},
    "reference.pitch_deg": [5.0, 15.0],
}


def speed(runs: int = 1000) -> None:
    """Print wall times and the speed-up."""
    described = loop(0.01, 10.0)
    study(described, vary=VARY, runs=4, workers=0)  # what is compiled once is not timed
    times, sums = {}, {}
    for workers in (1, 2):
        before, begin = os.times(), time.perf_counter()
        frame: Any = study(described, vary=VARY, runs=runs, seed=1, workers=workers)
        times[workers], after = time.perf_counter() - begin, os.times()
        used = sum(after[:4]) - sum(before[:4])
        sums[workers] = frame["pitch.iae"].sum()
        print(
            f"{runs} loops, {workers} worker(s): {times[workers]:.1f} s wall, {used:.1f} s processor, "
            f"mean of a run {1e3 * frame['seconds'].mean():.1f} ms, load {os.getloadavg()[0]:.1f}", flush=True,
        )  # fmt: skip
    print(f"speed-up on two workers: {times[1] / times[2]:.2f}; equal numbers: {sums[1] == sums[2]}")


def memory(runs: int = 10_000) -> None:
    """Print resident memory over short runs."""
    here, seen = psutil.Process(), []

    def look(done: float, word: str) -> None:
        del word
        if int(done * 10) > len(seen):
            workers = [child for child in here.children(recursive=True) if child.memory_info().rss > 50e6]
            seen.append(done)
            sizes = " ".join(f"{child.memory_info().rss / 1e6:.0f}" for child in workers)
            print(f"{done:5.0%}: parent {here.memory_info().rss / 1e6:.0f} MB, worker {sizes} MB", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        study(loop(0.02, 0.2), vary=VARY, runs=runs, workers=1, output=Path(folder) / "study", report=look)
        print("runs.csv", file_hash(Path(folder) / "study" / "runs.csv")[:8])


def rows() -> None:
    """Print the processor time of one loop, in Python and compiled."""
    recording = record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=1)
    model = Rls().fit(recording)
    parts = {"observer": KalmanSettings(sensor="paper").design(model), "controller": PiSettings().design(model)}
    identified = {**loop(0.02, 10.0), "plant": model, **parts}
    for name, described in (("virtual neck, 1,000 rows", loop(0.01, 10.0)), ("rls model, 500 rows", identified)):
        setup = make_loop(described)
        for compiled in (False, True):
            simulate(setup, compiled=compiled)
            begin = time.process_time()
            for _ in range(30):
                simulate(setup, compiled=compiled)
            cost = 1e3 * (time.process_time() - begin) / 30
            print(f"{name}: {'compiled' if compiled else 'Python'} {cost:.2f} ms")


if __name__ == "__main__":
    for what in sys.argv[1:] or ["rows", "speed", "memory"]:
        {"speed": speed, "memory": memory, "rows": rows}[what]()
