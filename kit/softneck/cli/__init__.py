"""The `softneck` command."""

from ._main import main as main
