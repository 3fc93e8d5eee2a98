"""Every format that we read: whole files of it to begin with, and the reader that a wrong one must not surprise."""

from __future__ import annotations

import io
import os
import resource
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd

from softneck.core import FileFormatError, load, read_certificate, write_certificate
from softneck.core._certificate import certificate_contents
from softneck.cosim import load_loop, load_ssp, load_study
from softneck.cosim.parts._fmu_part import FmuPart
from softneck.cosim.parts._variables import read_block
from softneck.cosim.studies._store import read_runs, read_study_description
from softneck.drives.bus._read import load_drives
from softneck.drives.logs._cycle import Cycle
from softneck.drives.logs._log_file import read_run_log
from softneck.drives.logs._run_log import RunLogger, _Entry
from softneck.drives.master import Frame
from softneck.drives.supervision._baseline import load_baseline
from softneck.fmu import build_fmu
from softneck.plant import NeckParameters
from softneck.robot import Robot
from softneck.robot._file import preset_text
from softneck.signals import read_layout, read_recording, write_recording
from softneck.signals.importing._table_format import sniff
from softneck.signals.importing.formats import _sheets
from softneck.tuning._requirements import read_tune_requirements
from softneck.verification import read_requirements

from ..data import ROOT, neck_recording
from ..signals import log_writers

LOOP = """duration_s = 1.0
sample_time_s = 0.02
[plant]
neck = "paper"
[controller]
file = "pi.npz"
[reference]
kind = "step"
pitch_deg = 10.0
[[fault]]
kind = "sensor_dropout"
start_s = 0.5
duration_s = 0.1
[limits]
pitch_rise_s = 0.8
"""


STUDY = """loop = "loop.toml"
runs = 20
[vary]
"plant.payload" = {uniform = [0.0, 0.3]}
"order" = ["sequential", "jacobi"]
"""


@dataclass(frozen=True)
class Target:
    """One format.

    Attributes:
        suffix: of its files.
        read: reads one.
        seeds: writes whole ones to paths that it is given names for.
        zipped: whether members are changed too, with all sums of the archive right.
    """

    suffix: str
    read: Callable[[Path], Any]
    seeds: Sequence[Callable[[Path], Any]]
    zipped: bool = False


def columns(rows: int = 40) -> dict[str, np.ndarray]:
    recording = neck_recording(rows)
    made = {"t": recording.time}
    made |= {f"s{j + 1}": recording.set_points[:, j] for j in range(3)}
    return {**made, "pitch": recording.outputs[:, 0], "roll": recording.outputs[:, 1]}


def copy(*parts: str) -> Callable[[Path], Any]:
    return lambda path: path.write_bytes(ROOT.joinpath(*parts).read_bytes())


