"""Small files of every kind, and inputs to step them with; any version of softneck can run this text."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

TS = 0.02
CASES = ("free", "measured", "missing", "limits")
GOLDEN_ROWS = 30
NO_FILE = ("neck", "lab_neck", "reference")  # what is stepped and has no file


# Where names lie in both layouts; whatever else is used lies in the same room before and after.
LOAD_RUNTIME = ("runtime:load_runtime", "core:load_runtime")
BUILD_COMPILED = ("fmu:build_compiled_fmu", "fmu.native:build_compiled_fmu")


def find(*places: str) -> Any:
    """Return the first of `module:name` that there is: today's place of something, then earlier ones."""
    for place in places:
        module, _, name = place.partition(":")
        try:
            return getattr(importlib.import_module(f"softneck.{module}"), name)
        except (ImportError, AttributeError):
            continue
    raise ImportError(f"none of {', '.join(places)}")


def recording() -> Any:
    """Two lags that follow held random set-points, with drives and noise."""
    rng = np.random.default_rng(3)
    P = np.repeat(rng.uniform(-1.5, 3.0, (32, 3)), 25, axis=0)
    drive = np.column_stack([P[:, 0] - 0.5 * (P[:, 1] + P[:, 2]), np.sqrt(0.75) * (P[:, 1] - P[:, 2])])
    m, y = P.copy(), np.zeros((len(P), 2))
    for k in range(len(P) - 1):
        m[k + 1] = 0.6 * m[k] + 0.4 * P[k]
        y[k + 1] = np.array([0.88, 0.92]) * y[k] + np.array([0.011, 0.008]) * drive[max(k - 3, 0)]
    y += 1e-3 * rng.standard_normal(y.shape)
    columns = [*P.T, *y.T, *m.T]
    names = [*(f"motor_setpoint_{j}" for j in (1, 2, 3)), "pitch", "roll"]
    names += [f"motor_position_{j}" for j in (1, 2, 3)]
    return find("signals:Recording")(np.arange(len(P)) * TS, TS, dict(zip(names, columns, strict=True)))


def makers(made: dict[str, Any]) -> dict[str, Callable[[], Any]]:
    """Return name -> what makes a small thing of that kind; `made` holds those made before."""
    import control

    from softneck import design, estimation, identification

    whole = recording()
    few, fewer = whole.rows(0, 500), whole.rows(0, 250)  # set membership keeps its rows: its files stay small
    pole = np.exp(-5.293 * TS)  # Eq. 31
    tf = control.TransferFunction([0.09 * (1.0 - pole)], [1.0, -pole, 0.0, 0.0], TS)
    K = control.TransferFunction([4.0, -3.5], [1.0, -1.0], TS)
    linear = estimation.LinearNeck(pitch=tf, roll=tf)
    ident, kalman = identification, estimation.KalmanSettings
    play = ident.Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4)
    return {
        "rls": lambda: ident.Rls(max_delay=0.12).fit(few),
        "rls_mimo": lambda: ident.Rls(structure="mimo", delay=0.06).fit(few),
        "oe": lambda: ident.OutputError(delay=0.06, source="positions").fit(few),
        "nlsm": lambda: ident.SetMembership(epsilon=0.01, output_weight=10.0).fit(fewer),
        "nlsm_residual": lambda: ident.SetMembership(form="residual", epsilon=0.01, output_weight=10.0).fit(fewer),
        "play": lambda: play.fit(few),
        "nn": lambda: ident.Network(hidden=(4, 3), iterations=8).fit(few),
        "greybox": lambda: ident.GreyBox(evaluations=4, sensor_delay=2).fit(few),
        "family": lambda: ident.FamilySettings(window=6.0).fit(whole),
        "kalman": lambda: kalman().design(linear),
        "kalman_gyro": lambda: kalman(form="gyro", sensor_delay=0.03).design(linear),
        "kalman_jacobi": lambda: kalman(sensor="paper", order="jacobi").design(made["rls"]),
        "pi": lambda: design.PiSettings().design(linear),
        "adaptive": lambda: design.AdaptiveSettings().design(linear),
        "hinf": lambda: design.HinfSettings(bandwidth=4.0).design(linear),
        "pid": lambda: design.PidSettings().design(linear),
        "fopi": lambda: design.FopiSettings(crossover=4.0).design(linear),
        "lqg": lambda: design.LqgSettings().design(linear),
        "custom": lambda: design.CustomSettings(controller=K).design(linear),
        "mpc": lambda: design.MpcSettings(bandwidth=6.0, angle_limit=0.5).design(linear),
        "nmpc": lambda: design.NmpcSettings(horizon=8, moves=3, angle_limit=0.5).design(made["play"]),
    }


