"""Whether this bundle is compiled: a runtime may then choose loops over branches instead of whole arrays."""

# The text says no; `load_runtime` says 1 before numba compiles, and so must whoever else compiles it.
COMPILED = 0
