"""Translation of runtimes to C: types, expressions, statements, calls, and the functions of a kind.

Python without a translation is an error.
Imports `core` and `runtime` only.
"""
