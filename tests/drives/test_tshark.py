"""Every frame of a run, decoded by Wireshark's CANopen dissector, says what we think that it says."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from pathlib import Path

import pytest

from softneck.drives import default_drives, preflight, simulated_neck
from softneck.drives.bus._link import VirtualLink
from softneck.drives.master import Frame
from softneck.drives.master._fieldbus import NodeState
from softneck.plant import NeckParameters

from .bench import Bench

_LINK_CAN = 227  # LINKTYPE_CAN_SOCKETCAN
_FIELDS = (
    "can.flags.rtr", "canopen.cob_id", "canopen.node_id", "canopen.pdo.data.bytes", "canopen.sdo.main_idx",
    "canopen.sdo.sub_idx", "canopen.sdo.data.bytes", "canopen.sdo.abort_code", "canopen.em.err_code",
    "canopen.nmt_ctrl.cd", "canopen.nmt_ctrl.node_id", "canopen.nmt_guard.state", "canopen.nmt_guard.toggle",
    "_ws.malformed",
)  # fmt: skip


@pytest.fixture(scope="module")
def tshark() -> str:
    found = shutil.which("tshark")
    if found is None:
        if os.environ.get("CI"):
            pytest.fail("tshark is missing; `.ci/run` installs it")
        pytest.skip("tshark is not installed")
    return found


def traffic() -> list[Frame]:
    """Pre-flight with its SDO transfers, a run, an emergency, a boot-up, a stop."""
    frames: list[Frame] = []
    file = default_drives()
    link = VirtualLink(simulated_neck(file, NeckParameters.paper(), sample_time=0.02, homed=False))
    link.tap = lambda _now, _from_master, frame: frames.append(frame)
    preflight(link, file, homed=True)
    bench = Bench()
    bench.link.tap = link.tap
    bench.start()
    bench.neck.drives[1].axis.trip(0x2310)
    bench.pass_time(0.1)
    bench.neck.drives[2].power_cycle(bench.now)
    bench.pass_time(0.1)
    return frames


def write_pcap(path: Path, frames: list[Frame]) -> None:
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, _LINK_CAN))
        for k, frame in enumerate(frames):
            data = b"" if frame.remote else frame.data
            head = struct.pack(">IBBBB", frame.identifier | (0x40000000 if frame.remote else 0), len(data), 0, 0, 0)
            packet = head + data
            file.write(struct.pack("<IIII", k // 1000, k % 1000 * 1000, len(packet), len(packet)) + packet)


def decoded(tool: str, path: Path) -> list[dict[str, str]]:
    command = [tool, "-r", str(path), "-d", "can.subdissector,canopen", "-T", "fields", "-E", "separator=;"]
    for field in _FIELDS:
        command += ["-e", field]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return [dict(zip(_FIELDS, line.split(";"), strict=True)) for line in done.stdout.splitlines()]


def number(text: str) -> int:
    return int(text, 0)


def plain(text: str) -> str:
    return text.replace(":", "")


def test_wireshark_reads_our_frames_as_we_do(tshark: str, tmp_path: Path) -> None:
    frames = traffic()
    write_pcap(tmp_path / "run.pcap", frames)
    rows = decoded(tshark, tmp_path / "run.pcap")
    assert len(rows) == len(frames)
    seen: dict[str, int] = {}
    for frame, row in zip(frames, rows, strict=True):
        assert not row["_ws.malformed"], (frame, row)
        kind = compare(frame, row)
        seen[kind] = seen.get(kind, 0) + 1
    # All that CANopen has on this wire came by.
    assert set(seen) == {"rtr", "nmt", "sync", "emergency", "pdo", "sdo", "boot", "guard"}


def compare(frame: Frame, row: dict[str, str]) -> str:
    """Assert that one frame is the same in both eyes; return its kind."""
    identifier, data = frame.identifier, frame.data
    assert (row["can.flags.rtr"] in ("1", "True")) == frame.remote
    if frame.remote:
        return "rtr"
    base, node = identifier & 0x780, identifier & 0x7F
    assert number(row["canopen.cob_id"]) == identifier
    if identifier == 0:
        assert (number(row["canopen.nmt_ctrl.cd"]), number(row["canopen.nmt_ctrl.node_id"])) == (data[0], data[1])
        return "nmt"
    if identifier == 0x80:
        return "sync"
    assert number(row["canopen.node_id"]) == node
    if base == 0x80:
        assert number(row["canopen.em.err_code"]) == int.from_bytes(data[:2], "little")
        return "emergency"
    if base in (0x580, 0x600):
        if data[0] >> 5 in (1, 2) or (base == 0x580 and data[0] >> 5 == 3):
            place = struct.unpack_from("<HB", data, 1)
            if row["canopen.sdo.main_idx"]:
                assert (number(row["canopen.sdo.main_idx"]), number(row["canopen.sdo.sub_idx"])) == place
        if data[0] == 0x80:
            assert number(row["canopen.sdo.abort_code"]) == int.from_bytes(data[4:], "little")
        return "sdo"
    if base == 0x700:
        if data[0] == 0:
            return "boot"
        assert number(row["canopen.nmt_guard.state"]) == data[0] & 0x7F
        assert NodeState(data[0] & 0x7F) is not NodeState.UNKNOWN
        return "guard"
    assert plain(row["canopen.pdo.data.bytes"]) == data.hex()
    return "pdo"
