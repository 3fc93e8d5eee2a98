"""The part of every FMU that lets go of pythonfmu's binary in time, where the host is Python itself.

The binary (pythonfmu 0.7, Linux) ends twice: at the exit of the process a static destructor frees what it shares
between instances, and its finaliser then counts down in the memory that was freed. A host whose heap is busy
enough dies of it with SIGABRT ("corrupted double-linked list"), after all its work is done. Calling the finaliser
before that leaves both with nothing to do. Standard library only.
"""

import atexit
import ctypes
import os
import sys
from pathlib import Path

_FMU_RELEASED: set[str] = set()


def _fmu_release_at_exit(resources: str) -> None:
    """Have the binary of the FMU unpacked around `resources` finalised when this Python ends."""
    # Embedded in another host, the binary itself starts and ends Python: nothing to do.
    if sys.platform != "linux" or not sys.orig_argv:
        return
    for path in Path(resources).parent.glob("binaries/linux64/*.so"):
        if str(path) in _FMU_RELEASED:
            continue
        try:
            finalise = ctypes.CDLL(str(path), mode=os.RTLD_NOLOAD | os.RTLD_NOW).finalizePythonInterpreter
        except (OSError, AttributeError):  # not loaded from here, or another pythonfmu
            continue
        finalise.restype = None
        _FMU_RELEASED.add(str(path))
        atexit.register(finalise)
