"""The errors users meet: one clear line each, one exit code each; and which extra installs what is missing."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Iterable
from importlib import metadata
from importlib.util import find_spec

# A message quotes what stands in files. Control characters there would end its line, or write to the terminal what they
# like; where we say several things, a line each, it is by the newline alone.
_CONTROLS = dict.fromkeys([*range(10), *range(11, 32), *range(127, 160), 0x2028, 0x2029], "?")


class SoftneckError(Exception):
    """Base of all errors a user can mend; the command line prints it on one line and exits with 2."""

    exit_code = 2

    def __str__(self) -> str:
        """Return the message without control characters."""
        return super().__str__().translate(_CONTROLS)


class SettingsError(SoftneckError, ValueError):
    """A setting is out of its range or contradicts another."""


class DataError(SoftneckError, ValueError):
    """A recording or an array is not what the operation needs."""


class FileFormatError(SoftneckError, ValueError):
    """A file is not what it should be: another kind, another version, damaged."""


class OutputFileError(SoftneckError, OSError):
    """A file cannot be written where it was asked for."""


class CheckFailedError(SoftneckError):
    """A check that the user asked for did not hold; exit code 1."""

    exit_code = 1


def did_you_mean(word: str, known: Iterable[str], prefix: str = "") -> str:
    """Return "did you mean `PREFIXx`? " for the known word nearest to `word`; "" where none is near."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"did you mean `{prefix}{near[0]}`? " if near else ""


# Package as it is imported -> (extra of `pip install`, what needs it). No path of the README needs one but the drives'.
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
    """Return one line on which extra to install; None where the missing module is in none of them."""
    found = EXTRAS.get((error.name or "").partition(".")[0])
    if found is None:
        return None
    extra, purpose = found
    return f"{error.name} is not installed, and it is needed for {purpose}; run: pip install {_requirements(extra)}"


def _requirements(extra: str) -> str:
    """Return the packages of an extra for a shell: softneck itself is on no index that pip asks."""
    try:
        lines = metadata.requires("softneck") or []
    except metadata.PackageNotFoundError:  # run from its folder alone
        return f"'.[{extra}]'"
    asked = (line.replace('"', "'").partition(";") for line in lines)
    return shlex.join(name.strip() for name, _, condition in asked if condition.strip() == f"extra == '{extra}'")


def require_package(package: str) -> None:
    """Raise `SettingsError` with that line unless `package`, of one of the extras, is installed."""
    if find_spec(package) is None:
        raise SettingsError(f"{missing_extra(ModuleNotFoundError(name=package))}.")
