"""A hostile file is one line, exit code 2, in under 2 s of work and under 500 MB, whichever command reads it."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from ..data import ROOT

pytestmark = pytest.mark.slow  # a process each, and Python's start is most of it

TITLES = "time [s],motor_setpoint_1 [rad],motor_setpoint_2 [rad],motor_setpoint_3 [rad],pitch [deg],roll [deg]\n"
LOG = (TITLES + "".join(f"{k * 0.02:.2f},0,0,0,1,2\n" for k in range(300))).encode()
# What the issue of hostile files asks. The time is that of the processor: other work on the machine is not ours.
SECONDS, MEGABYTES = 2.0, 500
_RUN = "import sys; from softneck.cli import main; main(sys.argv[1:])"
# The kernel counts the memory of whoever starts a process as its own: so a small process starts the command.
_MEASURED = """
import json, os, resource, sys
with open("stderr", "wb") as errors, open("stdout", "wb") as out:
    to = [(os.POSIX_SPAWN_DUP2, out.fileno(), 1), (os.POSIX_SPAWN_DUP2, errors.fileno(), 2)]
    pid = os.posix_spawn(sys.executable, [sys.executable, "-c", *sys.argv[1:]], os.environ, file_actions=to)
    # Where a budget fails the machine must not.
    resource.prlimit(pid, resource.RLIMIT_AS, (6 * 2**30, 6 * 2**30))
    resource.prlimit(pid, resource.RLIMIT_CPU, (20, 20))
    _, status, usage = os.wait4(pid, 0)
print(json.dumps([os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024]))
"""


def run(folder: Path, arguments: list[str]) -> tuple[int, str, float, float]:
    """Return exit code, standard error, seconds of processor and megabytes of one command in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", _MEASURED, _RUN, *arguments], cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    code, seconds, megabytes = json.loads(done.stdout)
    return code, (folder / "stderr").read_text(), seconds, megabytes


def holes(begin: bytes, size: int = 4 * 2**30) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(begin)
        os.truncate(path, size)

    return write


def text(content: str | Callable[[], str]) -> Callable[[Path], None]:
    """A large text is made when it is written: every run of pytest imports this file."""

    def write(path: Path) -> None:
        path.write_text(content if isinstance(content, str) else content())

    return write


