"""Drives stopped and reset from outside of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from softneck.core import CheckFailedError

from ..bus._file import DrivesFile
from ..bus._link import GuardedLink, Link
from ..bus._objects import disarm_writes
from ..bus._sdo import Objects, SdoError
from ..master import Frame
from ..master._cia402 import OFF, DriveState, state_of
from ._preflight import require_alone, require_bus

# Between two looks at a drive [s].
_POLL_S = 0.02


def wait(link: Link, seconds: float) -> None:
    """Let time pass and discard received frames."""
    until = link.now + seconds
    while link.now < until - 1e-9:
        link.receive(until - link.now)


def stop(link: Link, file: DrivesFile) -> dict[int, str]:
    """Quick stop, then no voltage, for every drive that answers; return node -> state after it.

    Raises:
        BusError: the bus takes no frames: nobody was stopped.
    """
    drives = {entry.node: Objects(link, entry.node) for entry in file.drives}
    # At once and to all, without waiting for answers; then with answers.
    for word in (0x02, 0x02):
        link.send([Frame(0x600 + node, bytes([0x2B, 0x40, 0x60, 0, word, 0, 0, 0])) for node in drives])
    require_bus(link)
    wait(link, 0.5)
    states = {}
    for node, objects in drives.items():
        try:
            objects.write(0x6040, 0, 0x00)
            states[node] = state_of(objects.read(0x6041)).name
        except SdoError:
            states[node] = "no answer"
    return states


def reset(link: Link, file: DrivesFile) -> dict[int, str]:
    """Acknowledge latched faults, the only place where that happens; return node -> state after it.

    Raises:
        CheckFailedError: another master is on the bus; nothing was sent.
        BusError: the bus takes no frames.
    """
    require_alone(link)
    states = {}
    for entry in file.drives:
        objects = Objects(link, entry.node)
        try:
            for word in (0x00, 0x80, 0x00):
                objects.write(0x6040, 0, word)
                wait(link, _POLL_S)
            states[entry.node] = state_of(objects.read(0x6041)).name
        except SdoError:
            states[entry.node] = "no answer"
        require_bus(link)
    return states


def disarm(link: Link, file: DrivesFile, guarding: str, signs: Sequence[Frame]) -> dict[int, str]:
    """End the guarding of drives that are off, feeding it until the last one is disarmed.

    Args:
        link: to the bus.
        file: of the drives.
        guarding: "life" or "heartbeat", as the pre-flight set it up.
        signs: of life, to send meanwhile.

    Returns:
        node -> why it is not known to be off; empty where all confirmed it.
    """
    guarded = GuardedLink(link, signs, file.guard_cycles * file.cycle)
    left = {}
    for node in file.nodes:
        objects = Objects(guarded, node)
        try:
            for write in disarm_writes(guarding):
                objects.write(*write)
        except SdoError as error:
            left[node] = str(error).rstrip(".")
    for node in [node for node in file.nodes if node not in left]:
        try:
            state = state_of(Objects(guarded, node).read(0x6041))
        except SdoError as error:
            left[node] = str(error).rstrip(".")
            continue
        if state not in OFF:
            left[node] = f"it is in {state.name}"
    return left


# Where the motor surely has no current. A drive in REACTION or QUICK_STOP still brakes.
_OFF = {*OFF, DriveState.FAULT}


def require_stopped(states: Mapping[int, str]) -> None:
    """Raise CheckFailedError if a drive that `stop` spoke to may still have power."""
    powered = [f"node {node}: {state}" for node, state in states.items() if state not in {one.name for one in _OFF}]
    if powered:
        raise CheckFailedError(f"{', '.join(powered)}: not stopped for sure. Press the hardware stop (Enable input).")


def require_reset(states: Mapping[int, str]) -> None:
    """Raise CheckFailedError if a drive is still in Fault, or did not answer `reset`."""
    left = [f"node {node}: {state}" for node, state in states.items() if state in ("no answer", DriveState.FAULT.name)]
    if left:
        raise CheckFailedError(
            f"{', '.join(left)} after the reset. Is the hardware stop released, is the drive on, is its number right?"
        )
