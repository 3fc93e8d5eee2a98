"""Derivatives of a step's text, held against differences of the step itself.

The hand-written derivatives that were here before differed by 7e-17 at most (`nn`, `play`, `greybox`).
"""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from softneck.core import Matrix, SettingsError, Vector, load
from softneck.fmu.compiled import _sources
from softneck.fmu.compiled.translate._kinds import ranks_of
from softneck.fmu.compiled.translate._scope import Arrays
from softneck.fmu.compiled.translate._translate import Unit, _Runtime, _tangent_of
from softneck.identification import Model
from softneck.runtime import Block, bundle, load_runtime
from softneck.runtime._compile import load_tangent
from softneck.runtime._tangent import with_tangent

from ..data import ROOT

KINDS = (
    "rls",
    "rls_mimo",
    "oe",
    "nn",
    "play",
    "greybox",
    "guarded",
    "nlsm",
    "nlsm_residual",
)
LAWS = ("pi", "pid", "lqg", "fopi", "hinf", "custom", "nonlinear")


def block_of(name: str) -> Block:
    model = load(ROOT / "tests" / "golden" / f"{name}.npz", role="model")
    assert isinstance(model, Model)
    return model.block()


def moving(block: Block, rows: int, seed: int = 0) -> tuple[Vector, Vector, Vector]:
    """Return state, inputs and parameters of a plant that was moved at random, far from its corners."""
    step = load_runtime(block.runtime, compiled=False).step
    start = block.initial_state(use_measurement=0.0)
    x, y, u = start.values.copy(), np.zeros(len(block.outputs)), np.full(8, np.nan)
    u[:3] = 0.0
    rng = np.random.default_rng(seed)
    for _ in range(rows):
        u[:3] = np.clip(u[:3] + rng.normal(0.0, 0.4, 3), -6.0, 6.0)
        step(block.arrays, start.parameters, x, u, y)
    return x, u, start.parameters


def along(block: Block, x: Vector, u: Vector, q: Vector, X: Matrix, U: Matrix) -> tuple[Vector, Vector, Matrix, Matrix]:
    """Return state, outputs and what both are moved by along directions."""
    X, x, y = X.copy(), x.copy(), np.zeros(len(block.outputs))
    Y = np.zeros((y.size, X.shape[1]))
    load_tangent(block.runtime, compiled=False)(block.arrays, q, x, u, y, X, U, Y, X.shape[1])
    return x, y, X, Y


@pytest.mark.parametrize("name", KINDS)
def test_it_is_what_differences_say(name: str) -> None:
    block = block_of(name)
    step = load_runtime(block.runtime, compiled=False).step
    for rows in (1, 12, 40):
        x, u, q = moving(block, rows)
        rng = np.random.default_rng(rows)
        X, U = rng.standard_normal((x.size, 6)), np.zeros((8, 6))
        U[:3] = rng.standard_normal((3, 6))
        # The generator of random numbers is moved by nothing, wherever its six numbers stand: they are huge.
        X[np.abs(x) > 1e3] = 0.0
        ahead, y, found, outputs = along(block, x, u, q, X, U)

        def run(h: float, d: int, x: Vector = x, u: Vector = u, X: Matrix = X, U: Matrix = U, q: Vector = q) -> Vector:
            moved, out = x + h * X[:, d], np.zeros(len(block.outputs))
            step(block.arrays, q, moved, u + h * U[:, d], out)
            return np.concatenate([moved, out])

        # Advanced as the step does it, to the bit.
        np.testing.assert_array_equal(np.concatenate([ahead, y]), run(0.0, 0))
        for d in range(6):
            # Central: h^2 of the third derivative, up to 1e5 in the grey box's friction, and 1e-16 / h of rounding.
            slope = (run(3e-7, d) - run(-3e-7, d)) / 6e-7
            got = np.concatenate([found[:, d], outputs[:, d]])
            quiet = np.concatenate([np.abs(ahead) < 1e3, np.ones(y.size, dtype=bool)])
            np.testing.assert_allclose(got[quiet], slope[quiet], atol=1e-7)


