"""Kind `online_nlsm`: set membership that learns measured outputs while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from softneck.core import FileFormatError, Matrix, Progress, require_one_of, require_whole, silent
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import Recording

from ..models._arrays import within
from ..models._model import Model
from ._arrays import check_nlsm
from ._set_membership import SetMembership

# Nothing is fed back where the set stands on a base: what is measured moves the base, and the set learns nothing.
_FORMS = ("paper_eq21", "lags")
# Every step asks all points that were learnt, one after the other; 100,000 take longer than a sample.
_MOST = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class OnlineSetMembership:
    """A set as `SetMembership` finds it, which learns measured outputs while it runs.

    Attributes:
        capacity: how many learnt points of each output are kept; beyond it the oldest goes. What it was identified
            from stays.
        form: "paper_eq21" or "lags", whose regressors hold what is measured.
        output_lags, setpoint_lags, motor_lags, scale, output_weight, epsilon, motors: as in `SetMembership`.
    """

    capacity: int = 1000
    form: str = "paper_eq21"
    output_lags: tuple[int, ...] | None = None
    setpoint_lags: tuple[int, ...] | None = None
    motor_lags: tuple[int, ...] | None = None
    scale: str | tuple[float, ...] = "auto"
    output_weight: float | None = None
    epsilon: float | None = None
    motors: str | None = None

    def __post_init__(self) -> None:
        require_one_of("form", self.form, _FORMS)
        require_whole("capacity", self.capacity, 1, _MOST)
        self._set()

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify the set that it starts from; see `SetMembership.fit`."""
        found = self._set().fit(recordings, progress=progress)
        arrays = {**found.arrays, "learning": np.array([float(self.capacity)])}
        return replace(found, kind="online_nlsm", arrays=arrays, settings=asdict(self))

    def _set(self) -> SetMembership:
        return SetMembership(**{name: given for name, given in asdict(self).items() if name != "capacity"})


def check_online(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    check_nlsm(arrays, sizes)
    within(arrays["learning"], 1, _MOST, "the number of points that may be learnt")
    if arrays["b"].size:
        raise FileFormatError("a set on a base learns nothing; its array `b` must be empty.")
