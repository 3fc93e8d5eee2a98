"""Upper bounds of the structured singular value of many matrices at once, by our own scalings.

`mu(M) = 1 / min{ |Delta| : det(I - M Delta) = 0 }` over block-diagonal Delta of a structure.

Upper bound: with D > 0 that commutes with the structure and a real G on its real scalars, `M* D M + j (G M - M* G)
<= beta^2 D` gives `mu <= beta` (Fan, Tits and Doyle 1991, IEEE Trans. Automatic Control 36:25; without G it is
Doyle's `min |D M D^-1|`, tight for three complex blocks or fewer). Any D and G give a valid bound; ours come from a
quasi-Newton descent on the smoothed largest eigenvalue, whose local minima are global (the problem is quasi-convex).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, Vector

Array = np.ndarray
Blocks = Sequence[tuple[int, int]]
# Sharpness of the smoothed maximum, relative to the bound: the last is off by log(n)/3000, 0.05 % for n = 4.
_SMOOTHING_SHARPNESS = (20.0, 150.0, 1000.0, 3000.0)
_MAX_ITERATIONS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """A block structure, and which rows and columns of M belong to which block.

    `real`: (blocks,) whether a block is a real scalar. `out_of`: (rows of M, blocks) 1 where a row feeds a block.
    `into`: (columns of M, blocks) 1 where a column comes from a block.
    """

    real: Array
    out_of: Array
    into: Array

    @classmethod
    def of(cls, blocks: Blocks) -> Structure:
        """Return the structure of `blocks` in the field's notation.

        `blocks`: of each block of Delta (-1, 0) for a real scalar, (1, 0) for a complex one, (rows, columns) for a full
        complex one; repeated scalars are not among them. Raises SettingsError: none, or another notation.
        """
        if not blocks:
            raise SettingsError("`blocks` is empty; give one pair for each block of Delta.")
        into, out_of, real = [], [], []
        for number, pair in enumerate(blocks):
            rows, columns = (int(value) for value in pair)
            if (rows, columns) in ((-1, 0), (1, 0)):
                rows, columns, is_real = 1, 1, rows < 0
            elif rows > 0 and columns > 0:
                is_real = False
            else:
                raise SettingsError(
                    f"`blocks[{number}]` is {tuple(pair)}; use (-1, 0) for a real scalar, (1, 0) for a complex one, "
                    "(rows, columns) for a full block. Repeated scalars are not supported."
                )
            into += rows * [number]
            out_of += columns * [number]
            real.append(is_real)
        eye = np.eye(len(blocks))
        return cls(np.array(real), eye[out_of], eye[into])

    def check(self, M: Array) -> Array:
        """Return `M` as (m, rows, columns); raise SettingsError if it does not fit the blocks."""
        stack = np.atleast_3d(np.asarray(M, dtype=np.complex128))
        stack = np.moveaxis(stack, -1, 0) if np.ndim(M) < 3 else stack
        shape = (self.out_of.shape[0], self.into.shape[0])
        if stack.shape[1:] != shape:
            raise SettingsError(f"M must be {shape[0]} x {shape[1]} for these blocks; got {stack.shape[1:]}.")
        if not np.isfinite(stack).all():
            raise SettingsError("M is not finite everywhere; it has a pole at one of the frequencies.")
        return stack


def mu_upper(M: Array, blocks: Blocks) -> Vector:
    """Return an upper bound (m,) of the structured singular value of M.

    Args:
        M: (rows, columns), or (m, rows, columns) for many, such as a response over frequency.
        blocks: see `Structure.of`; (-1, 0) real scalar, (1, 0) complex scalar, (rows, columns) full complex block.

    Raises:
        SettingsError: blocks that do not fit, or M not finite.
    """
    structure = Structure.of(blocks)
    M = structure.check(M)
    reals = np.flatnonzero(structure.real)
    size = np.maximum(np.linalg.norm(M, 2, axis=(1, 2)), 1e-300)
    x = _balance_blocks(M, structure)
    theta = np.concatenate([x, np.zeros((M.shape[0], reals.size))], axis=1)
    problem = _EigenvalueProblem(M / size[:, None, None], structure, reals)
    best, where = problem.largest_eigenvalue(theta), theta.copy()
    # The last d is free: only ratios count.
    free = np.ones(theta.shape[1])
    free[x.shape[1] - 1] = 0.0
    for sharpness in _SMOOTHING_SHARPNESS if theta.shape[1] > 1 or reals.size else ():
        scale = np.maximum(np.abs(best), 1e-3)
        theta = _descend(problem, where, sharpness / scale, free)
        value = problem.largest_eigenvalue(theta)
        better = value < best
        best, where = np.where(better, value, best), np.where(better[:, None], theta, where)
    return size * np.sqrt(np.maximum(best, 0.0))


class _EigenvalueProblem:
    """Largest eigenvalue of `M_D* M_D + j (G M_D - M_D* G)`, sharp and smoothed, with its gradient."""

    def __init__(self, M: Array, structure: Structure, reals: Array) -> None:
        self.M, self.structure, self.reals = M, structure, reals
        self.rows = np.array([int(np.argmax(structure.out_of[:, b])) for b in reals], dtype=int)
        self.columns = np.array([int(np.argmax(structure.into[:, b])) for b in reals], dtype=int)

    def largest_eigenvalue(self, theta: Matrix) -> Vector:
        return np.linalg.eigvalsh(self._matrices(theta, slice(None))[2])[:, -1]

    def smooth_eigenvalue(self, theta: Matrix, sharpness: Vector, which: Array) -> tuple[Vector, Matrix]:
        scaled, G, H = self._matrices(theta, which)
        values, V = np.linalg.eigh(H)
        shifted = sharpness[:, None] * (values - values[:, -1:])
        weights = np.exp(shifted)
        total = weights.sum(axis=1)
        value = values[:, -1] + np.log(total) / sharpness
        q = scaled @ V
        A = np.conj(np.swapaxes(V, 1, 2)) @ (np.conj(np.swapaxes(scaled, 1, 2)) + 1j * G)
        rows = np.einsum("mkr,mrk->mkr", A, q)
        columns = np.einsum("mkc,mck->mkc", A @ scaled, V)
        parts = rows @ self.structure.out_of - columns @ self.structure.into
        share = weights / total[:, None]
        gradient = 2.0 * np.einsum("mk,mkb->mb", share, parts.real)
        crossed = 1j * np.conj(V[:, self.columns]) * q[:, self.rows]
        more = 2.0 * np.einsum("mk,mgk->mg", share, crossed.real)
        return value, np.concatenate([gradient, more], axis=1)

    def _matrices(self, theta: Matrix, which: Array | slice) -> tuple[Array, Array, Array]:
        n = self.structure.real.size
        d, g, M = np.exp(theta[:, :n]), theta[:, n:], self.M[which]
        scaled = (d @ self.structure.out_of.T)[:, :, None] * M / (d @ self.structure.into.T)[:, None, :]
        G = np.zeros((M.shape[0], M.shape[2], M.shape[1]))
        G[:, self.columns, self.rows] = g
        half = np.conj(np.swapaxes(scaled, 1, 2)) @ scaled + 2j * (G @ scaled)
        return scaled, G, 0.5 * (half + np.conj(np.swapaxes(half, 1, 2)))


def _descend(problem: _EigenvalueProblem, start: Matrix, sharpness: Vector, free: Vector) -> Matrix:
    """Minimise the smoothed eigenvalue of all matrices at once by BFGS with backtracking (Nocedal and Wright 2006)."""
    theta = start.copy()
    m, p = theta.shape
    B = np.tile(np.diag(free), (m, 1, 1)) / sharpness[:, None, None]
    active = np.arange(m)
    f, gradient = problem.smooth_eigenvalue(theta, sharpness, active)
    gradient *= free
    for _ in range(_MAX_ITERATIONS):
        t, fa, ga = theta[active], f[active], gradient[active]
        step = -np.einsum("mij,mj->mi", B[active], ga)
        slope = np.einsum("mi,mi->m", step, ga)
        new_t, new_f, new_g = _backtrack(problem, t, step, fa, slope, sharpness[active], active)
        new_g = np.where(np.isfinite(new_g), new_g * free, ga)
        s, y = new_t - t, new_g - ga
        sy = np.einsum("mi,mi->m", s, y)
        update = sy > 1e-14
        rho = np.where(update, 1.0 / np.where(update, sy, 1.0), 0.0)
        left = np.eye(p) - rho[:, None, None] * np.einsum("mi,mj->mij", s, y)
        B[active] = left @ B[active] @ np.swapaxes(left, 1, 2) + rho[:, None, None] * np.einsum("mi,mj->mij", s, s)
        # Along a straight slope there is no curvature to learn from: go further.
        B[active[~update]] *= 4.0
        theta[active], f[active], gradient[active] = new_t, new_f, new_g
        # A gain below a tenth of what smoothing loses is none.
        active = active[(fa - new_f > 1e-4 / sharpness[active]) & (new_f > 0.0)]
        if active.size == 0:
            break
    return theta


def _backtrack(
    problem: _EigenvalueProblem, t: Matrix, step: Matrix, f: Vector, slope: Vector, sharpness: Vector, which: Array
) -> tuple[Matrix, Vector, Matrix]:
    # No step of a logarithm is longer than 2: what far scalings say is noise.
    length = np.minimum(1.0, 2.0 / np.maximum(np.abs(step).max(axis=1), 1e-300))
    new_t, new_f, new_g = t.copy(), f.copy(), np.full_like(t, np.nan)
    todo = np.arange(f.size)
    for _ in range(25):
        trial = t[todo] + length[todo, None] * step[todo]
        value, gradient = problem.smooth_eigenvalue(trial, sharpness[todo], which[todo])
        done = value <= f[todo] + 1e-4 * length[todo] * slope[todo]
        at = todo[done]
        new_t[at], new_f[at], new_g[at] = trial[done], value[done], gradient[done]
        todo = todo[~done]
        if todo.size == 0:
            break
        length[todo] *= 0.4
    return new_t, new_f, new_g


def _balance_blocks(M: Array, structure: Structure) -> Matrix:
    """Return log d (m, blocks) that balances the norms of the blocks (Osborne 1960, J. ACM 7:338)."""
    N = np.sqrt(np.einsum("mij,ik,jl->mkl", np.abs(M) ** 2, structure.out_of, structure.into))
    n = N.shape[1]
    x = np.zeros((M.shape[0], n))
    off = ~np.eye(n, dtype=bool)
    for _ in range(8):
        for k in range(n):
            others = off[k]
            scaled = np.exp(x[:, :, None] - x[:, None, :]) * N
            row, column = scaled[:, k, others].sum(axis=1), scaled[:, others, k].sum(axis=1)
            # A block that is not coupled both ways keeps a bounded scaling.
            ratio = np.log(np.maximum(column, 1e-12) / np.maximum(row, 1e-12))
            x[:, k] = np.clip(x[:, k] + 0.5 * ratio, -8.0, 8.0)
    return x - x[:, -1:]


def two_scalars(M: Array) -> Array:
    """Return the structured singular value (...) of 2 x 2 matrices for two complex scalars, exactly.

    With d M d^-1 the determinant stays, and the Frobenius norm is least where both off-diagonal sizes agree; so is
    the larger singular value, for their squares sum to the one and multiply to the other. Tight for two blocks.
    """
    off = np.abs(M[..., 0, 1] * M[..., 1, 0])
    total = np.abs(M[..., 0, 0]) ** 2 + np.abs(M[..., 1, 1]) ** 2 + 2.0 * off
    det = np.abs(M[..., 0, 0] * M[..., 1, 1] - M[..., 0, 1] * M[..., 1, 0])
    return 0.5 * (np.sqrt(total + 2.0 * det) + np.sqrt(np.maximum(total - 2.0 * det, 0.0)))
