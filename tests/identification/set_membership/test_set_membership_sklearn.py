"""The regressor among scikit-learn's own tools."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

from softneck.identification import Cones

sklearn = pytest.importorskip("sklearn", reason="scikit-learn is not installed")

from sklearn.model_selection import GridSearchCV  # noqa: E402
from sklearn.pipeline import make_pipeline  # noqa: E402
from sklearn.preprocessing import StandardScaler  # noqa: E402
from sklearn.utils.estimator_checks import parametrize_with_checks  # noqa: E402

from softneck.identification.sklearn import SetMembershipRegressor  # noqa: E402


@parametrize_with_checks([SetMembershipRegressor()])
def test_scikit_learns_own_checks(estimator: SetMembershipRegressor, check: Callable[..., None]) -> None:
    """All of them: none is expected to fail."""
    check(estimator)


def data() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (400, 2))
    return X, np.sin(3 * X[:, 0]) + X[:, 1] + 0.01 * rng.uniform(-1, 1, 400)


def test_it_is_the_same_estimator() -> None:
    X, y = data()
    regressor = SetMembershipRegressor(epsilon=0.02, n_jobs=-1).fit(X, y)
    estimate, low, high = regressor.predict(X + 0.1, return_bounds=True)
    cones = Cones(epsilon=0.02).fit(X, y)
    np.testing.assert_array_equal((low, high), cones.bounds(X + 0.1))
    np.testing.assert_array_equal(estimate, regressor.predict(X + 0.1))
    assert regressor.score(X, y) > 0.99


def test_it_stands_in_a_pipeline_and_is_searched() -> None:
    X, y = data()
    search = GridSearchCV(
        make_pipeline(StandardScaler(), SetMembershipRegressor()),
        {"setmembershipregressor__epsilon": [0.02, 2.5]},
        cv=3,
    )
    assert search.fit(X, y).best_params_ == {"setmembershipregressor__epsilon": 0.02}


def test_what_the_data_deny_is_a_value_error_that_names_the_rows() -> None:
    with pytest.raises(ValueError, match=r"contradicted by the data .* rows 0 and 1"):
        SetMembershipRegressor(gamma=0.5, epsilon=0.1).fit([[0.0], [1.0]], [0.0, 1.0])


def test_the_rest_works_without_scikit_learn() -> None:
    code = "import sys; sys.modules['sklearn'] = None; import softneck.identification as i; print(i.Cones().rule)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "paper"
