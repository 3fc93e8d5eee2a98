"""Runtimes to C: types, expressions, statements, calls, and the functions that a kind needs.

An error, never a guess, where the runtime's Python has no C.
Imports `core` and `runtime` only.
"""
