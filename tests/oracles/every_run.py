"""Every way to run what was saved, with one version of softneck: started by `same_as_commit.py`."""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from small_blocks import (
    BUILD_COMPILED,
    CASES,
    GOLDEN_ROWS,
    LOAD_RUNTIME,
    NO_FILE,
    TS,
    block_of,
    compiled_run,
    find,
    inputs_of,
    make,
    makers,
    recording,
    reference_of,
    starts_of,
)  # fmt: skip

ROWS, PLAIN_ROWS = 400, 60
Compute = Callable[[], np.ndarray]


def plain_run(block: Any, rows: int, case: str) -> np.ndarray:
    """Return the same by plain Python."""
    runtime = find(*LOAD_RUNTIME)(block.runtime, compiled=False)
    q = block.initial_state(**starts_of(block, case)).parameters
    x, Y = np.zeros(runtime.state_size(block.arrays)), np.zeros((rows + 1, len(block.outputs)))
    runtime.initialise(block.arrays, q, x, Y[0])
    runtime.run_steps(block.arrays, q, x, inputs_of(block, rows, case), Y[1:])
    return Y


def fmu_run(build: Callable[..., Any], block: Any, case: str = "missing", **settings: Any) -> np.ndarray:
    """Return what an FMU of `block` answers to the same inputs in fmpy."""
    import fmpy

    U, names, outputs = inputs_of(block, PLAIN_ROWS, case), [p.name for p in block.inputs], block.outputs
    table: Any = np.zeros(len(U), [("time", float), *((p.name, bool if p.boolean else float) for p in block.inputs)])
    table["time"] = np.arange(len(U)) * TS
    for name, column in zip(names, U.T, strict=True):
        table[name] = column
    if not names:
        table = None
    with tempfile.TemporaryDirectory(prefix="softneck-same-") as folder:
        path = Path(folder) / "Same.fmu"
        build(block, path, **settings)
        # FMUs of controllers that know the parameter do what the others did where it is true.
        known = {v.name for v in fmpy.read_model_description(str(path)).modelVariables}
        starts = starts_of(block, case) | dict.fromkeys(known & {"use_motor_positions"}, True)
        result: Any = fmpy.simulate_fmu(
            str(path), stop_time=(len(U) - 1) * TS, step_size=TS, output_interval=TS,
            input=table, output=[p.name for p in outputs], start_values=starts,
        )  # fmt: skip
    return np.column_stack([np.asarray(result[port.name], dtype=float) for port in outputs])


def block_items(name: str, folder: Path) -> Iterator[tuple[str, Compute]]:
    """Yield what is computed with one block: (title, function)."""
    block = block_of(name, folder)
    if block is None:
        return
    plain_rows = 15 if name == "nmpc" else PLAIN_ROWS  # plain Python needs long for it
    yield "compiled", lambda: np.vstack([compiled_run(block, ROWS, case) for case in CASES])
    yield "plain", lambda: np.vstack([plain_run(block, plain_rows, case) for case in CASES])
    if name != "nmpc":  # slow as plain Python, and not translated to C
        yield "FMU, Python", lambda: fmu_run(find("fmu:build_fmu"), block)
        yield "FMU, compiled, FMI 2", lambda: fmu_run(find(*BUILD_COMPILED), block)
        yield "FMU, compiled, FMI 3", lambda: fmu_run(find(*BUILD_COMPILED), block, fmi=3)
    if block.role == "plant" and name not in NO_FILE:
        model, whole = find("core:load")(folder / f"{name}.npz"), recording()
        yield "simulate", lambda: np.vstack([model.simulate(whole, motors=m) for m in ("simulated", "measured")])
        yield "predict", lambda: np.vstack([model.predict(whole, horizon) for horizon in (1, 10)])
    if block.role == "controller":
        yield "in a loop", lambda: loop_run(folder, controller=name)


