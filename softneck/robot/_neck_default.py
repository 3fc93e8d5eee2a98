"""Defaults that were chosen for the neck."""

from __future__ import annotations


class NeckDefault(float):
    """A default chosen for the neck; other robots do not use it.

    It behaves like the number; its type distinguishes it from the same number given explicitly.
    """

    __slots__ = ()


class NeckCount(int):
    """The same for whole numbers."""

    __slots__ = ()
