"""The nonlinear problem, condensed to the motors' moves, and its Gauss-Newton QP; written once in CasADi.

    min  sum_i w_i |y_i(z) - t_i|^2 + lambda |z - a|^2 + rho sum_i (delta_i(z) - c)^2

over the moves z, with y_i the model's free run from its state of now and t_i the reference less the estimated
disturbance. With S = dy/dz the QP is that of the residuals made linear (Bock 1983; Diehl et al. 2005, sec. 3).
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from softneck.core import Matrix, Vector, atomic_write

from ._nmpc_prepared import NonlinearProblem

_COMPILE_SECONDS = 300.0


def qp_function(problem: NonlinearProblem) -> Any:
    """Return `casadi.Function` (z, x, held, target, asked, common) -> (H, f, Y, S), H and f for absolute z.

    The model's step stays a function that is called: expanded it would be megabytes of C.
    """
    import casadi as ca

    p, step = problem, problem.model.casadi()
    a, b = step.sx_in()
    ahead, y = step(a, b)
    y = y[:2]
    both = [ahead, y, *(ca.jacobian(value, by) for value in (ahead, y) for by in (a, b))]
    linear = ca.Function("model_linear", [a, b], both)
    z, x, held, target, asked, common = _symbols(p, step)
    spread = p.spread()
    U = ca.reshape(ca.mtimes(ca.DM(spread), z), 3, p.horizon) + ca.repmat(held, 1, p.horizon)
    state, sensitivity = x, ca.MX(step.size1_out(0), p.variables)
    angles, slopes = [], []
    for i in range(p.horizon):
        # Once more through dense blocks would cost ten times the products.
        move = ca.DM(spread[3 * i : 3 * i + 3])
        state, y, A, B, C, D = linear(state, U[:, i])
        slopes.append(ca.mtimes(C, sensitivity) + ca.mtimes(D, ca.sparsify(move)))
        sensitivity = ca.mtimes(A, sensitivity) + ca.mtimes(B, ca.sparsify(move))
        angles.append(y)
    Y, S = ca.vertcat(*angles), ca.densify(ca.vertcat(*slopes))
    weighted = ca.densify(S * ca.repmat(ca.DM(p.weights.reshape(-1, 1)), 1, p.variables))
    common_rows = p.T[2] @ spread.reshape(p.horizon, 3, p.variables)  # (N, nz): delta_i of the moves
    constant = 2.0 * (p.move_weight * np.eye(p.variables) + p.cocontraction_weight * common_rows.T @ common_rows)
    H = 2.0 * ca.mtimes(weighted.T, S) + ca.DM(constant)
    f = 2.0 * ca.mtimes(weighted.T, Y - target - ca.mtimes(S, z)) - 2.0 * p.move_weight * asked
    level = ca.mtimes(ca.DM(p.T[2:]), held) - common
    f += 2.0 * p.cocontraction_weight * ca.DM(common_rows.sum(axis=0)) * level
    return ca.Function("qp", [z, x, held, target, asked, common], [ca.densify(H), ca.densify(f), Y, S])


def _symbols(p: NonlinearProblem, step: Any) -> tuple[Any, ...]:
    import casadi as ca

    sizes = (p.variables, step.size1_in(0), 3, 2 * p.horizon, p.variables, 1)
    names = ("z", "x", "held", "target", "asked", "common")
    return tuple(ca.MX.sym(name, size) for name, size in zip(names, sizes, strict=True))


class BufferedFunction:
    """A CasADi function that reads and writes numpy arrays in place: called without any allocation."""

    def __init__(self, function: Any) -> None:
        """Bind `function` to buffers of its own."""
        self.inputs: list[Vector] = [
            np.zeros(function.size1_in(i) * function.size2_in(i)) for i in range(function.n_in())
        ]
        # CasADi is column by column.
        self.outputs: list[Matrix] = [
            np.zeros((function.size1_out(i), function.size2_out(i)), order="F") for i in range(function.n_out())
        ]
        # The buffer lives as long as this object: CasADi keeps no reference.
        self._function = function
        self._buffer, self._call = function.buffer()
        for i, array in enumerate(self.inputs):
            self._buffer.set_arg(i, memoryview(array))  # pyright: ignore[reportArgumentType]
        for i, array in enumerate(self.outputs):
            self._buffer.set_res(i, memoryview(array.T))  # pyright: ignore[reportArgumentType]
        self._call()

    def __call__(self) -> list[Matrix]:
        """Evaluate; return the output arrays, which the next call overwrites."""
        self._call()
        return self.outputs


def compiled(function: Any) -> Any:
    """Return `function` as machine code where a C compiler is found, else as it is (CasADi's own machine)."""
    import casadi as ca

    compiler = shutil.which("gcc") or shutil.which("clang") or shutil.which("cc")
    if compiler is None:
        return function
    folder = Path(platformdirs.user_cache_dir("softneck", appauthor=False)) / "casadi"
    key = hashlib.sha256(function.serialize().encode() + ca.CasadiMeta.version().encode()).hexdigest()[:24]
    library = folder / f"{function.name()}_{key}.so"
    try:
        if not library.is_file():
            _build(compiler, function, library)
        return ca.external(function.name(), str(library))
    except (OSError, RuntimeError, subprocess.SubprocessError):
        return function


def _build(compiler: str, function: Any, library: Path) -> None:
    """Generate C and compile it to `library`."""
    import casadi as ca

    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator("code.c")
        generator.add(function)
        generator.generate(f"{folder}/")
        with atomic_write(library, force=True) as target:
            subprocess.run(
                [compiler, "-O2", "-fPIC", "-shared", f"{folder}/code.c", "-o", str(target), "-lm"],
                check=True, capture_output=True, timeout=_COMPILE_SECONDS,
            )  # fmt: skip