def make(folder: Path) -> None:
    """Write a file of every kind; those that others are made of come first."""
    folder.mkdir(parents=True, exist_ok=True)
    made: dict[str, Any] = {}
    for name, maker in makers(made).items():
        made[name] = maker()
        made[name].save(folder / f"{name}.npz", force=True)


def reference_of(kind: str, **values: float) -> Any:
    """Return a reference of the neck; versions before 0.3 have a name for each kind."""
    loop = importlib.import_module("softneck.loop")
    old = getattr(loop, f"{kind.title()}Reference", None)
    return old(**values) if old else importlib.import_module("softneck.loop._references").reference(kind, values)


def block_of(name: str, folder: Path) -> Any:
    """Return the block of a file or of what has none; None of a file that nothing steps."""
    from softneck.loop import ReferenceBlock
    from softneck.plant import NeckParameters, VirtualNeck

    if name == "neck":
        return VirtualNeck(NeckParameters.paper()).block(noise_seed=3)
    if name == "lab_neck":
        return VirtualNeck(NeckParameters.lab().replace(dropout_rate=1.0)).block(noise_seed=4)
    if name == "reference":
        return ReferenceBlock(reference_of("rotation", inclination=0.2, at=0.1)).block()
    thing = find("core:load")(folder / f"{name}.npz")
    return thing.block() if hasattr(thing, "block") else None


def inputs_of(block: Any, rows: int, case: str) -> np.ndarray:
    """Return (rows, n_in): a random walk; what may be missing is absent, there, or absent now and then."""
    rng = np.random.default_rng(11)
    # Ten times the walk runs into all limits of slew, position and angle.
    size = 3.0 if case == "limits" else 0.3
    U = size * rng.standard_normal((rows, len(block.inputs))).cumsum(axis=0) / np.sqrt(rows)
    U += 1e-3 * rng.standard_normal(U.shape)
    for i, port in enumerate(block.inputs):
        lost = rng.random(rows) > {"free": 0.0, "measured": 2.0}.get(case, 0.8)
        if port.boolean:
            U[:, i] = 1.0 if case == "measured" else rng.random(rows) > 0.05
        elif port.missing:
            U[lost, i] = np.nan
        low = -np.inf if port.minimum is None else port.minimum
        high = np.inf if port.maximum is None else port.maximum
        if port.name.startswith("motor_setpoint"):
            U[:, i] *= 5.0
            if block.role == "plant" and block.kind != "virtual_neck":
                continue  # an identified plant states what it was trained on, and takes more
        U[:, i] = np.clip(U[:, i], low, high)
    return U


def starts_of(block: Any, case: str) -> dict[str, float]:
    """Return the parameters of a case: measurements used, noise added, where a kind has such parameters."""
    wanted = {"use_measurement": float(case != "free"), "pitch_start": 0.02}
    if case == "missing":
        wanted |= {"noise_std": 0.01, "noise_seed": 4.0}
    return {port.name: wanted[port.name] for port in block.parameters if port.name in wanted}


def compiled_run(block: Any, rows: int, case: str) -> np.ndarray:
    """Return the outputs (rows + 1, n_out) as everybody gets them, those at the start first."""
    state = block.initial_state(**starts_of(block, case))
    return np.vstack([state.outputs, block.run(state, inputs_of(block, rows, case))[1]])