def text(content: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(content, encoding="utf-8")


def run_log(path: Path) -> None:
    with RunLogger(path.with_suffix(".mcap"), wait=True, epoch=1.0) as log:
        log.describe({"files": {}, "settings": {}})
        for k in range(20):
            cycle = Cycle(0.01 * k, (Frame(0x181, bytes(8)),), None, (), (), (), "idle", (0.0,), (0.0,), (0.0,))
            log._put(_Entry([], cycle, {"pitch": 0.1 * k}, (), 0.01 * k))
    log.path.replace(path)


def certificate(path: Path) -> None:
    row = {"metric": "rise_s", "limit": 0.8, "value": 0.5, "holds": True}
    more = {"requirements": [row], "band_rad_s": [0.1, 4.0]}
    write_certificate(path, certificate_contents("verify", holds=True, files={"a": ("a", "0" * 64)}, more=more))


def fmu(path: Path) -> None:
    """Its library is opened when a loop starts, not when it is described."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("modelDescription.xml", _FMU)
        file.writestr("binaries/linux64/A.so", b"none")


def our_fmu(path: Path) -> None:
    """One that runs Python, without the binaries: it is read back as the block that it was made of."""
    whole = path.with_name("whole.fmu")
    build_fmu(load(ROOT.joinpath(*GOLDEN, "pi.npz")).block(), whole, force=True)
    with zipfile.ZipFile(whole) as given, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as kept:
        for name in ("modelDescription.xml", "resources/block.json", "resources/arrays.npy"):
            kept.writestr(name, given.read(name))
    whole.unlink()


def ssp(path: Path) -> None:
    inside = path.with_name("A.fmu")
    fmu(inside)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("SystemStructure.ssd", _SSD)
        file.write(inside, "resources/A.fmu")


_FMU = """<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="A" guid="{a}">
<CoSimulation modelIdentifier="A" canHandleVariableCommunicationStepSize="true"/><UnitDefinitions><Unit name="rad">
<BaseUnit rad="1"/></Unit></UnitDefinitions><ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0" unit="rad" min="-1" max="1"/>
</ScalarVariable><ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
</ModelVariables><DefaultExperiment stepSize="0.02"/>
<ModelStructure><Outputs><Unknown index="2" dependencies="1"/></Outputs></ModelStructure>
</fmiModelDescription>"""
_SSD = """<?xml version="1.0"?><ssd:SystemStructureDescription
xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" name="a" version="1.0"><ssd:System name="a">
<ssd:Connectors><ssd:Connector name="y" kind="output"><ssc:Real unit="rad"/></ssd:Connector></ssd:Connectors>
<ssd:Elements><ssd:Component name="p" type="application/x-fmu-sharedlibrary" source="resources/A.fmu"><ssd:Connectors>
<ssd:Connector name="y" kind="output"><ssc:Real/></ssd:Connector></ssd:Connectors></ssd:Component></ssd:Elements>
<ssd:Connections><ssd:Connection startElement="p" startConnector="y" endConnector="y"/></ssd:Connections></ssd:System>
<ssd:Units><ssc:Unit name="rad"><ssc:BaseUnit rad="1"/></ssc:Unit></ssd:Units>
<ssd:DefaultExperiment startTime="0" stopTime="1"/><ssd:Annotations><ssc:Annotation type="softneck">
<Master stepSize="0.02" order="jacobi"/></ssc:Annotation></ssd:Annotations></ssd:SystemStructureDescription>"""


def sheet(path: Path) -> None:
    """As the reader, but that a fork tries a file first: a process of its own would take most of the time."""
    with mock.patch.object(_sheets, "_try", tried):
        sniff(path)


def tried(path: Path) -> None:
    import python_calamine as calamine

    child = os.fork()
    if not child:
        data = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5]) * resource.getpagesize()
        most = data + _sheets._LEAST_ROOM
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # where memory ends it says so
        try:
            book = calamine.CalamineWorkbook.from_path(path)
            for name in book.sheet_names:
                book.get_sheet_by_name(name)
        except MemoryError:
            os._exit(2)
        except BaseException:
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code < 0 or code == 2:
        raise FileFormatError(f"{path}: its sheets would fill the memory.")


def runs(path: Path) -> None:
    made = {"run": [0, 1, 2], "sample": [0, 1, 2], "seed": [5, 6, 7], "plant.payload": [0.0, 0.1, 0.2],
            "rise_s": [0.4, None, 0.5], "holds": [True, None, False], "error": ["", "a", ""],
            "seconds": [0.1] * 3}  # fmt: skip
    pd.DataFrame(made).to_csv(path, index=False)


def runs_beside(path: Path) -> Any:
    """A study's runs lie beside its description."""
    (path.parent / "study.json").write_text('{"study": {"loop": {}, "runs": 3}}', encoding="utf-8")
    path.replace(path.with_name("runs.csv"))
    return read_runs(path.parent)


GOLDEN = ("tests", "golden")
TARGETS: dict[str, Target] = {
    "npz": Target(".npz", load, [copy(*GOLDEN, f"{name}.npz") for name in ("pi", "rls", "kalman")], zipped=True),
    "csv": Target(".csv", read_recording, [lambda path: write_recording(path, neck_recording(30))]),
    "parquet": Target(".parquet", read_recording, [lambda path: write_recording(path, neck_recording(30))]),
    "log": Target(
        ".csv",
        sniff,
        [
            lambda path: log_writers.write_text(path, columns()),
            lambda path: log_writers.write_text(path, columns(), encoding="utf-16"),
            lambda path: log_writers.write_text(path, columns(), sep=",", decimal="."),
        ],
    ),
    "sheet": Target(".xlsx", sheet, [lambda path: log_writers.write_sheet(path, columns(12))], zipped=True),
    "mat": Target(
        ".mat",
        sniff,
        [
            lambda path: log_writers.write_mat(path, columns()),
            lambda path: log_writers.write_trials(path, [columns()]),
            lambda path: log_writers.write_trials_v73(path, [columns()]),
        ],
    ),
    "mcap": Target(".mcap", sniff, [lambda path: log_writers.write_mcap(path, columns())]),
    "run_log": Target(".mcap", read_run_log, [run_log]),
    "fmu": Target(".fmu", lambda path: FmuPart(path, role="plant"), [fmu], zipped=True),
    "our_fmu": Target(".fmu", read_block, [our_fmu], zipped=True),
    "ssp": Target(".ssp", load_ssp, [ssp], zipped=True),
    "loop": Target(".toml", load_loop, [text(LOOP)]),
    "study": Target(
        ".toml",
        lambda path: len(load_study(path).points),
        [text(STUDY)],
    ),
    "robot": Target(".toml", Robot.read, [text(preset_text(name)) for name in ("arm", "trunk4")]),
    "drives": Target(".toml", load_drives, [copy("examples", "drives", "drives.toml")]),
    "runs": Target(".csv", runs_beside, [runs]),
    "layout": Target(
        ".toml",
        read_layout,
        [copy("examples", "layouts", f"{name}.toml") for name in ("arm_multisine", "neck_openloop")],
    ),
    "neck": Target(".toml", NeckParameters.from_toml, [text('preset = "lab"\nlink_length = 0.1\n')]),
    "requirements": Target(".toml", read_requirements, [copy("softneck", "verification", "requirements.toml")]),
    "tune": Target(".toml", read_tune_requirements, [copy("softneck", "tuning", "requirements.toml")]),
    "certificate": Target(".json", read_certificate, [certificate]),
    "baseline": Target(".json", load_baseline, [copy("tests", "drives", "paper.supervision.json")]),
    "study_json": Target(
        "", lambda path: read_study_description(path.parent), [text('{"study": {"loop": {}, "runs": 3}}')]
    ),
}  # fmt: skip

# What damages files of many forms: sizes and counts at their ends, what opens without closing, words with a meaning.
WORDS = (
    b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\n",
    b"-1", b"1e999", b"nan", b"inf", b"-0", b"9" * 400, b"1e-320", b'"', b"'", b"[[", b"{", b"}", b"]", b"= ",
    b"\n[a]\n", b"\n[[a]]\n", b"true", b'""', b"null", b"[]", b"{}", b"2026-11-23", b",", b";", b"\t",
    b"\xef\xbb\xbf", b"\xc3\x28",
    b"<", b">", b"&a;", b"../", b"\x00", b"\xd8\x00", b" ", b"#", b"1_0", b"0x10",
)  # fmt: skip
Edit = tuple[float, int, int]


def edited(content: bytes, edits: Sequence[Edit]) -> bytes:
    """Return `content` after edits (where, what, how much): a flip, a word, a cut, a copy, another end."""
    changed = bytearray(content)
    for where, what, much in edits:
        at = int(where * len(changed))
        word = WORDS[much % len(WORDS)]
        match what % 7:
            case 0 if at < len(changed):
                changed[at] ^= 1 + much % 255
            case 1:
                changed[at:at] = word
            case 2:
                changed[at : at + len(word)] = word
            case 3:
                del changed[at : at + 1 + much % 64]
            case 4:
                changed[at:at] = changed[at : at + 1 + much % 64]
            case 5:  # the value of a setting, or a cell
                end = min((place for mark in b"\n,;" if (place := changed.find(mark, at)) >= 0), default=at)
                changed[at:end] = word
            case 6 if much % 8 == 0:
                del changed[at:]
    return bytes(changed)


def edited_member(content: bytes, place: int, edits: Sequence[Edit]) -> bytes:
    """Return an archive with one member edited and all its sums right."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    chosen = sorted(members)[place % len(members)]
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        for name, inside in members.items():
            file.writestr(name, edited(inside, edits) if name == chosen else inside)
    return out.getvalue()
