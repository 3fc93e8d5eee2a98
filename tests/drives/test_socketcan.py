"""Frames through real sockets of the kernel (AF_CAN), on a `vcan0` that this process or a namespace of its own has.

Where the kernel has no CAN they are skipped; the guest of `make nightly-can` has it and runs this file, with
`test_others.py` on its third bus.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from softneck.drives import default_drives, open_bus, preflight, scan
from softneck.drives.bus._link import CanLink
from softneck.drives.master import Frame
from softneck.drives.master._fieldbus import BUS_OFF
from softneck.drives.simulated import SimulatedNeck, SimulatedSettings, serve
from softneck.plant import NeckParameters

from .processes import NAMESPACE

# Of this process's network: /sys shows that of whoever mounted it.
HERE = "vcan0" in {name for _, name in socket.if_nameindex()}
on_vcan = pytest.mark.skipif(not HERE, reason="no vcan0 in this network")
# linux/can.h and linux/can/error.h
ERROR, EXTENDED, BUS_OFF_CLASS, RESTARTED = 0x20000000, 0x80000000, 0x40, 0x100
# How a vcan0 of its own is made; whatever fails says why.
MAKE = "ip link set lo up && ip link add vcan0 type vcan && ip link set vcan0 up && exec "


def why_not() -> str:
    """Return why this kernel carries no CAN frames, "" if it does."""
    if not hasattr(socket, "AF_CAN"):
        return "no AF_CAN on this system"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return f"no AF_CAN in this kernel ({errno.errorcode.get(error.errno or 0, '?')})"
    if missing := [name for name in ("unshare", "ip") if shutil.which(name) is None]:
        # What can be installed must be there in CI; a module of its kernel cannot be asked for.
        return "" if os.environ.get("CI") else f"{', '.join(missing)} missing"
    tried = subprocess.run([*NAMESPACE, "sh", "-c", MAKE + "true"], capture_output=True, text=True, check=False)
    return " ".join(tried.stderr.split()) if tried.returncode else ""


@pytest.mark.slow
@pytest.mark.skipif(HERE, reason="vcan0 is here already")
def test_all_of_it_on_a_vcan_of_its_own() -> None:
    if why := why_not():
        pytest.skip(f"{why}; make nightly-can has one")
    files = [str(Path(__file__)), str(Path(__file__).with_name("test_others.py"))]
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", "-k", "socketcan", *files]
    done = subprocess.run([*NAMESPACE, "sh", "-c", MAKE + '"$@"', "sh", *words], capture_output=True, text=True,
                          timeout=300, check=False)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^\d+ passed", done.stdout, re.M), done.stdout


@pytest.fixture
def links() -> Iterator[tuple[CanLink, CanLink]]:
    with open_bus("socketcan:vcan0") as one, open_bus("socketcan:vcan0") as other:
        yield one, other


def raw(identifier: int, data: bytes) -> None:
    """Send a frame past python-can."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as out:
        out.bind(("vcan0",))
        out.send(struct.pack("=IB3x8s", identifier, len(data), data))


@on_vcan
def test_what_one_sends_the_other_hears_and_it_does_not_itself(links: tuple[CanLink, CanLink]) -> None:
    one, other = links
    sent = [Frame(0x80), Frame(0x201, b"\x0f\0\1\2\3\4"), Frame(0x701, b"\0", remote=True)]
    one.send(sent)
    heard = other.receive(1.0)
    assert [(f.identifier, f.remote) for f in heard] == [(0x80, False), (0x201, False), (0x701, True)]
    assert heard[1].data == sent[1].data
    assert one.receive(0.05) == []
    assert not one.problem
    assert not other.problem


@on_vcan
def test_frames_of_29_bits_are_none_of_ours(links: tuple[CanLink, CanLink]) -> None:
    raw(0x201 | EXTENDED, b"\1")
    raw(0x202, b"\2")
    assert [frame.identifier for frame in links[0].receive(1.0)] == [0x202]


@on_vcan
@pytest.mark.parametrize(("kind", "off"), [(BUS_OFF_CLASS, True), (RESTARTED, False)])
def test_an_error_frame_tells_that_the_adapter_left_the_bus(
    links: tuple[CanLink, CanLink], kind: int, off: bool
) -> None:
    raw(kind | ERROR, bytes(8))
    heard = links[0].receive(1.0)
    assert [frame.error for frame in heard] == [True]
    assert (heard[0] == BUS_OFF) is off


@on_vcan
def test_a_bus_that_goes_down_is_said_and_is_a_bus_off(links: tuple[CanLink, CanLink]) -> None:
    one, other = links
    down = subprocess.run(["ip", "link", "set", "vcan0", "down"], check=False)
    if down.returncode:
        pytest.skip("not allowed to switch vcan0 off")
    try:
        one.send([Frame(0x80)])
        assert BUS_OFF in one.receive(0.05)
        assert "down" in one.problem.lower()
        assert BUS_OFF in other.receive(0.05)
    finally:
        subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)


@on_vcan
def test_our_drives_answer_scan_and_pre_flight_on_socketcan(links: tuple[CanLink, CanLink]) -> None:
    neck = SimulatedNeck(NeckParameters.paper(), SimulatedSettings())
    neck.move()
    ended = threading.Event()
    with can.Bus("vcan0", interface="socketcan") as theirs:
        server = threading.Thread(target=serve, args=(theirs, neck), kwargs={"stopped": ended.is_set}, daemon=True)
        server.start()
        try:
            assert [found["node"] for found in scan(links[0])] == [1, 2, 3]
            preflight(links[0], default_drives(), homed=True).require()
        finally:
            ended.set()
            server.join()
