"""Default limits of steps: one place, and a rise that follows from the robot."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import softneck
from softneck.loop import default_limits
from softneck.tuning._requirements import default_text as of_tune
from softneck.verification._requirements import default_text as of_verify

ROOT = Path(softneck.__file__).parent
# A number that is said to be how far a step may overshoot: `overshoot_pct = 10`, `"sim.overshoot_pct": 5.0`,
# `"step.overshoot_pct" = { max = 15.0 }`, `overshoot_pct: float = 2.0`.
NUMBER = re.compile(r'overshoot_pct"?(?:: float)? ?[=:] ?(?:\{ max = )?\d')


def test_no_other_file_of_the_package_says_how_far_a_step_may_overshoot() -> None:
    files = [path for end in ("py", "toml", "txt") for path in ROOT.rglob(f"*.{end}")]
    found = {
        path.relative_to(ROOT).as_posix()
        for path in files
        for line in path.read_text(encoding="utf-8").splitlines()
        # Examples in docstrings (`{"overshoot_pct": 5}`), and the reserve, which is no limit.
        if NUMBER.search(line) and not any(part in line for part in (">>>", "such as", '`{"overshoot_pct"', "= 1.6"))
    }
    assert found == {"loop/default_limits.py"}


def test_the_files_that_are_printed_hold_the_limits() -> None:
    for text, limits in ((of_verify(), default_limits.VERIFY), (of_tune(), default_limits.TUNE)):
        require = tomllib.loads(text)["require"]
        assert limits.items() <= {metric: entry.get("max") for metric, entry in require.items()}.items()


def test_a_rise_follows_from_the_motors_and_the_dead_time() -> None:
    # Eq. 31 with its dead time and a sample; the limit is rounded to hundredths.
    pole, gain = 5.293, 27.69 / 5.293  # [1/s], [deg/rad]
    dt = 1e-4
    u = np.minimum(12.5 * dt * np.arange(10_000), 6.0)
    y = np.zeros(u.size)
    for k in range(u.size - 1):
        y[k + 1] = y[k] + dt * pole * (gain * u[k] - y[k])
    least = dt * (int(np.argmax(y >= 0.9 * 15.0)) - int(np.argmax(y >= 0.1 * 15.0)))
    # Euler's steps here, samples of 20 ms there: a hundredth besides.
    assert pytest.approx(default_limits.required_rise(least, 0.1), abs=0.0101) == default_limits.NECK_RISE_S
    assert default_limits.required_rise(0.3, 0.0) == 0.3  # no dead time: the motors alone
    # Twice as slow in everything is twice the rise, but for rounding to hundredths.
    assert default_limits.required_rise(0.4, 0.3) == pytest.approx(
        2 * default_limits.required_rise(0.2, 0.15), abs=0.011
    )
