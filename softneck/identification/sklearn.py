"""Set membership as a scikit-learn regressor, over the same core; needs scikit-learn."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin

from softneck.core import SoftneckError

from .set_membership._cones import Cones


class SetMembershipRegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """`Cones` with scikit-learn's face: parameters are kept as given, and checked in `fit`.

    Constant targets are not an error here: with `epsilon=None` they fit with a slope and a noise of zero.

    Attributes:
        cones_: the fitted `ConeSet`, also for `outside` and `save`.
        n_features_in_: number of regressors.
        gamma_: (m,) slope.
        epsilon_: (m,) noise bound.
    """

    def __init__(
        self,
        *,
        gamma: float | tuple[float, ...] | None = None,
        epsilon: float | tuple[float, ...] | None = None,
        scale: tuple[float, ...] | None = None,
        rule: str = "paper",
        regions: int = 1,
        n_jobs: int | None = None,
    ) -> None:
        """Keep the settings of `Cones`; `n_jobs` threads answer, None one, -1 all cores."""
        self.gamma = gamma
        self.epsilon = epsilon
        self.scale = scale
        self.rule = rule
        self.regions = regions
        self.n_jobs = n_jobs

    def fit(self, X: ArrayLike, y: ArrayLike) -> SetMembershipRegressor:
        """Store the data (N, n) and (N,) or (N, m), and find what gamma and epsilon leave open."""
        from sklearn.utils.validation import validate_data

        given: tuple[Any, Any] = (X, y)  # scikit-learn's own annotation knows strings only
        X, y = validate_data(self, *given, multi_output=True, y_numeric=True, dtype=np.float64, ensure_min_samples=2)
        y = np.asarray(y, dtype=np.float64)
        epsilon = self.epsilon
        if epsilon is None and self.gamma is None and (np.ptp(y, axis=0) == 0.0).any():
            epsilon = 0.0
        try:
            cones = Cones(gamma=self.gamma, epsilon=epsilon, scale=self.scale, rule=self.rule, regions=self.regions)
            self.cones_ = cones.fit(X, y, workers=self._workers())
        except SoftneckError as error:
            raise ValueError(str(error)) from error  # what scikit-learn's own tools catch
        self.gamma_, self.epsilon_ = self.cones_.gamma, self.cones_.epsilon
        return self

    def predict(self, X: ArrayLike, *, return_bounds: bool = False) -> Any:
        """Return the central estimate, or with `return_bounds` (estimate, f_l, f_u)."""
        from sklearn.utils.validation import check_is_fitted, validate_data

        check_is_fitted(self)
        X = validate_data(self, cast(Any, X), reset=False, dtype=np.float64)
        low, high = self.cones_.bounds(X, workers=self._workers())
        estimate = 0.5 * (low + high)
        return (estimate, low, high) if return_bounds else estimate

    def _workers(self) -> int | None:
        return 1 if self.n_jobs is None else None if self.n_jobs < 0 else self.n_jobs
