"""Choosing on all necks but one: no neck has a say in what it judges."""

from __future__ import annotations

import numpy as np

from .choosing import choice, leave_one_out, ratios


def scores(*rows: tuple[float, ...]) -> dict[str, np.ndarray]:
    return {f"neck {i}": np.array([row]) for i, row in enumerate(rows)}


def test_a_neck_has_no_say_in_what_it_is_judged_by() -> None:
    rows = np.random.default_rng(0).uniform(0.5, 2.0, (5, 3, 4))
    necks = {f"neck {i}": rows[i] for i in range(5)}
    for fold in leave_one_out(necks, 1):
        changed = necks | {fold.left_out: necks[fold.left_out] * np.array([1e-3, 1.0, 5.0, 0.1])}
        again = next(item for item in leave_one_out(changed, 1) if item.left_out == fold.left_out)
        assert again.chosen == fold.chosen


def test_one_neck_that_likes_another_candidate_is_outvoted_and_says_what_it_costs() -> None:
    folds = leave_one_out(scores((1.0, 0.5), (1.0, 0.5), (1.0, 2.0)), 0)
    assert [fold.chosen for fold in folds] == [0, 0, 1]
    assert [fold.best for fold in folds] == [1, 1, 0]
    assert folds[2].ratios[folds[2].chosen] == 2.0


def test_the_default_stays_where_nothing_is_better() -> None:
    assert choice({"a": np.array([1.0, 1.0, 1.0])}, 2) == 2


def test_a_neck_with_larger_errors_counts_no_more() -> None:
    rows = np.array([[1.0, 0.7], [0.8, 0.9]])
    # Powers of two: to the bit.
    np.testing.assert_array_equal(ratios(rows, 0), ratios(64.0 * rows, 0))