def bomb(*names: str, size: int = 2**30) -> Callable[[Path], None]:
    """An archive whose members unpack to zeros, a thousand times its own size."""

    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in names:
                with archive.open(name, "w", force_zip64=True) as file:
                    for _ in range(size // len(names) // 2**24):
                        file.write(bytes(2**24))

    return write


def mat(path: Path) -> None:
    """A compressed variable of 2^25 doubles, all zero."""
    size = 8 * 2**25
    tag = struct.pack("<II", 14, 64 + size) + struct.pack("<4I", 6, 8, 6, 0) + struct.pack("<2I2i", 5, 8, 2**22, 8)
    stream = zlib.compressobj(9)
    packed = stream.compress(tag + struct.pack("<2I8s", 1, 1, b"a") + struct.pack("<2I", 9, size))
    packed += b"".join(stream.compress(bytes(2**20)) for _ in range(size // 2**20)) + stream.flush()
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed)


def two_corners(path: Path) -> None:
    """A sheet of two cells, and 1.7e10 between them."""
    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    office = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    links = "http://schemas.openxmlformats.org/package/2006/relationships"
    link = f'<Relationships xmlns="{links}"><Relationship Id="r" Type="{office}/%s" Target="%s"/></Relationships>'
    cell = '<row r="{0}"><c r="{1}{0}"><v>1</v></c></row>'
    types = "http://schemas.openxmlformats.org/package/2006/content-types"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("[Content_Types].xml", f'<Types xmlns="{types}"/>')
        archive.writestr("_rels/.rels", link % ("officeDocument", "xl/workbook.xml"))
        archive.writestr("xl/_rels/workbook.xml.rels", link % ("worksheet", "worksheets/a.xml"))
        book = f'<workbook xmlns="{main}" xmlns:r="{office}"><sheets><sheet name="a" sheetId="1" r:id="r"/></sheets>'
        archive.writestr("xl/workbook.xml", book + "</workbook>")
        cells = cell.format(1, "A") + cell.format(1048576, "XFD")
        archive.writestr("xl/worksheets/a.xml", f'<worksheet xmlns="{main}"><sheetData>{cells}</sheetData></worksheet>')


LOOP = '[plant]\nneck = "paper"\n[controller]\nfile = "pi.npz"\n[reference]\nkind = "step"\npitch_deg = 10\n'
IMPORT, GUESS = "import", ("--guess", "-o", "out.csv")
CASES: dict[str, tuple[Callable[[Path], None], list[str]]] = {
    "bomb.npz": (bomb("header.npy", "a.npy"), ["info", "bomb.npz"]),
    "bomb.fmu": (bomb("modelDescription.xml"), ["info", "bomb.fmu"]),
    "bomb.ssp": (bomb("SystemStructure.ssd"), ["simulate", "bomb.ssp"]),
    "bomb.xlsx": (bomb("xl/workbook.xml", "xl/worksheets/sheet1.xml"), [IMPORT, "bomb.xlsx", *GUESS]),
    "corners.xlsx": (two_corners, [IMPORT, "corners.xlsx", *GUESS]),
    "holes.csv": (holes(LOG), ["identify", "rls", "holes.csv", "-o", "m.npz"]),
    "holes_seen.csv": (holes(LOG), ["info", "holes_seen.csv"]),
    "small_holes.csv": (holes(LOG, 900 * 2**20), [IMPORT, "small_holes.csv", *GUESS]),
    "wide.csv": (text(lambda: (",".join("1" * 10**6) + "\n") * 3), ["identify", "rls", "wide.csv", "-o", "m.npz"]),
    "wide_seen.csv": (
        text(lambda: (",".join(f"c{k}" for k in range(10**6)) + "\n") * 2),
        [IMPORT, "wide_seen.csv", *GUESS],
    ),
    "line.csv": (text(lambda: "1" * 50_000_000), [IMPORT, "line.csv", *GUESS]),
    "zeros.mat": (mat, [IMPORT, "zeros.mat", *GUESS]),
    "holes.parquet": (holes(b"PAR1"), ["identify", "rls", "holes.parquet", "-o", "m.npz"]),
    "holes.mcap": (holes(b"\x89MCAP0\r\n"), [IMPORT, "holes.mcap", "-o", "out.csv"]),
    "holes.log": (holes(b"(1.000000) can0 181#00\n"), ["info", "holes.log"]),
    "long.toml": (text("duration_s = 1e12\n" + LOOP), ["simulate", "long.toml"]),
    "short_step.toml": (text("duration_s = 10.0\nsample_time_s = 1e-12\n" + LOOP), ["simulate", "short_step.toml"]),
    "runs.toml": (
        text('runs = 1000000000000\n[loop]\nduration_s = 1.0\n[vary]\n"plant.payload" = {uniform = [0.0, 0.3]}\n'),
        ["study", "runs.toml", "-o", "out"],
    ),
    "grid.toml": (
        text("[loop]\n[vary]\n" + "".join(f'"plant.p{i}" = {list(range(3000))}\n' for i in range(3))),
        ["study", "grid.toml", "-o", "out"],
    ),
    "holes.toml": (holes(b"a = 1\n"), ["simulate", "holes.toml"]),
    "key.toml": (text("a." * 200_000 + "a = 1\n"), ["robot", "key.toml"]),
    "brackets.toml": (text("a = " + "[" * 100_000), ["drives", "check", "--drives", "brackets.toml", "--simulated"]),
    "needs.toml": (holes(b"version = 1\n"), ["verify", "pi.npz", "pi.npz", "--requirements", "needs.toml"]),
    "a.certificate.json": (holes(b"{\n"), ["info", "a.certificate.json"]),
    "line.log": (text(lambda: "(1.000000) can0 181#00\n" + "0" * 300_000_000), ["info", "line.log"]),
    "start.json": (holes(b"{}"), ["start", "log.csv", "-o", ".", "--yes"]),
    "given.toml": (holes(b"a = 1\n"), ["new", "made", "--loop", "given.toml"]),
    "robot_given.toml": (holes(b"a = 1\n"), ["robot", "new", "--preset", "robot_given.toml"]),
    "brackets.json": (text("[" * 1_000_000), ["info", "brackets.json"]),
}


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_is_one_line_soon_and_in_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    write, arguments = CASES[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pi.npz").write_bytes((ROOT / "tests" / "golden" / "pi.npz").read_bytes())
    (tmp_path / "log.csv").write_bytes(LOG)
    write(tmp_path / name)
    before = {path.name for path in tmp_path.iterdir()} | {"stderr", "stdout"}
    code, said, seconds, megabytes = run(tmp_path, arguments)
    print(json.dumps({"file": name, "seconds": round(seconds, 2), "megabytes": round(megabytes), "said": said}))
    lines = [line for line in said.splitlines() if line.startswith("softneck: ")]
    assert (code, len(lines)) == (2, 1), said
    assert name in lines[0]
    assert seconds < SECONDS
    assert megabytes < MEGABYTES
    assert {path.name for path in tmp_path.iterdir()} == before, "nothing half written"
