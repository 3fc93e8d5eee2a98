"""Run every kind of FMU, of both backends and interfaces, in every independent tool that is here: `make conformance`.

    python -m tests.fmu.conformance [--out FILE] [--page PAGE] [--add] [--backend B]... [--tool T]... [KIND...]

Tools that registries offer come with the dependency group `importers`; others are taken where PATH has them. One that
is not here is "not run". What a tool computes is compared with the block's own run; the result of a checker is its exit
code. `--add` takes in the kinds of an earlier run with the same tools: some kinds at a time. `--page` writes the table
between the two marks of a page. Exit code 1 where anything fails.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import json
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import fmpy
import numpy as np
from fmpy.validation import validate_fmu

from softneck.core import load
from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.fmu.describe._description import exported_block
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block
from softneck.runtime._compile import load_runtime

from ._omsimulator import outputs_in_omsimulator

HERE = Path(__file__).parent
GOLDEN = HERE.parent / "golden"
KINDS = (
    "rls", "rls_mimo", "oe", "nlsm", "nlsm_residual", "nn", "play", "greybox", "guarded", "neck",
    "kalman", "nonlinear", "pi", "pid", "lqg", "fopi", "hinf", "adaptive", "mpc",
)  # fmt: skip
BACKENDS = ("python 2.0", "compiled 2.0", "compiled 3.0")
CS, ME = "CS", "ME"
# Of a checker that reads the file, or runs both by itself.
FILE, BOTH = "file", "CS, ME"
MARKS = ("<!-- conformance: written by make conformance -->", "<!-- end of conformance -->")
ROWS = 40
# Of the size of a signal: the library adds in another order than numpy, observers divide by small numbers.
SAME = 1e-9
# An FMU of the Python backend takes its interpreter from its host: one that is no Python is given one.
PYTHON = {
    "LD_PRELOAD": f"{sysconfig.get_config_var('LIBDIR')}/{sysconfig.get_config_var('LDLIBRARY')}",
    "PYTHONPATH": os.pathsep.join(sys.path),
}
# What may be asked of a tool at most [s].
_PATIENCE = 120.0


@dataclass(frozen=True, slots=True)
class Case:
    """One FMU: what it is of, its inputs, and what it should say."""

    block: Block
    path: Path
    inputs: np.ndarray
    expected: np.ndarray


@dataclass(frozen=True, slots=True)
class Tool:
    """How a tool is found and asked.

    Attributes:
        name: in the table.
        found: its version, "" where it is not here.
        backends: those it is for.
        ask: interface -> what returns "" or what is wrong. Model Exchange is asked of compiled FMUs only.
    """

    name: str
    found: Callable[[], str]
    backends: tuple[str, ...]
    ask: dict[str, Callable[[Case], str]]

    def places(self) -> Iterator[tuple[str, str]]:
        """Yield backend and interface of each of its rows."""
        yield from ((b, i) for b in self.backends for i in self.ask if (b, i) != (BACKENDS[0], ME))


def block_of(kind: str) -> Block:
    """Return the block of a kind: the golden file's, or the virtual neck."""
    return VirtualNeck(NeckParameters.paper()).block() if kind == "neck" else load(GOLDEN / f"{kind}.npz").block()


def case(kind: str, backend: str, folder: Path) -> Case:
    """Build an FMU and work out what it should say, without any FMU."""
    block = block_of(kind)
    path = folder / f"{kind}.fmu"
    if backend == BACKENDS[0]:
        build_fmu(block, path, force=True)
    else:
        build_compiled_fmu(block, path, fmi=int(backend.split()[1][0]), force=True)
    block = exported_block(block)
    u = np.tile([port.start for port in block.inputs], (ROWS, 1))
    rng = np.random.default_rng(0)
    for i, port in enumerate(block.inputs):
        if not port.boolean and port.unit == "rad":
            u[:, i] = 0.05 * rng.standard_normal(ROWS).cumsum()
    return Case(block, path, u, steps_of(block, u))


