"""The errors that users meet, each with one line and an exit code, and the extras that install missing packages."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Iterable
from importlib import metadata
from importlib.util import find_spec

# A message quotes text from files. Control characters in it could end the line or control the terminal, so they become
# `?`. The newline stays: it separates the lines of our own messages.
_CONTROLS = dict.fromkeys([*range(10), *range(11, 32), *range(127, 160), 0x2028, 0x2029], "?")


class SoftneckError(Exception):
    """Base of all errors that a user can fix; the command line prints it on one line and exits with 2."""

    exit_code = 2

    def __str__(self) -> str:
        """Return the message without control characters."""
        return super().__str__().translate(_CONTROLS)


class SettingsError(SoftneckError, ValueError):
    """A setting is out of its range or contradicts another."""


class DataError(SoftneckError, ValueError):
    """A recording or an array does not fit the operation."""


class FileFormatError(SoftneckError, ValueError):
    """A file is of another kind or version, or is damaged."""


class OutputFileError(SoftneckError, OSError):
    """A file cannot be written to the given path."""


class CheckFailedError(SoftneckError):
    """A requested check does not hold; exit code 1."""

    exit_code = 1


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """Return "did you mean `PREFIXx`? " for the known word nearest to `word`; "" where none is near."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"did you mean `{prefix}{near[0]}`? " if near else ""


def error_reason(error: BaseException) -> str:
    """Return the first line of an error's text, at most 120 characters; its type if the text is empty."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


# Package as it is imported -> (extra of `pip install`, its purpose). README uses the extra `drives` only.
EXTRAS = {
    "pyarrow": ("files", "Parquet files"),
    "h5py": ("files", "MATLAB files of version 7.3"),
    "python_calamine": ("files", "spreadsheets"),
    "mcap_ros2": ("ros", "bags of ROS 2"),
    "can": ("drives", "a CAN bus"),
    "canopen": ("drives", "CANopen drives, simulated ones too"),
    "mcap": ("drives", "logs of runs on drives"),
    "serial": ("drives", "an inclinometer on a serial port"),
    "xarray": ("xarray", "`.to_xarray()`"),
    "distributed": ("dask", "studies on a Dask cluster"),
}


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """Return one line that names the extra to install; None if no extra has the missing module."""
    found = EXTRAS.get((error.name or "").partition(".")[0])
    if found is None:
        return None
    extra, purpose = found
    return f"{error.name} is not installed, and it is needed for {purpose}; run: pip install {_requirements(extra)}"


def _requirements(extra: str) -> str:
    """Return the packages of an extra, quoted for a shell: softneck itself is on no package index."""
    try:
        lines = metadata.requires("softneck") or []
    except metadata.PackageNotFoundError:  # run from its folder alone
        return f"'.[{extra}]'"
    lists = (line.replace('"', "'").partition(";") for line in lines)
    return shlex.join(name.strip() for name, _, condition in lists if condition.strip() == f"extra == '{extra}'")


def require_package(package: str) -> None:
    """Raise SettingsError that names the extra to install unless `package` is installed."""
    if find_spec(package) is None:
        raise SettingsError(f"{missing_extra(ModuleNotFoundError(name=package))}.")
