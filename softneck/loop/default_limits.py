"""Default limits of step responses, all in one place.

A more uncertain plant may overshoot more: the limits rise from a design over its loop to the worst plant of a
verification's box.
"""

from __future__ import annotations

import math

#: Overshoot [%] for which a design tunes its reference filter: without motor limits, and within them.
DESIGN_OVERSHOOT_PCT = 2.0
DESIGN_OVERSHOOT_IN_LIMITS_PCT = 4.0
#: Of one loop in `demo` and in a new project: a step of 15 deg, within the results of the lab on the real neck
#: (overshoot 7.4 to 21.4 %, rise 0.28 to 0.42 s, steady rms 0.19 to 0.34 deg).
LOOP = {"overshoot_pct": 10.0, "rise_s": 0.8, "settling_s": 1.5, "steady_rms_deg": 0.3}
#: Of `softneck tune`: loops over simulation models, which are near to the robot. Its rise is `required_rise`.
TUNE = {
    "sim.overshoot_pct": 5.0,
    "sim.steady_rms_deg": 0.15,
    "track.ahead_rms_deg": 1.5,  # distance with the preview that is best for all plants
}
#: How far [%] a search beside draws stays below its limit of overshoot, for draws that it does not see.
UNSEEN_OVERSHOOT_PCT = 1.0
#: Of `softneck verify`: `step` on the worst plant of the box with noise, `neck` on necks that differ from the preset.
VERIFY = {
    "step.overshoot_pct": 15.0,
    "step.settling_s": 2.0,
    "step.load_rms_deg": 2.0,
    "sim.overshoot_pct": 15.0,
    "sim.settling_s": 2.5,
    "sim.steady_rms_deg": 0.5,
    "sim.slack_s": 0.1,  # a slack tendon; a moment of it in a step does no harm
}


def required_rise(fastest: float, dead_time: float) -> float:
    """Return the required rise time [s] of a robot's step, to hundredths.

    It is the rise that slew rate and range of the motors allow, plus that of a loop whose time constant is its dead
    time, the tightest robust one (Skogestad 2003, J. Process Control 13:291): ln 9 dead times from 10 to 90 %.
    `fastest`: rise [s] with the motors as fast as slew rate and range allow. `dead_time`: the longest of the plant [s],
    with one sample of the loop.
    """
    return round(fastest + math.log(9.0) * dead_time, 2)


#: Of the paper's neck, without an identified plant: Eq. 31 driven to 6 rad at 12.5 rad/s rises to 15 deg in 0.267 s,
# with a dead time of 0.08 s.
NECK_RISE_S = required_rise(0.267, 0.08 + 0.02)


def as_toml(limits: dict[str, float]) -> str:
    """Return limits as lines of the table [require] of a requirements file."""
    return "".join(f'"{metric}" = {{ max = {limit} }}\n' for metric, limit in limits.items())