def steps_of(block: Block, u: np.ndarray) -> np.ndarray:
    """Return the outputs after each step, by Python's own text."""
    step, state = load_runtime(block.runtime, compiled=False).step, block.initial_state()
    x, expected = state.values.copy(), np.zeros((len(u), len(block.outputs)))
    for k, row in enumerate(u):
        step(block.arrays, state.parameters, x, row.copy(), expected[k])
    return expected


def ran(command: list[str], **more: str) -> subprocess.CompletedProcess[str]:
    """Run a tool."""
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=_PATIENCE, env=os.environ | more
    )


def last_line(done: subprocess.CompletedProcess[str]) -> str:
    """Return what a tool said last."""
    lines = (done.stdout + done.stderr).strip().splitlines() or [""]
    return f"exit code {done.returncode}: {lines[-1][:120]}"


def compared(case: Case, seen: np.ndarray, *, numbers_only: bool = False) -> str:
    """Return where outputs (ROWS, outputs) differ from what they should be."""
    places = [i for i, port in enumerate(case.block.outputs) if not (numbers_only and port.boolean)]
    expected = case.expected[:, places]
    scale = np.maximum(np.nanmax(np.abs(expected), axis=0), 1e-3)
    off = np.nanmax(np.abs(seen - expected) / scale, axis=0)
    worst = int(np.argmax(off))
    wrong = off[worst] > SAME or not np.isfinite(off[worst])
    return f"{case.block.outputs[places[worst]].name} is off by {off[worst]:.1e}" if wrong else ""


def importer(script: str) -> Callable[[Case], str]:
    """Return how one of the scripts in `importers` is asked."""

    def ask(case: Case) -> str:
        ports = (*case.block.inputs, *case.block.outputs)
        booleans = np.array([port.name for port in ports if port.boolean], dtype=str)
        with tempfile.TemporaryDirectory() as name:
            job, out = Path(name) / "job.npz", Path(name) / "out.npy"
            np.savez(
                job, step=case.block.sample_time, inputs=case.inputs, names=[port.name for port in case.block.inputs],
                booleans=booleans, outputs=[port.name for port in case.block.outputs],
            )  # fmt: skip
            done = ran([sys.executable, str(HERE / "importers" / f"{script}.py"), str(case.path), str(job), str(out)])
            # Some hosts of Python die behind their work: what they computed counts.
            if not out.is_file():
                return last_line(done)
            return compared(case, np.load(out), numbers_only=script == "pathsim")

    return ask


def fmpy_says(case: Case) -> str:
    """Return what fmpy's checks find, or where its run differs."""
    problems = validate_fmu(str(case.path))
    if problems:
        return problems[0]
    names = [port.name for port in case.block.outputs]
    rows = [(k * case.block.sample_time, *map(float, row)) for k, row in enumerate(case.inputs)]
    kinds = [(port.name, bool if port.boolean else float) for port in case.block.inputs]
    signals = np.array(rows, dtype=[("time", float), *kinds])
    stop = (ROWS - 1) * case.block.sample_time
    step = case.block.sample_time
    result = fmpy.simulate_fmu(
        str(case.path), fmi_type="CoSimulation", input=signals, output=names, stop_time=stop, output_interval=step,
        step_size=step,
    )  # fmt: skip
    # Row k of fmpy's table is what a step of row k - 1 left.
    seen = np.array([[float(row[name]) for name in names] for row in result])[1:ROWS]
    short = Case(case.block, case.path, case.inputs[: ROWS - 1], case.expected[: ROWS - 1])
    return compared(short, seen)


def around_samples(case: Case) -> tuple[list[str], np.ndarray]:
    """Return names and table (2 ROWS, 1 + names) of time and measured inputs, constant around each sample."""
    step, given = case.block.sample_time, [i for i, start in enumerate(case.inputs[0]) if np.isfinite(start)]
    time = np.repeat(np.arange(ROWS) * step, 2) + np.tile([-0.25 * step, 0.25 * step], ROWS)
    return [case.block.inputs[i].name for i in given], np.column_stack(
        [time, np.repeat(case.inputs[:, given], 2, axis=0)]
    )


