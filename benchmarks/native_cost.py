"""Print what a step of each compiled FMU costs in a C host, beside a reference FMU in the same run.

`python benchmarks/native_cost.py [KIND...] [--reference Dahlquist.fmu]... [--rounds N]`

Set, `doStep` and get, processor time without Python. A reference is the Reference FMUs' Dahlquist of FMI 2.0 where its
file is given, else the least FMU in C of `tests/benchmarks/lag_fmu.c`. The limits are in times of the Dahlquist as its
sources build by themselves, which is without optimisation: that one first, and a release build behind it. Kinds with
derivatives come once more with `--sensitivities`: a cycle with a directional derivative of the outputs to come.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import fmpy
import numpy as np

from softneck.core import SettingsError
from softneck.fmu import build_compiled_fmu
from softneck.identification import GreyBox, Network, Play, Rls, SetMembership
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import Block
from softneck.signals import signal

HERE = Path(__file__).parent
LAG = HERE.parent / "tests" / "benchmarks" / "lag_fmu.c"
# Times of the first reference that are wanted at most.
WANTED = {"rls": 1.1, "nn": 7.0, "nlsm": 25.0, "neck paper": 130.0, "neck lab": 130.0, "neck rough": 130.0}
ROWS = 2000


def kinds() -> dict[str, Callable[[], Block]]:
    """Return name -> how its block is made; models are those of the paper's training rows on the virtual neck."""
    training = record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=100).rows(0, 7000)

    def neck(preset: str) -> Callable[[], Block]:
        return lambda: VirtualNeck(getattr(NeckParameters, preset)()).block()

    return {
        "rls": lambda: Rls().fit(training).block(),
        "nn": lambda: Network(iterations=1).fit(training).block(),
        "nlsm": lambda: SetMembership().fit(training).block(),
        "nlsm residual": lambda: SetMembership(form="residual").fit(training).block(),
        "play": lambda: Play().fit(training).block(),
        "greybox": lambda: GreyBox(evaluations=3).fit(training).block(),
        "neck paper": neck("paper"),
        "neck lab": neck("lab"),
        "neck rough": neck("rough"),
    }


@dataclass(frozen=True, slots=True)
class Timed:
    """A command that prints times, and what it reads."""

    command: list[str]
    data: bytes

    def times(self) -> list[float]:
        """Return its lines [ns]."""
        done = subprocess.run(self.command, input=self.data, capture_output=True, check=True)
        return [float(line) for line in done.stdout.split()]


def timed(host: Path, fmu: Path, folder: Path) -> Timed:
    """Return the host's command for an FMU, whose set-points follow Eq. 22."""
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(folder)
    model = fmpy.read_model_description(str(folder))
    name = model.coSimulation.modelIdentifier if model.coSimulation is not None else ""
    variables = [v for v in model.modelVariables if v.type == "Real"]
    moved = [v for v in variables if v.causality == "input" and v.name.startswith(("motor_setpoint_", "u"))]
    seen = [v for v in variables if v.causality == "output"]
    if not moved:  # a reference without inputs lets its state be set, and has a derivative to get
        moved, seen = seen, [v for v in variables if v.causality in ("output", "local")]
    ahead = [v for v in seen if v.name.endswith("_next")]
    seen = [*ahead, *(v for v in seen if v not in ahead)]
    step = float(model.defaultExperiment.stepSize or 0.02) if model.defaultExperiment else 0.02
    rows = signal("eq22").set_points[7000 : 7000 + ROWS, : len(moved)]
    data = struct.pack(f"<{len(moved) + len(seen)}I", *(v.valueReference for v in [*moved, *seen]))
    numbers = [str(step), *map(str, (len(moved), len(seen), len(ahead), ROWS))]
    command = [
        str(host),
        str(folder / "binaries" / "linux64" / f"{name}.so"),
        (folder / "resources").as_uri(),
        model.guid,
    ]
    return Timed([*command, *numbers], data + np.ascontiguousarray(rows, dtype="<f8").tobytes())


def lag(folder: Path) -> Path:
    """Return the least FMU in C, for where there is no other reference."""
    compile_c([str(LAG), "-shared", "-fPIC"], folder / "Lag.so")
    xml = """<fmiModelDescription fmiVersion="2.0" modelName="Lag" guid="lag"><CoSimulation modelIdentifier="Lag"/>
<ModelVariables><ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable></ModelVariables>
<ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure></fmiModelDescription>"""
    with zipfile.ZipFile(folder / "Lag.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", xml)
        archive.write(folder / "Lag.so", "binaries/linux64/Lag.so")
    return folder / "Lag.fmu"


def compile_c(arguments: list[str], target: Path) -> None:
    """Compile with this machine's compiler."""
    subprocess.run([os.environ.get("CC", "cc"), "-O2", "-w", *arguments, "-o", str(target), "-ldl"], check=True)


def main() -> None:
    """Print the table."""
    made = kinds()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", default=list(made))
    parser.add_argument("--reference", type=Path, action="append", default=[])
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        compile_c([str(HERE / "native_cost.c")], folder / "host")
        references = {f"reference {i}": path for i, path in enumerate(asked.reference or [lag(folder)])}
        runs = {name: timed(folder / "host", path, folder / name) for name, path in references.items()}
        for number, kind in enumerate(asked.kinds):
            block = made[kind]()
            for ahead in (False, True):
                fmu = folder / f"K{number}_{int(ahead)}.fmu"
                try:
                    build_compiled_fmu(block, fmu, sensitivities=ahead)
                except SettingsError as error:
                    if not ahead or "no sensitivities" not in str(error):
                        raise
                    continue
                runs[f"{kind} +" if ahead else kind] = timed(folder / "host", fmu, folder / fmu.stem)
        least: dict[str, np.ndarray] = {}
        for _ in range(asked.rounds):  # by turns: what disturbs the machine disturbs all
            for kind, run in runs.items():
                times = np.array(run.times())
                least[kind] = np.minimum(least.get(kind, times), times)
    units = [least[name][0] for name in references]
    for path, unit in zip(references.values(), units, strict=True):
        print(f"reference: {path.name}, {unit:.0f} ns")
    heads = " | ".join(f"of reference {i + 1}" for i in range(len(units)))
    print(f"\n| kind | ns | {heads} | wanted | with a derivative, of a cycle without |")
    print("|---" * (4 + len(units)) + "|")
    for kind in asked.kinds:
        more = least.get(f"{kind} +")
        derived = "-" if more is None else f"{more[1] / more[0]:.2f}"
        wanted = f"{WANTED[kind]:g}" if kind in WANTED else ""
        ratios = " | ".join(f"{least[kind][0] / unit:.2f}" for unit in units)
        print(f"| {kind} | {least[kind][0]:.0f} | {ratios} | {wanted} | {derived} |")


if __name__ == "__main__":
    main()
