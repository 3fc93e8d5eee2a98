"""Linear kinds as python-control systems, and as the paper writes them (Eq. 31)."""

from __future__ import annotations

from collections.abc import Mapping

import control
import numpy as np

from softneck.core import Matrix, SettingsError, require_one_of

KINDS = ("rls",)
_OUTPUTS = ("pitch", "roll")
_INPUT_NAMES = ("theta_i", "phi_i")


def transfer_function(
    kind: str, sample_time: float, arrays: Mapping[str, Matrix], output: str, angle_unit: str
) -> control.TransferFunction:
    """Return b z^-d / (1 + a_1 z^-1 + ...) from theta_i to pitch or phi_i to roll, with its delay in full.

    Raises:
        SettingsError: the kind is not linear, or an unknown output or unit.
    """
    _require_linear(kind)
    require_one_of("output", output, _OUTPUTS)
    require_one_of("angle_unit", angle_unit, ("rad", "deg"))
    axis = _OUTPUTS.index(output)
    a, b, delay = arrays["a"][axis], arrays["b"][axis], int(arrays["delay"][axis])
    # In powers of z: the numerator b_1 z^(n-1-d)... needs n = max(na, nb + d) so that no power is negative.
    n = max(a.size, b.size + delay)
    denominator = np.zeros(n + 1)
    denominator[: a.size + 1] = np.concatenate([[1.0], a])
    numerator = np.zeros(n + 1)
    numerator[1 + delay : 1 + delay + b.size] = b
    scale = 180.0 / np.pi if angle_unit == "deg" else 1.0
    return control.TransferFunction(
        scale * numerator,
        denominator,
        sample_time,
        inputs=[_INPUT_NAMES[axis]],
        outputs=[output],
        name=f"G_{output}",
    )


def state_space(kind: str, sample_time: float, arrays: Mapping[str, Matrix]) -> control.StateSpace:
    """Return the two axes side by side as one discrete state space."""
    parts = [control.ss(transfer_function(kind, sample_time, arrays, output, "rad")) for output in _OUTPUTS]
    joined = control.append(*parts)
    return control.StateSpace(
        joined.A,
        joined.B,
        joined.C,
        joined.D,
        sample_time,
        inputs=list(_INPUT_NAMES),
        outputs=list(_OUTPUTS),
        name="neck",
    )


def describe(sample_time: float, arrays: Mapping[str, Matrix], axis: int) -> str:
    """Return one axis in the paper's form, `G = exp(-L s) K/(s + p)`, in degrees, where it has one real pole."""
    numbers = continuous_parameters(sample_time, arrays, axis)
    if numbers is None:
        poles = np.roots(np.concatenate([[1.0], arrays["a"][axis]]))
        return f"{_OUTPUTS[axis]}: discrete poles {np.array2string(poles, precision=4)}"
    K, p, L = numbers
    gain = np.degrees(K / p)
    return f"{_OUTPUTS[axis]}: G(s) = exp(-{L:.2f} s) {np.degrees(K):.3f}/(s + {p:.3f}) deg/rad, static gain {gain:.3f}"


def continuous_parameters(
    sample_time: float, arrays: Mapping[str, Matrix], axis: int
) -> tuple[float, float, float] | None:
    """Return K [rad/(rad s)], pole p [1/s] and dead time L [s] of a one-pole axis; None for another order."""
    a, b = arrays["a"][axis], arrays["b"][axis]
    if a.size != 1 or b.size != 1 or not 0.0 < -a[0] < 1.0:
        return None
    p = -np.log(-a[0]) / sample_time
    return float(b[0] * p / (1.0 + a[0])), float(p), float(arrays["delay"][axis] * sample_time)


def _require_linear(kind: str) -> None:
    if kind not in KINDS:
        raise SettingsError(f"a model of kind `{kind}` is not linear; use one of kind {', '.join(KINDS)}.")
