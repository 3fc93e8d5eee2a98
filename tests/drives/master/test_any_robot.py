"""The master with 1 to 8 drives: it runs them all, and what happens to one stops all."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest

from softneck.drives import default_drives
from softneck.drives.master import Phase
from softneck.drives.master._limiter import Limiter
from softneck.drives.master._settings import LimitSettings

from ..bench import DISABLED, FAULT, REACTION, Bench
from ..robots import robot

MOTORS = (1, 2, 4, 8)


def bench(count: int, *, rows: int = 100_000, **changes: Any) -> Bench:
    return Bench(file=default_drives(robot=robot(count, **changes)), rows=rows)


@pytest.mark.parametrize("motors", MOTORS)
def test_a_run_on_any_number_of_drives_ends_with_all_off(motors: int) -> None:
    run = bench(motors, rows=40).start()
    assert run.phase is Phase.RUNNING
    assert len(run.master.setpoints) == len(run.master.positions) == len(run.master.tensions) == motors
    run.pass_time(0.4)
    # Half a radian in 0.4 s: the drives are there but for their lag.
    assert run.master.positions == pytest.approx(run.pilot.wanted, abs=0.05)
    run.finish()
    assert run.phase is Phase.DONE
    assert run.states == [DISABLED] * motors
    assert not run.master.supervisor.fault


@pytest.mark.parametrize("motors", MOTORS)
@pytest.mark.parametrize("fault", ["trips", "silent", "boots", "host gone"])
def test_what_happens_to_one_drive_stops_all(motors: int, fault: str) -> None:
    run = bench(motors).start()
    last = run.neck.drives[-1]
    if fault == "trips":
        last.axis.enable_input = False
    elif fault == "silent":
        last.alive = False
    elif fault == "boots":
        last.power_cycle(run.now)
    else:
        # No set-point, no guarding: each drive notices by itself (8130h).
        run.host_stopped(True)
    began = run.now
    run.pass_time(0.6)
    stopped = [time for i, time in enumerate(run.drive_stopped_at) if not (fault == "silent" and i == motors - 1)]
    # 2 cycles where the drive says so, 5 where it is silent, 110 ms where it is the host; then their ramp to rest.
    most = {"trips": 0.02, "boots": 0.02, "silent": 0.06, "host gone": 0.12}[fault] + 0.05
    assert all(time is not None and time - began <= most for time in stopped)
    assert not run.restarted
    if fault == "host gone":
        assert [drive.axis.fault for drive in run.neck.drives] == [0x8130] * motors
        assert set(run.states) <= {FAULT, REACTION}
    else:
        fault_ = run.master.supervisor.fault
        assert fault_ is not None
        assert motors == 1 or fault_.node == motors
        assert run.phase in (Phase.STOPPING, Phase.STOPPED)


@pytest.mark.parametrize(("kind", "name"), [("drops", "sensor_lost"), ("freezes", "sensor_frozen"),
                                            ("jumps", "sensor_bad"), ("nan", "sensor_bad")])  # fmt: skip
@pytest.mark.parametrize("motors", [1, 8])
def test_a_sensor_that_fails_ends_the_run(motors: int, kind: str, name: str) -> None:
    run = bench(motors).start()
    run.neck.sensor = kind
    # 20 identical samples of 20 ms, and one cycle.
    run.pass_time(0.45)
    fault = run.master.supervisor.fault
    assert fault is not None
    assert fault.name == name


@pytest.mark.parametrize("motors", [2, 8])
def test_a_blocked_motor_and_outputs_that_go_elsewhere_stop_all(motors: int) -> None:
    run = bench(motors).start()
    run.neck.block(2)
    run.pilot.wanted = (0.0, *(-3.0,) * (motors - 1))
    run.pass_time(1.5)
    fault = run.master.supervisor.fault
    assert fault is not None
    assert (fault.name, fault.node) == ("following", 2)


def test_the_wrong_number_of_set_points_stops_all() -> None:
    run = bench(4).start()
    run.pilot.wanted = (0.1, 0.2, 0.3)
    run.pass_time(0.1)
    assert str(run.master.supervisor.fault).endswith("3 set-points for 4 motors")


def test_set_points_stay_within_the_tighter_limits_of_each_motor() -> None:
    own = {"setpoint_min": [-5.0, -0.2], "setpoint_max": [0.3, 4.0], "rate_limit": [1.0, 12.0]}
    run = bench(2, motors=own).start()
    run.pilot.wanted = (3.0, -3.0)
    seen = []
    for _ in range(60):
        run.step()
        seen.append(run.master.setpoints)
        if run.phase is not Phase.RUNNING:
            break
    first, second = zip(*seen, strict=True)
    assert max(first) == pytest.approx(0.3)
    assert min(second) == pytest.approx(-0.2)
    # 1 rad/s in cycles of 10 ms; rounding only.
    assert max(abs(b - a) for a, b in itertools.pairwise(first)) <= 0.01 + 1e-12
    fault = run.master.supervisor.fault
    assert fault is not None
    assert fault.name == "clamp_persistent"


def test_a_winch_beyond_its_range_comes_back_as_it_is_led() -> None:
    limits = replace(LimitSettings(), slack=0.0)
    limiter = Limiter(limits, 0.01, (0.0, 4.0, 15.0))
    limiter.reset(-0.5)
    # A ramp of 1 rad/s, as on the way in; then further out, which is not followed.
    for k in range(1, 31):
        assert limiter.step(-0.5 + 0.01 * k, 1.0) == pytest.approx(-0.5 + 0.01 * k, abs=1e-9)
    assert limiter.step(-2.0, 1.0) >= -0.2 - 1e-9
    assert limiter.clamped == "position"
