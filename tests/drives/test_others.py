"""Masters and slaves that others wrote: python-canopen on one bus with our simulated drives, and with our master.

Every day on python-can's `virtual`, and on `udp_multicast` where the machine has it: there frames go through sockets,
and come back to whoever sent them. On `vcan0` too where the kernel has it, as in the guest of `make nightly-can`.
"""

from __future__ import annotations

import socket
import threading
import time
import zlib
from collections.abc import Iterator
from functools import cache
from typing import Any

import can
import canopen
import pytest
from canopen.objectdictionary import ODRecord, ODVariable

from softneck.drives.bus._link import CanLink
from softneck.drives.bus._sdo import NUMBERS, Objects, SdoError
from softneck.drives.running._preflight import scan
from softneck.drives.simulated import SimulatedNeck, SimulatedSettings, serve
from softneck.drives.simulated._profiles import PROFILES
from softneck.drives.simulated._quirks import DriveQuirks
from softneck.plant import NeckParameters

# Size and sign -> type number of CiA 301.
TYPES = {(0, False): 0x9, (1, False): 0x5, (2, False): 0x6, (4, False): 0x7, (1, True): 0x2, (2, True): 0x3,
         (4, True): 0x4}  # fmt: skip
VCAN = pytest.mark.skipif(
    "vcan0" not in {name for _, name in socket.if_nameindex()}, reason="no vcan0 in this network (make nightly-can has)"
)
BUSES = ["virtual", "udp_multicast", pytest.param("socketcan", marks=VCAN)]


def dictionary_of(profile: str) -> canopen.ObjectDictionary:
    """Return the objects of our drives as theirs take them."""
    found: Any = canopen.ObjectDictionary()
    items = PROFILES[profile]().items
    for (index, subindex), item in items.items():
        variable: Any = ODVariable(f"{index:04X}h:{subindex}", index, subindex)
        variable.data_type, variable.access_type = TYPES[item.size, item.signed], "rw" if item.writable else "ro"
        variable.default = item.start if item.size else item.text
        if (index, 1) not in items:
            found.add_object(variable)
            continue
        if index not in found:
            found.add_object(ODRecord(f"{index:04X}h", index))
        found[index].add_member(variable)
    return found


def opened(interface: str, name: str) -> can.BusABC:
    if interface == "udp_multicast":
        if why := no_multicast():
            pytest.skip(f"no UDP multicast on this machine: {why}")
        return multicast(20_000 + zlib.crc32(name.encode()) % 10_000)
    return can.Bus("vcan0" if interface == "socketcan" else name, interface=interface)


def multicast(port: int) -> can.BusABC:
    # No hop: what is said here does not leave the machine.
    return can.Bus("239.74.163.2", interface="udp_multicast", port=port, hop_limit=0)


def need_periodic(interface: str) -> None:
    """Skip where the kernel cannot do for python-canopen's slaves what they leave to it: heartbeats."""
    if interface == "socketcan":
        try:
            socket.socket(socket.PF_CAN, socket.SOCK_DGRAM, socket.CAN_BCM).close()
        except OSError as error:
            pytest.skip(f"no can-bcm in this kernel: {error.strerror}")


@cache
def no_multicast() -> str:
    """Return why one bus does not hear another, or nothing."""
    try:
        with multicast(19_999) as one, multicast(19_999) as other:
            one.send(can.Message(arbitration_id=1, is_extended_id=False))
            return "" if other.recv(2.0) else "what one socket sends, another does not hear"
    except (can.CanError, OSError, NotImplementedError, ImportError) as error:
        return str(error)


def wait_for(what: Any, seconds: float = 5.0) -> Any:
    """Wait until `what` returns something; a busy machine is no failure."""
    until = time.monotonic() + seconds
    while not (found := what()) and time.monotonic() < until:
        time.sleep(0.005)
    return found


@pytest.fixture(params=BUSES)
def foreign_master(request: pytest.FixtureRequest) -> Iterator[tuple[SimulatedNeck, canopen.Network]]:
    """Our drives, stricter than they must be, and a network of python-canopen's."""
    name, ended = request.node.name, threading.Event()
    quirks = DriveQuirks(sdo_latency=0.005)
    neck = SimulatedNeck(NeckParameters.paper(), SimulatedSettings(quirks=quirks))
    neck.move()
    network = canopen.Network()
    with opened(request.param, name) as theirs:
        network.bus = opened(request.param, name)
        network.notifier = can.Notifier(network.bus, network.listeners, 0.1)
        server = threading.Thread(target=serve, args=(theirs, neck), kwargs={"stopped": ended.is_set}, daemon=True)
        server.start()
        yield neck, network
        network.disconnect()
        ended.set()
        server.join()