def test_directions_beyond_those_asked_for_stay_as_they_are() -> None:
    block = block_of("nn")
    x, u, q = moving(block, 5)
    rng = np.random.default_rng(0)
    X, U = rng.standard_normal((x.size, 4)), rng.standard_normal((8, 4))
    all_of_them = along(block, x, u, q, X, U)[2]
    some, y, Y = X.copy(), np.zeros(len(block.outputs)), np.full((len(block.outputs), 4), 7.0)
    load_tangent(block.runtime, compiled=False)(block.arrays, q, x.copy(), u, y, some, U, Y, 2)
    np.testing.assert_array_equal(some[:, :2], all_of_them[:, :2])
    np.testing.assert_array_equal(Y[:, 2:], 7.0)


def test_compiled_it_is_the_same() -> None:
    block = block_of("play")
    x, u, q = moving(block, 20)
    X, U = np.eye(x.size), np.zeros((8, x.size))
    plain = along(block, x, u, q, X, U)
    outputs = len(block.outputs)
    y, Y = np.zeros(outputs), np.zeros((outputs, x.size))
    load_tangent(block.runtime)(block.arrays, q, x, u, y, X, U, Y, x.size)
    # numpy's own sums may be in another order: some 1e-16 of values around 1.
    for a, b in zip(plain, (x, y, X, Y), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-14)


