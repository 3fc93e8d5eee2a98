"""Memory of a long run: the rows of a neck at 100 Hz, fed at full speed, then its recording.

    python benchmarks/long_run.py --hours 24 --written 24

feeds the log of `softneck drives run` as the loop on the bus does, and prints the memory of this process beside its
files (RssAnon) while it runs. The recording of runs up to `--written`
hours is written too.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from softneck.drives.logs._result import recording_of
from softneck.drives.running._pilot import RunLog
from softneck.signals import NECK, write_recording

CYCLE_S = 0.01


def memory() -> float:
    """Return the memory of this process that is in no file [MB]."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024.0


class Peak:
    """Most memory [MB] while it is open, looked at every 20 ms."""

    def __enter__(self) -> Peak:
        """Begin."""
        self.most, self._done = memory(), threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()
        return self

    def _look(self) -> None:
        while not self._done.wait(0.02):
            self.most = max(self.most, memory())

    def __exit__(self, *_: object) -> None:
        """End."""
        self._done.set()
        self._thread.join()


def feed(hours: float, folder: Path) -> RunLog:
    """Return the log of a run of so many hours."""
    signals = np.linspace(0.0, 0.1, 40)
    pilot: Any = SimpleNamespace(robot=NECK, signals=signals, slot=lambda part, name: len(part + name) % 40)
    log, rows = RunLog(pilot, truth=False, folder=folder), round(3600.0 * hours / CYCLE_S)
    tilt = SimpleNamespace(values=(0.01, 0.02), rates=(0.0, 0.0))
    master: Any = SimpleNamespace(ran=True, tilt=tilt, tensions=(1.0, 2.0, 3.0))
    for k in range(rows):
        master.index, master.positions = k, (1e-6 * k, 2e-6 * k, 3e-6 * k)
        log.take(CYCLE_S * k, master, None)
    return log


def main() -> None:
    """Print the memory of the run and of its end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--written", type=float, default=0.0)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=".") as name:
        folder = Path(name)
        for hours in (0.1, asked.hours):
            began, before = time.monotonic(), memory()
            with Peak() as run:
                log = feed(hours, folder)
            with Peak() as end:
                result, speeds, _ = log.finish(CYCLE_S)
            print(
                f"{hours:g} h, {len(result.time)} rows: {before:.0f} MB before, at most {run.most:.0f} MB while it "
                f"ran, {end.most:.0f} MB at its end ({time.monotonic() - began:.0f} s)",
                flush=True,
            )
            if hours <= asked.written:
                recording, path = recording_of(result, speeds), folder / f"{hours:g}.csv"
                before = memory()
                with Peak() as written:
                    write_recording(path, recording)
                size = path.stat().st_size / 2**20
                print(f"  {size:.0f} MB written: {before:.0f} MB before, at most {written.most:.0f} MB", flush=True)


if __name__ == "__main__":
    main()
