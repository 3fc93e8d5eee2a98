"""Foreign importers of FMUs and SSP files: wanted in CI, skipped where they are not installed."""

from __future__ import annotations

import ctypes
import importlib.util
import os

import pytest


def need(package: str) -> None:
    """Skip the test without `package`; in CI it fails."""
    lacking = [] if importlib.util.find_spec(package) else [package]
    if package == "ecospy":
        try:
            ctypes.CDLL("libtbb.so.12")
        except OSError:
            lacking.append("libtbb.so.12 (Debian: libtbb12)")
    if lacking:
        message = f"not installed: {', '.join(lacking)}"
        pytest.fail(message) if os.environ.get("CI") else pytest.skip(message)