def loop_run(folder: Path, *, compiled: bool = False, order: str = "sequential", **changes: Any) -> np.ndarray:
    """Return all signals of a step of the virtual neck under faults of every sort."""
    from softneck import loop

    parts = {"plant": "lab_neck", "observer": "kalman", "controller": "pi"} | changes
    faults = [loop.SensorFault(kind="bias", start=0.2, duration=0.5, size=0.03)]
    faults += [loop.SensorFault(kind="outlier", start=0.3, size=0.1, share=0.2, seed=3)]
    faults += [loop.SensorFault(kind="delay", start=0.4, delay=0.06), loop.SensorFault(kind="noise", std=0.005, seed=1)]
    faults += [loop.SensorFault(kind=kind, start=at, duration=0.1) for kind, at in (("dropout", 0.7), ("freeze", 0.9))]
    faults += [loop.MotorFault(kind="offset", start=0.5, motor=2, size=0.2)]
    faults += [loop.MotorFault(kind="slow", start=0.6, duration=0.3, motor=0, rate=0.7)]
    faults += [loop.MotorFault(kind="stuck", start=1.1, duration=0.1, motor=3)]
    values = {"payload": 0.3, "push_x": 1.0, "push_y": -0.5, "base_tilt_pitch": 0.05}
    faults += [loop.NeckFault(values=values, start=0.8, duration=0.4)]
    blocks: dict[str, Any] = {role: loop.BlockPart(block_of(name, folder)) for role, name in parts.items()}
    made = loop.Loop(
        **blocks, order=order,
        reference=reference_of("step", pitch=0.2, roll=-0.1, at=0.1), duration=1.5, faults=tuple(faults),
    )  # fmt: skip
    with loop.LoopRun(made, compiled=compiled) as run:
        run.advance()
        return np.column_stack(list(run.result().signals.values()))


def study_run(folder: Path) -> np.ndarray:
    """Return the numbers of a small study of a model, its filter and a controller."""
    from softneck.cosim import study

    load = find("core:load")
    files = {"plant": "rls", "observer": "kalman", "controller": "pi"}
    loop = {"duration_s": 1.0, **{role: load(folder / f"{name}.npz") for role, name in files.items()}}
    vary = {
        "reference": {"grid": {"small": reference_of("step", pitch=0.05), "large": reference_of("step", pitch=0.2)}},
        "plant.parameters.noise_std": {"log_uniform": [1e-4, 1e-2]},
        "plant.parameters.noise_seed": {"seed": True},
    }
    runs: Any = study(loop | {"reference": reference_of("step", pitch=0.1)}, vary=vary, runs=8, workers=0)
    if runs["error"].any():
        raise RuntimeError(f"a run of the study failed: {runs['error'].max()}")
    return runs.select_dtypes("number").drop(columns="seconds").to_numpy(dtype=float)


def verify_run(folder: Path) -> np.ndarray:
    """Return every number of a quick verification: margins, steps, loops over the virtual neck, intervals, gaps."""
    from softneck.verification import make_requirements, verify

    load = find("core:load")
    quick = {
        "sampling": {"plants": 40, "search_generations": 3},
        "neck": {"necks": 1, "payloads_kg": [0.0], "orientations_deg": [0.0], "duration_s": 2.5},
    }
    plants = {"model": load(folder / "rls.npz"), "family": load(folder / "family.npz")}
    found = verify(load(folder / "pi.npz"), plants, make_requirements(quick), observer=load(folder / "kalman.npz"))
    metrics = [np.ravel(item.values) for _, item in sorted(found.evidence.metrics.items())]
    return np.concatenate([*metrics, numbers_of(found.contents())])


def numbers_of(value: Any) -> list[float]:
    """Return all numbers in JSON values, in order."""
    if isinstance(value, dict | list | tuple):
        return [
            number for item in (value.values() if isinstance(value, dict) else value) for number in numbers_of(item)
        ]
    return [float(value)] if isinstance(value, int | float) else []


def record_run(_: Path) -> np.ndarray:
    """Return all channels of recordings on two virtual necks, with noise and a payload."""
    from softneck.plant import NeckParameters, VirtualNeck, record
    from softneck.signals import signal

    necks = [NeckParameters.paper(), NeckParameters.lab()]
    runs = [record(signal("aprbs", duration=4.0, seed=1), VirtualNeck(p), seed=3, payload=0.3) for p in necks]
    return np.vstack([np.column_stack(list(run.channels.values())) for run in runs])


