"""The part of every FMU that finalises pythonfmu's binary before the process ends.

The binary (pythonfmu 0.7, Linux) cleans up twice: at the exit of the process a static destructor frees the data shared
between instances (and ends Python if the binary started it), and its finaliser then decrements a counter in the freed
memory. A host with a busy heap, as with numpy, then aborts with SIGABRT ("corrupted unsorted chunks") after all its
work is done. Calling the finaliser earlier prevents this. Standard library only.
"""

import atexit
import ctypes
import os
import sys
from pathlib import Path

_FMU_RELEASED: set[str] = set()


def _fmu_release_at_exit(resources: str) -> None:
    """Register the finaliser of the FMU's binary beside `resources` to run when this process ends."""
    if sys.platform != "linux":
        return
    for path in Path(resources).parent.glob("binaries/linux64/*.so"):
        if str(path) in _FMU_RELEASED:
            continue
        try:
            # Never closed: the binary stays loaded until the exit.
            finalise = ctypes.CDLL(str(path), mode=os.RTLD_NOLOAD | os.RTLD_NOW).finalizePythonInterpreter
            register = ctypes.CDLL(None).__cxa_atexit
        except (OSError, AttributeError):  # not loaded from here, another pythonfmu, another C library
            continue
        finalise.restype = None
        _FMU_RELEASED.add(str(path))
        if sys.orig_argv:  # the host is Python itself
            atexit.register(finalise)
        else:  # The finaliser ends Python, so C must call it: before the destructor, which was registered earlier.
            register(finalise, None, None)
