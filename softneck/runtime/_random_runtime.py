"""MRG32k3a: a random number generator with a state of six floats (L'Ecuyer 1999, Operations Research 47:159).

All its arithmetic is exact in float64, so plain Python, numba and C agree to the bit, and the generator's state is part
of a model's state vector.
"""

import math

import numpy as np

_M1 = 4294967087.0
_M2 = 4294944443.0


def random_seed(s: np.ndarray, seed: float) -> None:
    """Fill the state `s` (6,) from an integer seed >= 0; equal seeds give equal streams."""
    z = float(int(seed) % 2147483646) + 1.0  # 1 to 2^31 - 2: neither 0 nor the modulus
    for i in range(6):
        # Park-Miller minimal standard generator: exact in float64, never 0.
        z = (16807.0 * z) % 2147483647.0
        s[i] = z
    # Streams of neighbouring seeds start alike: discard the first numbers.
    for _ in range(12):
        random_uniform(s)


def random_uniform(s: np.ndarray) -> float:
    """Return a number in (0, 1) and advance the state `s` (6,)."""
    # Products stay below 2^53, so that nothing is rounded; `%` of Python and numba is never negative.
    a = (1403580.0 * s[1] - 810728.0 * s[0]) % _M1
    s[0] = s[1]
    s[1] = s[2]
    s[2] = a
    b = (527612.0 * s[5] - 1370589.0 * s[3]) % _M2
    s[3] = s[4]
    s[4] = s[5]
    s[5] = b
    d = a - b
    # The two components, modulo m1, from 1 to m1: neither 0 nor 1 comes out, and the logarithm exists.
    if d <= 0.0:
        d += _M1
    return d / (_M1 + 1.0)


def random_normal(s: np.ndarray) -> float:
    """Return a standard normal number by the polar method (Marsaglia and Bray 1964)."""
    while True:
        v = 2.0 * random_uniform(s) - 1.0
        w = 2.0 * random_uniform(s) - 1.0
        r = v * v + w * w
        # The second number that the method gives is discarded: the state would have to hold it.
        if 0.0 < r < 1.0:
            return v * math.sqrt(-2.0 * math.log(r) / r)
