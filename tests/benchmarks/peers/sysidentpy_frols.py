# pyright: reportMissingImports=false
"""SysIdentPy's FROLS on the same data and split, in an environment of its own (`pip install sysidentpy`).

    for name in eq22 steps sine rotation; do softneck record $name -o $name.csv --seed 1; done
    python tests/benchmarks/peers/sysidentpy_frols.py .

Degree, lags and number of terms are chosen by free run on the last fifth of the 7,000 rows to identify from.
"""

import sys
import time
from pathlib import Path

import numpy as np
from sysidentpy.basis_function import Polynomial
from sysidentpy.model_structure_selection import FROLS
from sysidentpy.parameter_estimation import LeastSquares

ROWS, WARM_UP = 7000, 25
FORMS = ((1, 5, 15), (2, 3, 15), (2, 5, 25))


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Set-points (time, 3) and outputs (time, 2) [rad]."""
    with path.open() as file:
        names = file.readline().strip().split(",")
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    columns = [next(i for i, n in enumerate(names) if n.startswith(f"motor_setpoint_{j}")) for j in (1, 2, 3)]
    angles = [next(i for i, n in enumerate(names) if n.startswith(f"{a} ")) for a in ("pitch", "roll")]
    return table[:, columns], np.radians(table[:, angles]) if "[deg]" in names[angles[0]] else table[:, angles]


def fit(y: np.ndarray, free: np.ndarray) -> float:
    """The paper's fit [%]."""
    return float(100 * (1 - np.linalg.norm(y - free) / np.linalg.norm(y - y.mean())))


def free_run(model: FROLS, u: np.ndarray, y: np.ndarray, start: int) -> np.ndarray:
    """Free run from row `start` on; NaN becomes far away."""
    with np.errstate(all="ignore"):
        out = model.predict(X=u[start - model.max_lag :], y=y[start - model.max_lag : start])
    return np.nan_to_num(out[model.max_lag :, 0], nan=1e3)


def main(folder: Path) -> None:
    """Print the fits of both axes."""
    u, outputs = read(folder / "eq22.csv")
    for axis, name in enumerate(("pitch", "roll")):
        begin, y = time.perf_counter(), outputs[:, axis : axis + 1] / 0.2
        tried = []
        for degree, lag, terms in FORMS:
            model = FROLS(
                order_selection=False,
                n_terms=terms,
                ylag=2,
                xlag=[list(range(1, lag + 1))] * 3,
                basis_function=Polynomial(degree=degree),
                estimator=LeastSquares(),
            )
            head = round(0.8 * ROWS)
            model.fit(X=u[:head], y=y[:head])
            tried.append((fit(y[head:ROWS, 0], free_run(model, u[:ROWS], y[:ROWS], head)), degree, lag, terms, model))
        _, degree, lag, terms, model = max(tried, key=lambda one: one[0])
        seconds = time.perf_counter() - begin
        fits = [f"validation {fit(y[ROWS + WARM_UP :, 0], free_run(model, u, y, ROWS + WARM_UP)):.1f}"]
        for test in ("steps", "sine", "rotation"):
            v, z = read(folder / f"{test}.csv")
            z = z[:, axis : axis + 1] / 0.2
            fits.append(f"{test} {fit(z[WARM_UP:, 0], free_run(model, v, z, WARM_UP)):.1f}")
        print(f"{name}: degree {degree}, lags {lag}, {terms} terms, {seconds:.1f} s: {', '.join(fits)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
