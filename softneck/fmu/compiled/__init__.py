"""FMUs without Python: runtimes translated to C, one library for all kinds, FMI 2.0 and 3.0.

`python -m softneck.fmu.compiled` cross-compiles the library for all platforms.
May import `fmu.describe` and `fmu.python`'s archives.
"""