def in_events(case: Case) -> Case:
    """Return `case` with what Model Exchange shows in the event of each sample: a plant's outputs at that time."""
    if case.block.role != "plant":
        return case
    first = case.block.initial_state().outputs
    return Case(case.block, case.path, case.inputs, np.vstack([first, case.expected[:-1]]))


def last_of_each(case: Case, time: np.ndarray, outputs: np.ndarray, first: int) -> np.ndarray:
    """Return the last row of `outputs` at the samples `first`, `first` + 1, ..: the one after its event."""
    numbers = time / case.block.sample_time
    rows = {round(n): i for i, n in enumerate(numbers) if abs(n - round(n)) < 1e-6}  # times are rounded sums
    return outputs[[rows[n] for n in range(first, first + ROWS)]]


def fmpy_exchange(case: Case) -> str:
    """Return where Model Exchange in fmpy, by CVode, shows something else."""
    names, table = around_samples(case)
    booleans = {port.name for port in case.block.inputs if port.boolean}
    signals = np.array(
        list(map(tuple, table)), [("time", float), *((name, bool if name in booleans else float) for name in names)]
    )
    step, outputs = case.block.sample_time, [port.name for port in case.block.outputs]
    result = fmpy.simulate_fmu(
        str(case.path), fmi_type="ModelExchange", solver="CVode", input=signals, output=outputs,
        stop_time=(ROWS - 0.5) * step, output_interval=step, record_events=True,
    )  # fmt: skip
    seen = np.array([[float(row[name]) for name in outputs] for row in result])
    return compared(in_events(case), last_of_each(case, np.array(result["time"]), seen, 0))


