"""What every way to a frequency response finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softneck.core import Vector

ComplexArray = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """An estimate at some frequencies; `G[k, i, a]` is from input a to output i, NaN where it was not excited.

    Attributes:
        frequency: (k,) rising [rad/s].
        response: (k, m, q).
        covariance: (k, m q, m q) of the estimate, entry i q + a for `G[i, a]`; noise and nonlinear distortion.
        freedom: (k,) degrees of freedom of the covariance.
        coherence: (k, m) what part of each output's power the inputs explain, 0 to 1.
        noise: (k, m, q) variance of the estimate by noise alone, None where it was not told apart.
    """

    frequency: Vector
    response: ComplexArray
    covariance: ComplexArray
    freedom: Vector
    coherence: Vector
    noise: Vector | None
