"""Defaults that were chosen for the neck."""

from __future__ import annotations


class NeckDefault(float):
    """A number that stands for a neck where nobody says another; for other robots it says nothing.

    It is the number in all that it does, and told from the same number given on purpose by its type.
    """

    __slots__ = ()


class NeckCount(int):
    """The same of whole numbers."""

    __slots__ = ()