def fmusim_says(interface: str) -> Callable[[Case], str]:
    """Return how fmusim (of the Reference FMUs) is asked, in one of its interfaces."""

    def ask(case: Case) -> str:
        names, table = around_samples(case)
        with tempfile.TemporaryDirectory() as folder:
            given, out = Path(folder) / "in.csv", Path(folder) / "out.csv"
            np.savetxt(given, table, fmt="%.17g", delimiter=",", header=",".join(["time", *names]), comments="")
            times = ["--stop-time", repr(ROWS * case.block.sample_time)]
            times += ["--output-interval", repr(case.block.sample_time)]
            files = ["--input-file", str(given), "--output-file", str(out)] if names else ["--output-file", str(out)]
            done = ran(["fmusim", "--interface-type", interface.lower(), *times, *files, str(case.path)])
            if done.returncode:
                return last_line(done)
            with out.open(encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
        seen = np.array([[float(row[port.name]) for port in case.block.outputs] for row in rows])
        time = np.array([float(row["time"]) for row in rows])
        if interface == ME:
            return compared(in_events(case), last_of_each(case, time, seen, 0))
        return compared(case, last_of_each(case, time, seen, 1))

    return ask


def c_host(case: Case) -> str:
    """Return where the host in C, without Python, sees something else."""
    with tempfile.TemporaryDirectory() as name:
        folder, host = Path(name), Path(name) / "host"
        build = ["cc", "-O1", "-w", str(HERE / "native_host.c"), "-o", str(host), "-ldl"]
        subprocess.run(build, check=True, capture_output=True)
        with zipfile.ZipFile(case.path) as archive:
            archive.extractall(folder)
        model = fmpy.read_model_description(str(folder))
        [library] = folder.glob("binaries/linux64/*")
        n_in, n_out = len(case.block.inputs), len(case.block.outputs)
        numbers = [str(n_in), str(n_out), repr(case.block.sample_time), str(ROWS)]
        masks = {
            key: str(sum(1 << i for i, port in enumerate(ports) if port.boolean))
            for key, ports in (("IN_BOOLEANS", case.block.inputs), ("OUT_BOOLEANS", case.block.outputs))
        }
        done = subprocess.run(
            [str(host), str(library), (folder / "resources").as_uri(), model.guid or "", *numbers],
            input=case.inputs.astype("<f8").tobytes(), capture_output=True, check=False, env=os.environ | masks,
        )  # fmt: skip
        if done.returncode:
            return f"exit code {done.returncode}: {done.stderr.decode()[:120]}"
        return compared(case, np.frombuffer(done.stdout).reshape(ROWS, n_out))


def fmutool_says(case: Case) -> str:
    """Return what fmutool finds."""
    done = ran([str(Path(sys.executable).with_name("fmutool")), "-input", str(case.path), "-check"])
    text = done.stdout + done.stderr
    return "" if "seems to be compliant with FMI-" in text and "No semantic error" in text else last_line(done)


def on_path(command: str, *arguments: str) -> Callable[[Case], str]:
    """Return how a command on PATH is asked: its exit code counts."""

    def ask(case: Case) -> str:
        stop, step = repr(ROWS * case.block.sample_time), repr(case.block.sample_time)
        told = [text.format(stop=stop, step=step, fmu=case.path) for text in arguments]
        with zipfile.ZipFile(case.path) as archive:
            alone = "resources/model.bin" in archive.namelist()
        done = ran([command, *told], **({} if alone else PYTHON))
        return "" if done.returncode == 0 else last_line(done)

    return ask


def omsimulator_says(case: Case) -> str:
    """Return where OMSimulator sees something else; its command line holds the inputs, so here those of one row."""
    held = case.inputs[ROWS // 2]
    with tempfile.TemporaryDirectory() as name:
        with zipfile.ZipFile(case.path) as archive:
            more = {} if "resources/model.bin" in archive.namelist() else PYTHON
        seen = outputs_in_omsimulator(case.block, case.path, held, ROWS, Path(name), more)
    return compared(Case(case.block, case.path, case.inputs, steps_of(case.block, np.tile(held, (ROWS, 1)))), seen)


def packaged(name: str) -> Callable[[], str]:
    """Return how a package's version is found."""

    def found() -> str:
        try:
            return version(name)
        except PackageNotFoundError:
            return ""

    return found


def command_version(command: str, *arguments: str) -> Callable[[], str]:
    """Return how the version of a command on PATH is found."""

    def found() -> str:
        if shutil.which(command) is None:
            return ""
        done = ran([command, *arguments])
        lines = (done.stdout or done.stderr).strip().splitlines()
        told = lines and not lines[0].startswith("Usage")
        return lines[0].split(" build date")[0].removeprefix(f"{command} ")[:60] if told else "version not said"

    return found


ALL, TWO = BACKENDS, BACKENDS[:2]
TOOLS = (
    Tool("fmpy", packaged("fmpy"), ALL, {CS: fmpy_says, ME: fmpy_exchange}),
    Tool("our host in C", command_version("cc", "--version"), BACKENDS[1:2], {CS: c_host}),
    Tool("fmutool", packaged("fmu-manipulation-toolbox"), ALL, {FILE: fmutool_says}),
    Tool("libcosim", packaged("libcosimpy"), TWO, {CS: importer("libcosim")}),
    Tool("ecos", packaged("ecospy"), ALL, {CS: importer("ecos")}),
    Tool("pathsim-fmi", packaged("pathsim-fmi"), ALL, {CS: importer("pathsim")}),
    Tool(
        "fmusim", command_version("fmusim", "--version"), BACKENDS[1:], {CS: fmusim_says(CS), ME: fmusim_says(ME)}
    ),
    Tool(
        "fmuCheck", command_version("fmuCheck", "-v"), TWO,
        {BOTH: on_path("fmuCheck", "-h", "{step}", "-s", "{stop}", "{fmu}")},
    ),
    Tool("vdmcheck2", command_version("vdmcheck2", "-h"), TWO, {FILE: on_path("vdmcheck2", "{fmu}")}),
    Tool("vdmcheck3", command_version("vdmcheck3", "-h"), BACKENDS[2:], {FILE: on_path("vdmcheck3", "{fmu}")}),
    Tool("OMSimulator", command_version("OMSimulator", "--version"), ALL, {CS: omsimulator_says}),
)  # fmt: skip


def asked(ask: Callable[[Case], str], case: Case) -> str:
    """Return what is wrong with an FMU in a tool; what a tool throws is wrong too."""
    try:
        return ask(case)
    except Exception as error:
        return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:120]}"