@pytest.mark.slow
def test_a_foreign_master_reads_every_object_of_our_drives(
    foreign_master: tuple[SimulatedNeck, canopen.Network],
) -> None:
    neck, network = foreign_master
    node: Any = network.add_node(2, dictionary_of("ipos2015"))
    axis = neck.drives[1].axis
    for (index, subindex), item in PROFILES["ipos2015"]().items.items():
        data = node.sdo.upload(index, subindex)
        assert len(data) == (item.size or len(axis.device_name if index == 0x1008 else item.text))
        if item.size and (index, subindex) not in axis.getters:
            signed = int.from_bytes(data, "little", signed=item.signed)
            assert signed == axis.values[(index, subindex)], f"{index:04X}h:{subindex}"
    node.sdo.download(0x6081, 0, (1234).to_bytes(4, "little"))
    assert axis.values[(0x6081, 0)] == 1234


@pytest.mark.slow
def test_a_foreign_master_leads_our_drive_through_its_states(
    foreign_master: tuple[SimulatedNeck, canopen.Network],
) -> None:
    neck, network = foreign_master
    node: Any = network.add_node(1, dictionary_of("ipos2015"))
    drive = neck.drives[0]
    # Not canopen's `wait_for_bootup`: it forgets what came before it was called.
    heard: list[int] = []
    node.nmt.add_heartbeat_callback(heard.append)
    node.nmt.state = "RESET"
    assert wait_for(lambda: 0 in heard)
    node.sdo[0x1017].raw = 20
    assert node.nmt.wait_for_heartbeat(5.0) == "PRE-OPERATIONAL"
    # Its own way to map a PDO: switched off, mapped, switched on.
    node.tpdo.read()
    node.tpdo[1].clear()
    node.tpdo[1].add_variable(0x6041)
    node.tpdo[1].add_variable(0x6064)
    node.tpdo[1].trans_type, node.tpdo[1].event_timer, node.tpdo[1].enabled = 255, None, True
    node.tpdo.save()
    node.nmt.state = "OPERATIONAL"
    assert wait_for(lambda: node.tpdo[1].wait_for_reception(1.0))
    assert node.tpdo[1][0x6041].raw & 0x6F == 0x40
    for word, state in ((6, 0x31), (7, 0x33), (15, 0x37)):
        node.sdo[0x6040].raw = word
        assert wait_for(lambda state=state: node.tpdo[1][0x6041].raw & 0x7F == state), hex(node.tpdo[1][0x6041].raw)
    drive.axis.trip(0x4310)
    assert node.emcy.wait(0x4310, 5.0) is not None
    assert node.sdo[0x1003][1].raw == 0x4310
    assert wait_for(lambda: node.tpdo[1][0x6041].raw & 0x08)


@pytest.mark.slow
@pytest.mark.parametrize("interface", BUSES)
@pytest.mark.parametrize("profile", list(PROFILES))
def test_our_master_finds_foreign_slaves_and_writes_and_reads_all_their_objects(
    request: pytest.FixtureRequest, interface: str, profile: str
) -> None:
    """Their slaves hold whatever is written: what we read back is what we wrote, of every size and sign."""
    need_periodic(interface)
    name, objects_held = request.node.name, dictionary_of(profile)
    slaves = canopen.Network()
    slaves.bus = opened(interface, name)
    slaves.notifier = can.Notifier(slaves.bus, slaves.listeners, 0.1)
    try:
        nodes: list[Any] = [slaves.create_node(number, objects_held) for number in (1, 2, 3)]
        for node in nodes:
            node.sdo[0x1000].raw = 0x00020192
            node.sdo[0x1008].raw = f"a slave that others wrote {node.id}"
        with opened(interface, name) as ours:
            link = CanLink(ours, name, echoes=interface == "udp_multicast")
            assert [found["node"] for found in scan(link)] == [1, 2, 3]
            objects = Objects(link, 2)
            assert objects.read_text(0x1008) == "a slave that others wrote 2"
            for (index, subindex), item in PROFILES[profile]().items.items():
                if (index, subindex) in NUMBERS and item.writable:
                    value = -(2 ** (8 * item.size - 1)) if item.signed else 2 ** (8 * item.size) - 1
                    assert objects.write_checked(index, subindex, value) == value, f"{index:04X}h:{subindex}"
            with pytest.raises(SdoError, match="node 2 refuses") as refused:
                objects.write(0x6041, 0, 1)
            assert refused.value.aborted
            with pytest.raises(SdoError, match="node 5 does not answer"):
                Objects(link, 5).read(0x1000)
    finally:
        slaves.disconnect()
