"""Run every kind of FMU, of both backends, in every independent tool that is here: `make conformance`.

    python -m tests.fmu.conformance [--out build/conformance.md] [--add] [--backend B]... [--tool T]... [KIND...]

Tools that registries offer come with the dependency group `importers`; others are taken where PATH has them. One that
is not here is "not run". What a tool computes is held against the block's own run; a checker is
believed by its exit code. `--add` takes in the kinds of an earlier run with the same tools: some kinds at a time.
Exit code 1 where anything fails.
"""

from __future__ import annotations

import argparse
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
from collections.abc import Callable, Sequence
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
    "rls", "rls_mimo", "nlsm", "nlsm_residual", "nn", "play", "greybox", "guarded", "neck",
    "kalman", "nonlinear", "pi", "fopi", "hinf", "adaptive", "mpc",
)  # fmt: skip
BACKENDS = ("python 2.0", "compiled 2.0", "compiled 3.0")
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
        ask: returns "" or what is wrong.
    """

    name: str
    found: Callable[[], str]
    backends: tuple[str, ...]
    ask: Callable[[Case], str]


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
        str(case.path), input=signals, output=names, stop_time=stop, output_interval=step, step_size=step
    )
    # Row k of fmpy's table is what a step of row k - 1 left.
    seen = np.array([[float(row[name]) for name in names] for row in result])[1:ROWS]
    short = Case(case.block, case.path, case.inputs[: ROWS - 1], case.expected[: ROWS - 1])
    return compared(short, seen)


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
        return lines[0].split(" build date")[0][:60] if told else "version not said"

    return found


ALL, TWO = BACKENDS, BACKENDS[:2]
TOOLS = (
    Tool("fmpy", packaged("fmpy"), ALL, fmpy_says),
    Tool("our host in C", command_version("cc", "--version"), BACKENDS[1:2], c_host),
    Tool("fmutool", packaged("fmu-manipulation-toolbox"), ALL, fmutool_says),
    Tool("libcosim", packaged("libcosimpy"), TWO, importer("libcosim")),
    Tool("ecos", packaged("ecospy"), ALL, importer("ecos")),
    Tool("pathsim-fmi", packaged("pathsim-fmi"), ALL, importer("pathsim")),
    Tool(
        "fmusim", command_version("fmusim", "--version"), BACKENDS[1:],
        on_path("fmusim", "--interface-type", "cs", "--stop-time", "{stop}", "{fmu}"),
    ),
    Tool(
        "fmuCheck", command_version("fmuCheck", "-v"), TWO, on_path("fmuCheck", "-h", "{step}", "-s", "{stop}", "{fmu}")
    ),
    Tool("vdmcheck2", command_version("vdmcheck2", "-h"), TWO, on_path("vdmcheck2", "{fmu}")),
    Tool("vdmcheck3", command_version("vdmcheck3", "-h"), BACKENDS[2:], on_path("vdmcheck3", "{fmu}")),
    Tool("OMSimulator", command_version("OMSimulator", "--version"), ALL, omsimulator_says),
)  # fmt: skip


def asked(tool: Tool, case: Case) -> str:
    """Return what is wrong with an FMU in a tool; what a tool throws is wrong too."""
    try:
        return tool.ask(case)
    except Exception as error:
        return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:120]}"


def main() -> int:
    """Print and write the table; 1 where anything fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", default=list(KINDS))
    parser.add_argument("--out", type=Path, default=Path("build/conformance.md"))
    parser.add_argument("--add", action="store_true")
    parser.add_argument("--backend", action="append", choices=BACKENDS)
    parser.add_argument("--tool", action="append", choices=[tool.name for tool in TOOLS], help="none: all")
    told = parser.parse_args()
    here = {tool.name: tool.found() if tool.name in (told.tool or (tool.name,)) else "" for tool in TOOLS}
    found = earlier(told.out.with_suffix(".json"), here) if told.add else {}
    with tempfile.TemporaryDirectory() as name:
        for kind in told.kinds:
            said = {}
            for backend in told.backend or BACKENDS:
                made = case(kind, backend, Path(name))
                asks = [tool for tool in TOOLS if here[tool.name] and backend in tool.backends]
                said |= {f"{tool.name}, {backend}": asked(tool, made) for tool in asks}
                print(f"{kind}, {backend}", file=sys.stderr, flush=True)
            found[kind] = {place: one for place, one in said.items() if one}
            told.out.parent.mkdir(parents=True, exist_ok=True)
            told.out.with_suffix(".json").write_text(json.dumps({"tools": here, "found": found}), encoding="utf-8")
    wrong: dict[tuple[str, str], list[str]] = {(tool.name, backend): [] for tool in TOOLS for backend in BACKENDS}
    for kind, places in found.items():
        for (tool, backend), many in wrong.items():
            many += [f"{kind}: {places[place]}"] if (place := f"{tool}, {backend}") in places else []
    text = table(here, wrong, list(found), told.backend or BACKENDS)
    told.out.write_text(text, encoding="utf-8")
    print(text)
    return int(any(wrong.values()))


def earlier(path: Path, here: dict[str, str]) -> dict[str, dict[str, str]]:
    """Return what a run with the same tools found: kind -> tool and backend -> what is wrong."""
    kept = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return kept["found"] if kept.get("tools") == here else {}


def table(
    here: dict[str, str],
    wrong: dict[tuple[str, str], list[str]],
    kinds: list[str],
    backends: Sequence[str] = BACKENDS,
) -> str:
    """Return the table, and below what failed."""
    today = datetime.datetime.now(tz=datetime.UTC).date()
    lines = [f"{len(kinds)} kinds, {today}, {platform.system()} {platform.machine()}: {', '.join(kinds)}.", ""]
    lines += [f"| tool | version | {' | '.join(BACKENDS)} |", "|---" * (2 + len(BACKENDS)) + "|"]
    for tool in TOOLS:
        cells = []
        for backend in BACKENDS:
            good = len(kinds) - len(wrong[tool.name, backend])
            shown = f"{good} of {len(kinds)}" if here[tool.name] and backend in backends else "not run"
            cells.append(shown if backend in tool.backends else "-")
        lines.append(f"| {tool.name} | {here[tool.name] or '-'} | {' | '.join(cells)} |")
    failed = [f"- {tool}, {backend}: {one}" for (tool, backend), many in wrong.items() for one in many]
    return "\n".join([*lines, "", *failed]).rstrip() + "\n"


if __name__ == "__main__":
    sys.exit(main())
