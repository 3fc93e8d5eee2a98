"""An observer that never returns after half a second; `processes.py` copies it into its project."""

import pathlib
import time

from softneck.core import load
from softneck.loop import BlockPart

HERE = pathlib.Path(__file__).parent


class Hangs(BlockPart):
    def advance(self, time_s, inputs):
        if time_s > 0.5:
            (HERE / "hung").write_text(str(time.monotonic()))
            while True:
                time.sleep(1.0)
        return super().advance(time_s, inputs)


def make():
    return Hangs(load(HERE / "kalman.npz", role="observer").block())
