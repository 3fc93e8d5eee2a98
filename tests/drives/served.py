"""`softneck ARGUMENTS` with simulated drives on the bus `virtual:served` in the same process; for tests over a pty.

The first argument is a file for how the drives ended; the bus counts as one that moves something.
"""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path

import can

import softneck.cli.drives._target
from softneck.cli._main import run
from softneck.drives.simulated import SimulatedNeck, SimulatedSettings, serve
from softneck.plant import NeckParameters


def main() -> int:
    softneck.cli.drives._target.HARMLESS = ()  # pyright: ignore[reportPrivateImportUsage]
    ended = threading.Event()
    with can.Bus("served", interface="virtual") as theirs:
        neck = SimulatedNeck(NeckParameters.paper(), SimulatedSettings(homed=True))
        server = threading.Thread(target=serve, args=(theirs, neck), kwargs={"stopped": ended.is_set}, daemon=True)
        server.start()
        powered: list[bool] = []
        any_powered: list[bool] = []

        def watch() -> None:
            while not ended.wait(0.02):
                if any(drive.axis.state == 0x27 for drive in neck.drives) and not any_powered:
                    any_powered.append(True)
                    print("ANY POWER", flush=True)
                if all(drive.axis.state == 0x27 for drive in neck.drives) and not powered:
                    powered.append(True)
                    print("POWERED", flush=True)

        threading.Thread(target=watch, daemon=True).start()
        code = run(sys.argv[2:])
        ended.set()
        server.join()
    states = [drive.axis.state for drive in neck.drives]
    Path(sys.argv[1]).write_text(json.dumps({"states": states, "powered": bool(powered)}), encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())
