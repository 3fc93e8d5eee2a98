"""Whether this bundle is compiled: a runtime may then choose loops over branches instead of whole arrays."""

# 0 in the text; `load_runtime` sets 1 before numba compiles, and so must all other code that compiles it.
COMPILED = 0
