"""A linear system from the answers to small pulses (Ho and Kalman 1966; Juang and Pappa 1985).

From one saved state each input is held off its value for one sample, up and down; half the difference of the outputs is
the answer to a pulse, h(k). The least order whose system answers all pulses alike is taken: A, B, C from the singular
vectors of the matrix of h(i + j + 1), D = h(0).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.runtime import Block, State

from ..parts._fmu_part import FmuPart

# Samples that an answer is followed for: two of ours' seconds and a half.
SAMPLES = 128
# A pulse, of the size of an input's moves: its square is what curvature leaves in the difference, 1e-8.
_PULSE = 1e-4
# What answers may differ by, of the largest: curvature, and rounding of the difference, with room.
_ALIKE = 1e-6
_ROUNDING = 1e3 * float(np.finfo(float).eps)
_MOST_STATES = 60


class Steps(Protocol):
    """What can be stepped from one state again and again."""

    sample_time: float

    def step(self, inputs: Vector) -> None:
        """Go on by one sample."""
        ...

    def outputs(self, inputs: Vector) -> Vector:
        """Return the outputs now, with these inputs."""
        ...

    def keep(self) -> None:
        """Remember this state."""
        ...

    def go_back(self) -> None:
        """Return to the state that was kept."""
        ...


class BlockSteps:
    """A block."""

    def __init__(self, block: Block, state: State) -> None:
        """Begin at `state`."""
        self.sample_time = block.sample_time
        self._block, self._now, self._kept = block, state, state

    def step(self, inputs: Vector) -> None:
        """Go on by one sample."""
        self._now, _ = self._block.step(self._now, inputs)

    def outputs(self, inputs: Vector) -> Vector:
        """Return the outputs now: a plant's are those of its state, all others' follow the inputs at once."""
        ahead = self._block.role in ("plant", "reference")
        return self._now.outputs if ahead else self._block.step(self._now, inputs)[1]

    def keep(self) -> None:
        """Remember this state."""
        self._kept = self._now

    def go_back(self) -> None:
        """Return to the state that was kept."""
        self._now = self._kept


class FmuSteps:
    """An FMU that runs."""

    def __init__(self, part: FmuPart, parameters: Mapping[str, float], inputs: Vector) -> None:
        """Start it at 0 s with `inputs`."""
        self.sample_time = part.sample_time
        self._part, self._count, self._kept = part, 0, 0
        part.start(0.0, parameters)
        part.outputs_at(inputs)
        part.keep()  # one that cannot says so before it has run for long

    def step(self, inputs: Vector) -> None:
        """Go on by one sample."""
        self._part.advance(self._count * self.sample_time, inputs)
        self._count += 1

    def outputs(self, inputs: Vector) -> Vector:
        """Return the outputs now, with these inputs."""
        return self._part.outputs_at(inputs)

    def keep(self) -> None:
        """Remember this state."""
        self._kept = self._count
        self._part.keep()

    def go_back(self) -> None:
        """Return to the state that was kept."""
        self._count = self._kept
        self._part.go_back()


def realised(
    steps: Steps, held: Vector, moved: list[int], sizes: list[float], shown: list[int], name: str
) -> tuple[Matrix, Matrix, Matrix, Matrix, float]:
    """Return A, B, C, D of least order that answer pulses as `steps` does from where it is, and what they miss.

    Args:
        steps: what is stepped.
        held: (inputs,) the inputs off which pulses go.
        moved, sizes: the inputs that are moved, and how large their moves are.
        shown: the outputs that are looked at.
        name: for messages.

    Raises:
        SettingsError: nothing to move or look at, or no input moves an output.
    """
    if not moved or not shown:
        raise SettingsError(f"{name}: has no {'output' if moved else 'input'} that is a number, so no linear system.")
    h, noise = _answers(steps, held, moved, sizes, shown)
    scale = float(np.abs(h).max())
    if not np.isfinite(scale):
        raise SettingsError(f"{name}: its outputs are not finite there, or after a pulse.")
    if scale <= noise:
        raise SettingsError(f"{name}: no input moves an output within {SAMPLES} samples from there.")
    half, outputs, inputs = (SAMPLES - 1) // 2, len(shown), len(moved)
    H = np.block([[h[i + j + 1] for j in range(half)] for i in range(half)])
    shifted = np.block([[h[i + j + 2] for j in range(half)] for i in range(half)])
    left, s, right = np.linalg.svd(H, full_matrices=False)
    best: Any = None
    for order in range(min(_MOST_STATES, int(np.sum(s > noise))) + 1):
        root = np.sqrt(s[:order])
        A = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
        B, C = root[:, None] * right[:order, :inputs], left[:outputs, :order] * root
        missed = float(np.abs(_markov(A, B, C, h[0]) - h).max()) / scale
        if best is None or missed < best[-1]:
            best = (A, B, C, h[0], missed)
        if missed <= max(_ALIKE, noise / scale):
            break
    return best


def _answers(
    steps: Steps, held: Vector, moved: list[int], sizes: list[float], shown: list[int]
) -> tuple[np.ndarray, float]:
    """Return answers (SAMPLES, outputs, inputs) for pulses of 1, and what rounding leaves in them."""
    h = np.empty((SAMPLES, len(shown), len(moved)))
    noise = 0.0
    steps.keep()
    for column, (i, size) in enumerate(zip(moved, sizes, strict=True)):
        off = _PULSE * size
        sides = []
        for sign in (1.0, -1.0):
            steps.go_back()
            u = held.copy()
            u[i] += sign * off
            seen = []
            for _ in range(SAMPLES):
                seen.append(np.array(steps.outputs(u))[shown])
                steps.step(u)
                u = held
            sides.append(np.array(seen))
        h[:, :, column] = (sides[0] - sides[1]) / (2.0 * off)
        noise = max(noise, _ROUNDING * float(np.abs(sides[0]).max()) / off)
    steps.go_back()
    return h, noise


def _markov(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> np.ndarray:
    answers, x = [D], B
    for _ in range(SAMPLES - 1):
        answers.append(C @ x)
        x = A @ x
    return np.array(answers)
