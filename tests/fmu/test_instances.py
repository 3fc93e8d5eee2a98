"""Several FMUs in one process do not touch each other, nor the process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from softneck.fmu import build_fmu, unpacked

TS = 0.02


def _rows(u: np.ndarray) -> np.ndarray:
    return np.column_stack([u, np.ones(u.size), np.full(u.size, np.nan)])


def test_two_of_one_kind_with_other_data_run_interleaved(toys: Any, tmp_path: Path, running: Any) -> None:
    blocks = [toys.lag(pole=0.5), toys.lag(pole=0.95), toys.controller()]
    paths = [build_fmu(block, tmp_path / f"Toy{i}.fmu") for i, block in enumerate(blocks)]
    u = 0.5 * np.random.default_rng(4).standard_normal(100)
    expected = [block.run(block.initial_state(), _rows(u))[1][:, 0] for block in blocks[:2]]
    expected.append(blocks[2].run(blocks[2].initial_state(), np.column_stack([u, np.zeros(100)]))[1][:, 0])
    with ExitStack() as stack:
        fmus = [stack.enter_context(running(path)) for path in (*paths, paths[0])]
        drives, shown = ["motor_setpoint_1"] * 2 + ["pitch_reference", "motor_setpoint_1"], ["pitch"] * 2
        shown += ["motor_setpoint_1", "pitch"]
        for fmu in fmus:
            fmu.begin()
        seen = []
        for k, value in enumerate(u):
            for fmu, name in zip(fmus, drives, strict=True):
                fmu.set(**{name: value})
            for fmu in fmus:
                fmu.fmu.doStep(k * TS, TS)
            seen.append([fmu.get(name)[0] for fmu, name in zip(fmus, shown, strict=True)])
    np.testing.assert_array_equal(np.array(seen).T, [*expected, expected[0]])


def test_the_search_path_is_left_clean(lag_fmu: Path, controller_fmu: Path, running: Any) -> None:
    before = list(sys.path)
    for path in (lag_fmu, controller_fmu, lag_fmu):
        with running(path) as fmu:
            fmu.begin()
            assert sys.path == before
            fmu.fmu.reset()
            fmu.begin()
    assert sys.path == before


_MANY = """
import sys, shutil
import fmpy
from fmpy.fmi2 import FMU2Slave
for path in sys.argv[1:] * 20:
    folder = fmpy.extract(path)
    model = fmpy.read_model_description(str(folder))
    fmu = FMU2Slave(guid=model.guid, unzipDirectory=str(folder),
                    modelIdentifier=model.coSimulation.modelIdentifier, instanceName="many")
    fmu.instantiate(loggingOn=True)
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    for k in range(5):
        fmu.doStep(k * 0.02, 0.02)
    try:
        fmu.setReal([0], [float("nan")])
    except Exception:
        pass
    fmu.reset()
    fmu.freeInstance()
    shutil.rmtree(folder)
print(len([p for p in sys.path if "resources" in p]))
"""


def test_a_process_of_many_instances_and_errors_ends_cleanly(lag_fmu: Path, controller_fmu: Path) -> None:
    child = subprocess.run(
        [sys.executable, "-c", _MANY, str(lag_fmu), str(controller_fmu)], capture_output=True, text=True, check=False
    )
    assert (child.returncode, child.stdout.splitlines()[-1]) == (0, "0")


@pytest.mark.parametrize("kind", ["lag", "controller"])
def test_fmpy_s_own_simulation_runs_them(kind: str, toys: Any, tmp_path: Path) -> None:
    path = build_fmu(getattr(toys, kind)(), tmp_path / "Toy.fmu")
    starts = {"extra": 0.0, "pitch_start": 0.25} if kind == "lag" else {"pitch_reference": 0.1}
    result = fmpy.simulate_fmu(str(path), stop_time=1.0, start_values=starts)
    assert len(result) == 51
    assert np.isfinite(np.array(result.tolist(), dtype=float)).all()


_ENDING = """
import atexit, sys
import fmpy
from fmpy.fmi2 import FMU2Slave
seen = []
register = atexit.register
atexit.register = lambda function, *rest: (seen.append(getattr(function, "__name__", "")), register(function, *rest))[1]
guid = fmpy.read_model_description(sys.argv[1]).guid
for name in ("one", "two"):
    fmu = FMU2Slave(guid=guid, unzipDirectory=sys.argv[1], modelIdentifier="Lag", instanceName=name)
    fmu.instantiate()
    fmu.freeInstance()
print(seen.count("finalizePythonInterpreter"))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only the binary for Linux ends twice")
def test_the_binary_is_let_go_before_python_ends(lag_fmu: Path) -> None:
    """Else a finaliser of pythonfmu's binary writes to memory that was freed, and some hosts end by SIGABRT."""
    with unpacked(lag_fmu) as folder:
        command = [sys.executable, "-c", _ENDING, str(folder)]
        child = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert (child.returncode, child.stdout.strip()) == (0, "1"), child.stderr


_HOST_IN_C = """
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
static void look(void) { printf("Python runs: %d\\n", ((int (*)(void))dlsym(RTLD_DEFAULT, "Py_IsInitialized"))()); }
static void report(void) {}
int main(int argc, char **argv)
{
    void *calls[5] = {(void *)report}, *library = dlopen(argv[1], RTLD_NOW), *fmu;
    void *(*make)(const char *, int, const char *, const char *, void *, int, int) = dlsym(library, "fmi2Instantiate");
    int (*leave)(void *) = dlsym(library, "fmi2ExitInitializationMode");
    int (*advance)(void *, double, double, int) = dlsym(library, "fmi2DoStep");
    void (*end)(void *) = dlsym(library, "fmi2FreeInstance");
    atexit(look); /* runs before what the library registered when it was loaded, and after what the FMU does now */
    fmu = make("host", 1, argv[3], argv[2], calls, 0, 0);
    printf("%d", leave(fmu));
    printf(" %d\\n", advance(fmu, 0.0, 0.1, 1));
    end(fmu);
    return 0;
}
"""
_LIBPYTHON = Path(sysconfig.get_config_var("LIBDIR") or "", sysconfig.get_config_var("INSTSONAME") or "")


@pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None or ".so" not in _LIBPYTHON.name or not _LIBPYTHON.is_file(),
    reason="a host in C needs a C compiler and a shared libpython, on Linux",
)
def test_python_ends_before_the_destructors_of_a_host_in_c(lag_fmu: Path, tmp_path: Path) -> None:
    """Else they free what pythonfmu's binary shares between instances twice, and most of our FMUs end by SIGABRT."""
    host = tmp_path / "host"
    command = ["cc", "-std=gnu99", "-w", "-xc", "-o", str(host), "-", "-ldl"]
    subprocess.run(command, input=_HOST_IN_C, text=True, check=True)
    python = {"LD_PRELOAD": _LIBPYTHON, "PYTHONHOME": sys.base_prefix, "PYTHONPATH": os.pathsep.join(sys.path)}
    with unpacked(lag_fmu) as folder:
        guid = fmpy.read_model_description(str(folder)).guid
        command = [str(host), str(folder / "binaries/linux64/Lag.so"), (folder / "resources").as_uri(), guid]
        environment = os.environ | {name: str(value) for name, value in python.items()}
        child = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert (child.returncode, child.stdout) == (0, "0 0\nPython runs: 0\n"), child.stderr
