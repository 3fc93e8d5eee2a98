"""How long the cycles of a run took: a histogram of fixed size, so that long runs need no more memory."""

from __future__ import annotations

# 10 us a bin, up to 200 ms; what is longer falls into the last.
_BIN = 1e-5
_BINS = 20_000


class CycleTimes:
    """Periods between cycles and the time each one took.

    Attributes:
        count: periods so far.
        late: those beyond one and a half cycles.
        missed: cycles in which no step began: a period of n cycles misses n - 1.
        longest_period, longest_step: [s].
    """

    def __init__(self, cycle: float) -> None:
        """Begin with nothing; `cycle` is the period that is wanted [s]."""
        self.cycle = cycle
        self.count = self.late = self.missed = 0
        self.longest_period = self.longest_step = 0.0
        self._bins = [0] * _BINS
        self._last: float | None = None

    def take(self, now: float, step: float) -> None:
        """Add a cycle that began at `now` [s] and took `step` [s]."""
        self.longest_step = max(self.longest_step, step)
        if self._last is not None:
            period = now - self._last
            self.longest_period = max(self.longest_period, period)
            self.late += period > 1.5 * self.cycle
            self.missed += max(0, round(period / self.cycle) - 1)
            self.count += 1
            self._bins[min(_BINS - 1, max(0, int(period / _BIN)))] += 1
        self._last = now

    def quantile(self, share: float) -> float:
        """Return the period that `share` of all are at most [s], to 10 us; 0 without any."""
        wanted, seen = share * self.count, 0
        for index, number in enumerate(self._bins):
            seen += number
            if number and seen >= wanted:
                return (index + 1) * _BIN
        return 0.0

    def __str__(self) -> str:
        """In ms."""
        p50, p99 = 1e3 * self.quantile(0.5), 1e3 * self.quantile(0.99)
        return f"p50 {p50:.2f}   p99 {p99:.2f}   max {1e3 * self.longest_period:.2f}"

    def table(self) -> dict[str, float | int]:
        """Return what JSON holds."""
        return {
            "cycles": self.count,
            "late": self.late,
            "missed": self.missed,
            "missed_share": self.missed / max(1, self.count + self.missed),
            "p50_s": self.quantile(0.5),
            "p99_s": self.quantile(0.99),
            "longest_s": self.longest_period,
            "longest_step_s": self.longest_step,
        }