@pytest.mark.parametrize("name", LAWS)
def test_controllers_and_observers_have_derivatives_too(name: str) -> None:
    block = load(ROOT / "tests" / "golden" / f"{name}.npz").block()
    step, tangent = load_runtime(block.runtime, compiled=False).step, load_tangent(block.runtime, compiled=False)
    start, rng = block.initial_state(), np.random.default_rng(0)
    x, y, q = start.values.copy(), np.zeros(len(block.outputs)), start.parameters
    numbers = [i for i, port in enumerate(block.inputs) if not port.boolean]
    u = np.array([float(port.boolean) for port in block.inputs])
    for k in range(13):
        # Slowly: far from all limits, which a moment later would be a corner.
        u[numbers] += rng.normal(0.0, 0.003, len(numbers))
        if k in (1, 12):
            X, U = rng.standard_normal((x.size, 4)), np.zeros((u.size, 4))
            U[numbers] = rng.standard_normal((len(numbers), 4))
            # Counters, flags and random numbers stay; a small variance has a curvature of 1e6.
            X[(x == np.round(x)) | (np.abs(x) > 1e3) | (name == "nonlinear")] = 0.0

            def run(h: float, d: int, x: Vector = x, u: Vector = u, X: Matrix = X, U: Matrix = U) -> Vector:
                moved, out = x + h * X[:, d], np.zeros(len(block.outputs))
                step(block.arrays, q, moved, u + h * U[:, d], out)
                return np.concatenate([moved, out])

            found, ahead, out, Y = X.copy(), x.copy(), np.zeros(y.size), np.zeros((y.size, 4))
            tangent(block.arrays, q, ahead, u.copy(), out, found, U, Y, 4)
            np.testing.assert_array_equal(np.concatenate([ahead, out]), run(0.0, 0))
            for d in range(4):
                slope = (run(1e-6, d) - run(-1e-6, d)) / 2e-6
                # Curvature of steep integrals, 1e-12 of it, and rounding of 1e-16 / 1e-6.
                np.testing.assert_allclose(np.concatenate([found[:, d], Y[:, d]]), slope, rtol=1e-6, atol=1e-6)
        step(block.arrays, q, x, u.copy(), y)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mpc", "quadratic program"),
        ("kalman", "covariance"),
        ("adaptive", "learns its plant"),
    ],
)
def test_kinds_without_derivative_say_why(name: str, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        load_tangent(load(ROOT / "tests" / "golden" / f"{name}.npz").block().runtime)


# Small texts: one thing each.


def functions(body: str, before: str = "") -> SimpleNamespace:
    """Return step and its derivative, of three numbers of state, two inputs and two outputs."""
    arguments = "arrays: tuple, parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray, outputs: np.ndarray"
    lines = "\n".join("    " + line for line in body.strip().splitlines())
    text = f"import math\nimport numpy as np\n{before}\ndef step({arguments}) -> None:\n{lines}\n"
    names: dict[str, Callable[..., None]] = {}
    exec(with_tangent(text), names)
    return SimpleNamespace(step=names["step"], tangent=names["step_tangent"])


def derivative(f: SimpleNamespace, z: Vector, d: Matrix) -> Matrix:
    """Return what state and outputs are moved by along the columns of `d` (5, m) at `z`, state and inputs."""
    X, Y = d[:3].copy(), np.zeros((2, d.shape[1]))
    f.tangent((), np.zeros(0), z[:3].copy(), z[3:].copy(), np.zeros(2), X, d[3:], Y, d.shape[1])
    return np.vstack([X, Y])


def differences(f: SimpleNamespace, z: Vector, d: Matrix, h: float) -> Matrix:
    """Return the same by central differences."""

    def run(z: Vector) -> Vector:
        state, out = z[:3].copy(), np.zeros(2)
        f.step((), np.zeros(0), state, z[3:].copy(), out)
        return np.concatenate([state, out])

    return np.array([(run(z + h * column) - run(z - h * column)) / (2.0 * h) for column in d.T]).T


_PLAY = "state[0] = max(inputs[0] - 0.5, min(inputs[0] + 0.5, state[0]))"
CORNERS = {
    "play that is drawn along": (_PLAY, [0.25, 0.0, 0.0, 0.75, 0.0]),
    "play that stays": (_PLAY, [0.25, 0.0, 0.0, -0.25, 0.0]),
    "stalling drive": (
        "state[0] = min(0.5 * state[0] + 0.5 * inputs[0], max(state[1], state[0]))", [1.0, 0.5, 0.0, 1.0, 0.0],
    ),
    "absolute value": ("outputs[0] = abs(inputs[0]) + abs(inputs[0] - inputs[1])", [0.0] * 5),
    "range": ("outputs[0] = min(max(inputs[0], 0.0), 1.0)", [0.0] * 5),
    "end of a range": ("outputs[0] = min(max(inputs[0], -1.0), 0.0)", [0.0] * 5),
    "friction": ("outputs[0] = math.sqrt(inputs[0] * inputs[0])", [0.0] * 5),
    "length": ("outputs[1] = 2.0 * math.sqrt(inputs[0] * inputs[0] + inputs[1] * inputs[1])", [0.0] * 5),
}  # fmt: skip


@pytest.mark.parametrize(("body", "point"), CORNERS.values(), ids=CORNERS)
def test_at_a_corner_the_derivative_to_the_right_counts(body: str, point: list[float]) -> None:
    f, z, d = functions(body), np.array(point), np.eye(5)
    right = z + 2.0**-10 * d[3]
    # A 2^-20 on either side of there: lines, but for the length, which is round by 2^-20.
    slopes = differences(f, right, d, 2.0**-20)
    np.testing.assert_allclose(derivative(f, z, d), slopes, atol=1e-9)


SMOOTH = {
    "functions": """
a = math.sin(inputs[0]) * math.exp(-state[0]) + math.tanh(state[1]) ** 3
outputs[0] = math.atan2(a, 2.0 + inputs[1]) / (1.5 + math.cos(a)) - math.log(3.0 + a)
outputs[1] = math.atan(a) + math.sqrt(2.0 + a) - math.tan(0.1 * a) + np.sqrt(2.0 + a * a)
state[2] -= outputs[0] * inputs[1]
""",
    "branches": """
size = math.sqrt(state[0] * state[0] + state[1] * state[1])
part = math.sin(size) / size if size > 1e-9 else 1.0
if size > 0.1:
    state[0] *= part / size
    low, high = state[0], size * state[1]
else:
    low, high = 0.0, 1.0
outputs[0], outputs[1] = high + part, low
""",
    "loops": """
total = 0.0
x = np.empty(3)
for i in range(3):
    x[i] = state[i] * inputs[0]
    for j in range(i, 2):
        total += x[i] * inputs[j] / (2.0 + i)
state[1:] = state[:2].copy()
state[:1] = inputs[1:] - x[:1]
y = x[1:] + inputs
outputs[:] = y
outputs[0] += total
while total > 0.2:
    total *= 0.5
outputs[1] += max(total, -10.0, x[2] - 20.0)
""",
    "vectors": """
state[:] = turned(turned(state) - state)
start, line = state[:1], state[1:]
line[:] = inputs[0] * inputs[1] + start[0]
one, two, yes = both(inputs[0], state)
usable = told(state, two)
weights = np.array([2.0, 0.5])
w = inputs * weights
low, high = nearest(2.0, w)
outputs[0] = one * two + low if usable and yes else 0.0
outputs[1] = state[0] + one * high
""",
    "calls": """
fill(state, inputs[0] * inputs[1], outputs)
outputs[1] = poly(state, inputs, 4) + scaled(2.0 * state[0], inputs[1]) * half(inputs)
""",
}
HELPERS = """
def fill(x: np.ndarray, a: float, out: np.ndarray) -> None:
    for i in range(x.shape[0]):
        x[i] = x[i] * a
    out[0] = a + x[2]

def turned(x: np.ndarray) -> np.ndarray:
    if x[0] > 100.0:
        return x
    y = np.dot(np.array([[1.0, 2.0, 0.0], [0.0, 0.5, 1.0], [3.0, 0.0, 1.0]]), x)
    return y + x

def both(a: float, x: np.ndarray) -> tuple[float, float, bool]:
    x[0] += a * x[1]
    return a * x[1], a + x[0], a > 0.0

def told(x: np.ndarray, a: float) -> bool:
    x[1] = a * x[1]
    return a > -1e9

def nearest(gamma: float, w: np.ndarray) -> tuple[float, float]:
    d = gamma * math.sqrt((w[0] - 0.1) * (w[0] - 0.1) + (w[1] - 3.0) * (w[1] - 3.0))
    return 1.0 - d, 2.0 + d

def nearest_slopes(gamma: float, w: np.ndarray, low: float, high: float, slopes: np.ndarray) -> None:
    slopes[1, 0] = gamma * gamma * (w[0] - 0.1) / (high - 2.0)
    slopes[1, 1] = gamma * gamma * (w[1] - 3.0) / (high - 2.0)
    slopes[0] = -slopes[1]

def scaled(a: float, b: float) -> float:
    if a > b:
        return a * b
    return a - b

def half(x: np.ndarray) -> float:
    second = np.tanh(x / 2.0 - 1.0)
    return 3.0 - np.dot(np.array([1.0, 2.0]), second)

def power(x: np.ndarray, i: int, n: int) -> float:
    value = 1.0
    for k in range(3):
        if k < n:
            value *= x[i]
    return value

def poly(x: np.ndarray, u: np.ndarray, n: int) -> float:
    y = 1.0
    for i in range(2):
        inner = 0.0
        for k in range(n):
            inner += x[i] * u[1 - i] * k
        y += (i + 2) * power(x, i, 2) * inner
    return min(max(y, -100.0), 100.0)
"""


@pytest.mark.parametrize("body", SMOOTH.values(), ids=SMOOTH)
@pytest.mark.parametrize("seed", range(4))
def test_everything_a_step_is_written_in_is_differentiated(body: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    f = functions(body, HELPERS)
    d = np.hstack([np.eye(5), rng.standard_normal((5, 4))])
    z = rng.uniform(0.2, 1.0, 5)
    # h^2 of the third derivative, below 30 here, and rounding of 1e-16 / h.
    np.testing.assert_allclose(derivative(f, z, d), differences(f, z, d, 1e-5), rtol=1e-7, atol=1e-8)


def test_a_root_of_zero_is_moved_by_nothing() -> None:
    f = functions("d = inputs[0] - state[0]\noutputs[0] = math.sqrt(d * d * d * d + 0.0 * state[1]) + inputs[1]")
    z = np.array([0.5, 0.0, 0.0, 0.5, 0.0])
    np.testing.assert_array_equal(derivative(f, z, np.eye(5))[3], [0.0, 0.0, 0.0, 0.0, 1.0])


def test_sums_and_whole_layers_are_differentiated_in_reverse() -> None:
    text = f"import numpy as np\nimport math\n{HELPERS}\ndef step(arrays, parameters, state, inputs, outputs):\n"
    text = with_tangent(text + "    outputs[0] = poly(state, inputs, 3) + half(state[:2])\n")
    assert "def poly_back" in text
    assert "def half_back" in text
    assert "def poly_tangent" not in text


UNKNOWN = {
    "np.linalg.inv(state)": r"step: `.*linalg\.inv\(state\).*`",
    "math.gamma(state[0])": r"step: `math\.gamma\(state\[0\]\)`: the derivative of this function is not known",
    "state[0] ** state[1]": r"step: `state\[0\] \*\* state\[1\]`: powers",
    "state[0] // 2.0": r"step: `state\[0\] // 2\.0`: this operator",
}


@pytest.mark.parametrize(("expression", "match"), UNKNOWN.items(), ids=UNKNOWN)
def test_what_is_not_known_is_an_error_that_names_function_and_line(expression: str, match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        functions(f"outputs[0] = {expression}")


# In C

WRAPPER = """
#include "sn_kinds.h"
SN_EXPORT int run(int count, double **data, const int32_t *ranks, const int32_t *sizes, double *q, int32_t nq,
    double *x, int32_t nx, double *u, int32_t nu, double *y, int32_t ny, double *X, double *U, double *Y, int32_t m)
{
    static unsigned char room[1 << 22];
    sn_array arrays[32] = {{0}};
    sn_node node = {0};
    sn_work work = {0};
    for (int i = 0; i < count; i++) {
        const int32_t *n = sizes + 3 * i;
        sn_v1 v1 = {data[i], n[0], 1};
        sn_v2 v2 = {data[i], n[0], n[1], n[1], 1};
        sn_v3 v3 = {data[i], n[0], n[1], n[2], n[1] * n[2], n[2], 1};
        if (ranks[i] == 1) arrays[i].v1 = v1;
        if (ranks[i] == 2) arrays[i].v2 = v2;
        if (ranks[i] == 3) arrays[i].v3 = v3;
    }
    node.arrays = arrays; node.array_count = count;
    work.base = room; work.size = sizeof room; work.fuel = SN_FUEL;
    if (SN_STAY(work.out)) return 1;
    sn_v1 vq = {q, nq, 1}, vx = {x, nx, 1}, vu = {u, nu, 1}, vy = {y, ny, 1};
    sn_v2 rx = {X, nx, m, m, 1}, ru = {U, nu, m, m, 1}, ry = {Y, ny, m, m, 1};
    @(&work, &node, vq, vx, vu, vy, &rx, &ru, &ry, m);
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
@pytest.mark.parametrize("name", ["nn", "greybox", "play", "oe"])
def test_in_c_it_is_the_same(name: str, tmp_path: Path) -> None:
    block, unit = block_of(name), Unit()
    runtime = _Runtime(unit, with_tangent(bundle(block.runtime, loops=False)))
    c_name = _tangent_of(runtime, Arrays(ranks_of(block.runtime)))
    for path in (_sources.HERE / "c").glob("*.h"):
        shutil.copy(path, tmp_path)
    (tmp_path / "sn_kinds.h").write_text(unit.text().replace("sn_kinds[] = {\n", "sn_kinds[] = {{0}\n"))
    head = "#define SN_EXPORT\n"
    (tmp_path / "tangent.c").write_text(head + WRAPPER.replace("@", c_name))
    library = tmp_path / "tangent.so"
    flags = [flag for flag in _sources.FLAGS if flag != "-fvisibility=hidden"]
    command = ["gcc", *flags, "-w", "-fPIC", "-shared", str(tmp_path / "tangent.c"), "-o", str(library), "-lm"]
    subprocess.run(command, check=True, capture_output=True)
    x, u, q = moving(block, 20)
    rng = np.random.default_rng(0)
    X, U = rng.standard_normal((x.size, 7)), rng.standard_normal((8, 7))
    expected = along(block, x, u, q, X, U)
    y, Y = np.zeros(len(block.outputs)), np.zeros((len(block.outputs), 7))
    pointer = ctypes.POINTER(ctypes.c_double)

    def of(array: np.ndarray) -> ctypes._Pointer[ctypes.c_double]:
        return array.ctypes.data_as(pointer)

    shapes = [(*array.shape, *[1] * (3 - array.ndim)) for array in block.arrays]
    sizes = np.array(shapes, dtype=np.int32)
    ranks = np.array([array.ndim for array in block.arrays], dtype=np.int32)
    whole = ctypes.POINTER(ctypes.c_int32)
    code = ctypes.CDLL(str(library)).run(
        len(block.arrays), (pointer * len(block.arrays))(*map(of, block.arrays)), ranks.ctypes.data_as(whole),
        sizes.ctypes.data_as(whole), of(q), q.size, of(x), x.size, of(u), u.size, of(y), y.size, of(X), of(U), of(Y), 7,
    )  # fmt: skip
    assert code == 0
    # The C library's own sine and tanh are off by an ulp here and there; a network adds up some hundred of them.
    for a, b in zip(expected, (x, y, X, Y), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-13)
    assert math.isfinite(Y.sum())
