"""The errors users meet: one clear line each, and one exit code each."""

from __future__ import annotations


class SoftneckError(Exception):
    """Base of all errors a user can mend; the command line prints it on one line and exits with 2."""

    exit_code = 2


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
