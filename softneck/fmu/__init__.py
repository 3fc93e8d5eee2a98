"""FMUs of blocks: FMI 2.0 through pythonfmu, FMI 2.0 and 3.0 without Python.

The model description is generated once, in `fmu.describe`.
May import `design` and below; simulation of FMUs is in `cosim`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
