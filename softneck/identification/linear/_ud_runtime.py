"""Recursive least squares with the covariance kept as U D U' (Bierman 1977, sec. V.2): it stays positive."""

import numpy as np


def ud_update(
    factor: np.ndarray,
    scale: np.ndarray,
    theta: np.ndarray,
    phi: np.ndarray,
    target: float,
    forgetting: float,
    gain: np.ndarray,
) -> float:
    """Update by one row (Eq. 28-30), in place; return epsilon(t+1), the error before it.

    `factor` (n, n) is U transposed, whose diagonal of ones is not stored; `scale` (n,) is D; `gain` (n,) is scratch.
    """
    error = target  # Eq. 30
    for i in range(theta.shape[0]):
        error -= theta[i] * phi[i]
    # alpha grows from lambda to lambda + phi' F phi, the denominator of Eq. 29, column by column.
    alpha = forgetting
    inverse = 1.0 / forgetting
    age = inverse
    for j in range(theta.shape[0]):
        # f = U' phi and g = D f, so that phi' F phi is the sum of f g.
        f = phi[j]
        for i in range(j):
            f += factor[j, i] * phi[i]
        g = scale[j] * f
        mu = -f * inverse  # by alpha of the columns before
        before = alpha
        alpha += f * g
        inverse = 1.0 / alpha
        # D changes by positive factors alone: no rounding turns its sign. 1 / lambda is the forgetting.
        scale[j] *= before * inverse * age
        for i in range(j):
            # Either needs the other's old value: U that of the gain, the gain that of U.
            u = factor[j, i]
            factor[j, i] = u + mu * gain[i]
            gain[i] += u * g
        gain[j] = g
    # gain / alpha is F(t+1) phi (Eq. 28).
    for i in range(theta.shape[0]):
        theta[i] += gain[i] * (error * inverse)
    return error


def ud_trace(factor: np.ndarray, scale: np.ndarray) -> float:
    """Return the trace of U D U'."""
    total = 0.0
    for j in range(scale.shape[0]):
        column = 1.0  # U's one
        for i in range(j):
            column += factor[j, i] * factor[j, i]
        total += scale[j] * column
    return total


def is_stable(a: np.ndarray, radius: float, work: np.ndarray) -> bool:
    """Return whether all roots of z^n + a_1 z^(n-1) + ... lie within `radius` (Schur-Cohn); `work` (2n,) is scratch."""
    n = a.shape[0]
    power = 1.0
    for i in range(n):
        # Roots within `radius` are those of a(radius z) within the unit circle.
        power *= radius
        work[i] = a[i] / power
    for m in range(n, 0, -1):
        k = work[m - 1]
        if not abs(k) < 1.0:  # and not `>= 1`: NaN must not pass for stable
            return False
        # Down by one order, with all roots still within.
        for i in range(m - 1):
            work[n + i] = (work[i] - k * work[m - 2 - i]) / (1.0 - k * k)
        for i in range(m - 1):
            work[i] = work[n + i]
    return True


def ud_guarded(
    regressors: np.ndarray,
    targets: np.ndarray,
    theta: np.ndarray,
    factor: np.ndarray,
    scale: np.ndarray,
    guards: np.ndarray,
    tally: np.ndarray,
    history: np.ndarray,
) -> None:
    """Update by all rows, with guards.

    `guards` = [forgetting, bound on the trace of F (0: none), dead zone, number of a (0: no projection), radius].
    `tally` (4,) counts the rows and their squared errors (both forgotten), the dead-zone rows and the projections.
    `history` (rows or 0, 1 + 2n) takes the error, the parameters and the diagonal of F of each row.
    """
    n = theta.shape[0]
    forgetting, bound, dead_zone, na, radius = guards[0], guards[1], guards[2], int(guards[3]), guards[4]
    gain = np.zeros(n)
    before = np.zeros(n)
    work = np.zeros(2 * na)
    for t in range(regressors.shape[0]):
        phi = regressors[t]
        error = targets[t]
        for i in range(n):
            error -= theta[i] * phi[i]
        # A row in the dead zone leaves F unchanged too.
        if abs(error) > dead_zone or dead_zone == 0.0:
            before[:] = theta
            ud_update(factor, scale, theta, phi, targets[t], forgetting, gain)
            after = targets[t]
            for i in range(n):
                after -= theta[i] * phi[i]
            # error * after is the a-posteriori sum of squares of least squares (Ljung 1999, sec. 11.2).
            tally[0] = forgetting * tally[0] + 1.0
            tally[1] = forgetting * tally[1] + error * after
            if na > 0 and not is_stable(theta[:na], radius, work):
                tally[3] += 1.0
                # Only theta is projected; F keeps its update.
                ud_retreat(theta, before, na, radius, work)
            if bound > 0.0:
                trace = ud_trace(factor, scale)
                if trace > bound:
                    # All directions shrink alike, so that the shape of F stays.
                    scale *= bound / trace
        else:
            tally[2] += 1.0
        if history.shape[0] > 0:
            ud_note(history[t], error, theta, factor, scale)


def ud_retreat(theta: np.ndarray, before: np.ndarray, na: int, radius: float, work: np.ndarray) -> None:
    """Halve the step from `before` until the poles are within `radius`; stay there if ten halves do not do."""
    for _ in range(10):
        theta[:] = 0.5 * (theta + before)
        if is_stable(theta[:na], radius, work):
            return
    theta[:] = before


def ud_note(row: np.ndarray, error: float, theta: np.ndarray, factor: np.ndarray, scale: np.ndarray) -> None:
    """Write [error, theta, diagonal of F] into `row`."""
    n = theta.shape[0]
    row[0] = error
    for i in range(n):
        row[1 + i] = theta[i]
        diagonal = scale[i]  # F_ii, with the one of U
        for j in range(i + 1, n):
            diagonal += scale[j] * factor[j, i] * factor[j, i]
        row[1 + n + i] = diagonal
