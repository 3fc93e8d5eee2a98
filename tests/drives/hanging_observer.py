"""An observer that never returns after half a second; `processes.py` copies it into its project."""

import pathlib
from time import monotonic, sleep

from softneck.core import load
from softneck.loop import BlockPart

HERE = pathlib.Path(__file__).parent


class Hangs(BlockPart):
    def advance(self, time, inputs):
        if time > 0.5:
            (HERE / "hung").write_text(str(monotonic()))
            while True:
                sleep(1.0)
        return super().advance(time, inputs)


def make():
    return Hangs(load(HERE / "kalman.npz", role="observer").block())
