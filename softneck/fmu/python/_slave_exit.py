"""The part of every FMU that lets go of pythonfmu's binary before the process ends.

The binary (pythonfmu 0.7, Linux) ends twice: at the exit of the process a static destructor frees what it shares
between instances (where it started Python itself, that ends Python), and its finaliser then counts down in the memory
that was freed. A host whose heap is busy enough, as it is with numpy, dies of it with SIGABRT ("corrupted unsorted
chunks"), after all its work is done. Calling the finaliser before that leaves both with nothing to do.
Standard library only.
"""

import atexit
import ctypes
import os
import sys
from pathlib import Path

_FMU_RELEASED: set[str] = set()


def _fmu_release_at_exit(resources: str) -> None:
    """Have the binary of the FMU unpacked around `resources` finalised when this process ends."""
    if sys.platform != "linux":
        return
    for path in Path(resources).parent.glob("binaries/linux64/*.so"):
        if str(path) in _FMU_RELEASED:
            continue
        try:
            # Never closed: the binary stays loaded until the exit, whatever the host does.
            finalise = ctypes.CDLL(str(path), mode=os.RTLD_NOLOAD | os.RTLD_NOW).finalizePythonInterpreter
            register = ctypes.CDLL(None).__cxa_atexit
        except (OSError, AttributeError):  # not loaded from here, another pythonfmu, another C library
            continue
        finalise.restype = None
        _FMU_RELEASED.add(str(path))
        if sys.orig_argv:  # the host is Python itself
            atexit.register(finalise)
        else:  # The finaliser ends Python: C must call it. C's exit goes backwards, and the destructor came before.
            register(finalise, None, None)
