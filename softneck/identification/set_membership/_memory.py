"""Whether a set fits into memory, told before it is built."""

from __future__ import annotations

from pathlib import Path

from softneck.core import DataError

# The data, their copy in tree order with nodes and ages, and the columns being sorted (measured: 2.6 at most).
_TIMES_THE_DATA = 3.0


def require_memory(rows: int, inputs: int, outputs: int) -> None:
    """Raise DataError where a set of `rows` points would not fit, and say how many would."""
    free = available_bytes()
    per_row = _TIMES_THE_DATA * 8.0 * (inputs + outputs)
    if free is not None and rows * per_row > free:
        raise DataError(
            f"a set of {rows} points of {inputs} regressors and {outputs} outputs needs about "
            f"{rows * per_row / 2**30:.3g} GB to build, and {free / 2**30:.3g} GB are free: at most "
            f"{int(free / per_row)} points fit. Take every m-th row."
        )


def available_bytes() -> int | None:
    """Return how much memory may be had without swapping, or None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    kilobytes = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return 1024 * kilobytes[0] if kilobytes else None
