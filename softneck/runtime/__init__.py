"""Blocks with `step`, and their runtime source texts: bundled, compiled by numba, or run as plain Python without it.

A runtime module (`_*_runtime.py`) imports numpy, math and other runtimes only.
Contains no kind; may import `core`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