def main() -> int:
    """Print and write the table; 1 where anything fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", default=list(KINDS))
    parser.add_argument("--out", type=Path, default=Path("build/conformance.md"))
    parser.add_argument("--page", type=Path, help="write the table into this page too")
    parser.add_argument("--add", action="store_true")
    parser.add_argument("--backend", action="append", choices=BACKENDS)
    parser.add_argument("--tool", action="append", choices=[tool.name for tool in TOOLS], help="none: all")
    told = parser.parse_args()
    here = {tool.name: tool.found() if tool.name in (told.tool or (tool.name,)) else "" for tool in TOOLS}
    found = earlier(told.out.with_suffix(".json"), here) if told.add else {}
    with tempfile.TemporaryDirectory() as name:
        for kind in told.kinds:
            said = found.setdefault(kind, {})
            for backend in told.backend or BACKENDS:
                made = case(kind, backend, Path(name))
                asks = [
                    (place_of(tool, backend, interface), tool.ask[interface])
                    for tool in TOOLS
                    for one, interface in tool.places()
                    if one == backend and here[tool.name]
                ]
                said |= {place: asked(ask, made) for place, ask in asks}
                print(f"{kind}, {backend}", file=sys.stderr, flush=True)
            told.out.parent.mkdir(parents=True, exist_ok=True)
            told.out.with_suffix(".json").write_text(json.dumps({"tools": here, "found": found}), encoding="utf-8")
    text = table(here, found)
    told.out.write_text(text, encoding="utf-8")
    if told.page:
        before, after = told.page.read_text(encoding="utf-8").split(MARKS[0])
        after = after.split(MARKS[1])[1]
        told.page.write_text(f"{before}{MARKS[0]}\n\n{text}\n{MARKS[1]}{after}", encoding="utf-8")
    print(text)
    return int(any(wrong for places in found.values() for wrong in places.values()))


def earlier(path: Path, here: dict[str, str]) -> dict[str, dict[str, str]]:
    """Return what a run with the same tools found: kind -> tool, backend and interface -> "" or what is wrong."""
    kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return kept["found"] if kept.get("tools") == here else {}


def place_of(tool: Tool, backend: str, interface: str) -> str:
    """Return how a row of the table is called."""
    return f"{tool.name}, {backend}, {interface}"


def table(here: dict[str, str], found: dict[str, dict[str, str]]) -> str:
    """Return the table, a row for each tool, FMU and interface, a column for each kind; below it what failed."""
    today = datetime.datetime.now(tz=datetime.UTC).date()
    lines = [f"{platform.system()} {platform.machine()}, {today}.", ""]
    lines += ["|".join(["", "tool", "version", "FMU", "interface", *found, ""]), "|---" * (4 + len(found)) + "|"]
    for tool in TOOLS:
        for backend, interface in tool.places():
            said = [places.get(place_of(tool, backend, interface)) for places in found.values()]
            cells = ["not run" if one is None else "fail" if one else "pass" for one in said]
            lines.append("|".join(["", tool.name, here[tool.name] or "-", backend, interface, *cells, ""]))
    failed = [
        f"- {kind}: {place}: {wrong}" for kind, places in found.items() for place, wrong in places.items() if wrong
    ]
    return "\n".join([*lines, "", *failed]).rstrip() + "\n"


if __name__ == "__main__":
    sys.exit(main())