def estimate_run(folder: Path) -> np.ndarray:
    """Return what filters and smoothers make of a whole recording, that over a nonlinear model too."""
    load, few = find("core:load"), recording().rows(0, 150)
    estimates = [load(folder / f"{name}.npz").estimate(few) for name in ("kalman",)]
    nonlinear = find("estimation:KalmanSettings")().design(load(folder / "play.npz"))
    estimates += [nonlinear.estimate(few)]
    return np.vstack([np.column_stack([e.pitch, e.roll, e.pitch_rate, e.roll_rate]) for e in estimates])


def items(folder: Path, again: Path) -> Iterator[tuple[str, Compute]]:
    """Yield all that is compared: ("name: what", function)."""
    for name in [*makers({}), *NO_FILE]:
        yield from ((f"{name}: {title}", compute) for title, compute in block_items(name, folder))
    for order in ("sequential", "jacobi"):
        for compiled in (False, True):
            title = f"loop: {order}, {'compiled' if compiled else 'interpreted'}"
            yield title, partial(loop_run, folder, compiled=compiled, order=order)
    for compute in (study_run, verify_run, record_run, estimate_run):
        yield f"{compute.__name__.removesuffix('_run')}: numbers", partial(compute, folder)
    for name in makers({}):
        yield f"{name}: file saved again", partial(saved_again, folder / f"{name}.npz")
        yield f"{name}: made again", partial(arrays_of, again / f"{name}.npz")


def arrays_of(path: Path) -> np.ndarray:
    """Return the arrays of a file, without the header: findings may hold times."""
    with np.load(path, allow_pickle=False) as archive:
        return np.concatenate([np.ravel(archive[name]).astype(float) for name in archive.files if name != "header"])


def saved_again(path: Path) -> np.ndarray:
    """Load a file and save it; return all bytes inside, those of the header too."""
    with tempfile.TemporaryDirectory() as folder:
        find("core:load")(path).save(Path(folder) / "again.npz")
        with np.load(Path(folder) / "again.npz", allow_pickle=False) as archive:
            return np.concatenate([np.frombuffer(archive[name].tobytes(), dtype=np.uint8) for name in archive.files])


def run(folder: Path, out: Path, kinds: list[str]) -> None:
    """Compute all items of `kinds` (of all if there are none) and write them to one file."""
    found, again = {}, out.with_suffix(".again")
    make(again)
    for name, compute in items(folder, again):
        if not kinds or name.partition(":")[0] in kinds:
            begin = time.perf_counter()
            try:
                found[name] = np.ascontiguousarray(compute(), dtype=np.float64).ravel()
            except Exception:  # one version alone has it then, and the table says so
                traceback.print_exc()
            print(f"{out.stem} {time.perf_counter() - begin:6.1f} s  {name}", file=sys.stderr, flush=True)
    np.savez_compressed(out, allow_pickle=False, **found)


def golden(folder: Path) -> None:
    """Write what the blocks of `folder` answer, as text: a line for each row."""
    texts = []
    for name in [*makers({}), *NO_FILE]:
        block = block_of(name, folder)
        if block is not None:
            rows = ",\n".join(json.dumps(row) for row in compiled_run(block, GOLDEN_ROWS, "missing").tolist())
            texts.append(f'"{name}": [\n{rows}\n]')
    (folder / "outputs.json").write_text("{\n" + ",\n".join(texts) + "\n}\n")


def main(task: str, folder: str, *more: str) -> None:
    """Do one task with the softneck on PYTHONPATH, and with no other: one installed must not come before it."""
    roots = os.environ["PYTHONPATH"].split(os.pathsep)
    sys.path[:] = [path for path in sys.path if path in roots or not (Path(path) / "softneck").is_dir()]
    place = str(importlib.import_module("softneck.core").__file__)
    if not any(place.startswith(f"{root}{os.sep}") for root in roots):
        raise RuntimeError(f"{place} is not in {roots}")
    if task == "run":
        run(Path(folder), Path(more[0]), list(more[1:]))
    else:
        {"make": make, "golden": golden}[task](Path(folder))


if __name__ == "__main__":
    main(*sys.argv[1:])
