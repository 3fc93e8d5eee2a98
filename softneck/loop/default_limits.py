"""What a step is asked to do where nobody says otherwise: the one place of these numbers.

The less is known of a plant, the more its step may overshoot: a design aims lower than what its loop is held to, and
the worst plant of a verification's box is allowed most.
"""

from __future__ import annotations

import math

#: At which a design's reference filter aims [%]: on its plants without limits, and within the motors' limits.
DESIGN_OVERSHOOT_PCT = 2.0
DESIGN_OVERSHOOT_IN_LIMITS_PCT = 4.0
#: Of one loop, as `demo` and a new project close it: 15 deg, within what the lab's own loop does on the real neck
#: (overshoot 7.4 to 21.4 %, rise 0.28 to 0.42 s, steady rms 0.19 to 0.34 deg).
LOOP = {"overshoot_pct": 10.0, "rise_s": 0.8, "settling_s": 1.5, "steady_rms_deg": 0.3}
#: Of `softneck tune`: loops over simulation models, which are near to the robot. Its rise is `usual_rise`.
TUNE = {
    "sim.overshoot_pct": 5.0,
    "sim.steady_rms_deg": 0.15,
    "track.circle_rms_deg": 3.0,  # distance to a reference that is not known beforehand
    "track.ahead_rms_deg": 1.5,  # to one that is given as much earlier as is best for all plants
}
#: Of `softneck verify`: `step` on the worst plant of the box with noise, `neck` on necks that differ from the preset.
VERIFY = {
    "step.overshoot_pct": 15.0,
    "step.settling_s": 2.0,
    "step.load_rms_deg": 2.0,
    "sim.overshoot_pct": 15.0,
    "sim.settling_s": 2.5,
    "sim.steady_rms_deg": 0.5,
    "sim.slack_s": 0.1,  # a tendon that hangs; a moment as a step turns it is no harm
}


def usual_rise(least: float, dead_time: float) -> float:
    """Return the rise [s] that is asked of a robot's step, to hundredths.

    What slew and range of the motors take, and behind it a loop whose lag is its dead time, the tightest that stays
    robust (Skogestad 2003, J. Process Control 13:291): from 10 to 90 % such a lag takes ln 9 of it.

    Args:
        least: rise [s] with the motors led as fast as slew and range allow.
        dead_time: the longest that the plant may have, a sample of the loop included [s].
    """
    return round(least + math.log(9.0) * dead_time, 2)


#: Of the paper's neck, where no plant tells another: its Eq. 31 led to 6 rad at 12.5 rad/s rises to 15 deg in 0.267 s,
# and it answers after 0.08 s.
NECK_RISE_S = usual_rise(0.267, 0.08 + 0.02)


def as_toml(limits: dict[str, float]) -> str:
    """Return limits as lines of the table [require] of a requirements file."""
    return "".join(f'"{metric}" = {{ max = {limit} }}\n' for metric, limit in limits.items())
