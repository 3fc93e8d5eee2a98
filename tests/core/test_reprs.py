"""Results show themselves in at most three lines."""

from __future__ import annotations

import dataclasses
import inspect

import pytest

from softneck.core import resolve
from softneck.core._display import ReprMixin

from ..test_layout import public_names
from ..verification.necks import linear_neck


def test_whatever_holds_arrays_or_many_things_has_a_short_repr() -> None:
    """Arrays and tables of a public class would fill a screen."""
    long = []
    for name in public_names():
        thing = resolve(name)
        if inspect.isclass(thing) and dataclasses.is_dataclass(thing) and not issubclass(thing, ReprMixin):
            kinds = [str(field.type) for field in dataclasses.fields(thing)]
            if any(word in kind for kind in kinds for word in ("Matrix", "Vector", "ndarray", "[str, Any]")):
                long.append(name)
    assert long == []


@pytest.mark.parametrize("kind", ["pi", "mpc"])
@pytest.mark.usefixtures("plain_steps_of_blocks")
def test_a_controller_fits_three_lines(kind: str) -> None:
    from softneck.design import design_controller

    shown = repr(design_controller(kind, linear_neck()))
    assert len(shown.splitlines()) <= 3
    assert max(map(len, shown.splitlines())) <= 120
