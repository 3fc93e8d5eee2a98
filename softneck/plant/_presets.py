"""Numbers of the presets that differ from the defaults; the docs page "The virtual neck" tells their origin."""

from __future__ import annotations

import math

# The lab's two inclinometers. Angles: white noise plus a slow bias, chosen so that the spread on a plateau
# and from sample to sample (20 ms) are what the lab's recordings show; lag and delay of the second and all
# rates are guesses from the class of the device.
SENSORS: dict[str, dict[str, float]] = {
    # Arduino + MPU-9250: 0.26 to 0.29 deg on plateaus, 0.08 to 0.15 from sample to sample, two decimals.
    "mpu9250": {
        "noise_std": math.radians(0.03),
        "drift_std": math.radians(0.27),
        "drift_time": 0.3,
        "noise_quantum": math.radians(0.01),
        "rate_noise_std": math.radians(0.1),
        "rate_bias_std": math.radians(0.2),
    },
    # 3DM-GX5-10: 0.02 to 0.04 deg on plateaus, 0.007 to 0.010 from sample to sample.
    "3dm-gx5": {
        "noise_std": math.radians(0.005),
        "drift_std": math.radians(0.03),
        "drift_time": 2.0,
        "noise_quantum": 0.0,
        "rate_noise_std": math.radians(0.05),
        "rate_bias_std": math.radians(0.02),
        "sensor_lag": 0.005,
        "sensor_delay": 0.01,
    },
}

# Fitted to the lab's open-loop recording of the neck with a central spring (winch of 10 mm, MPU-9250).
_LAB = {
    **SENSORS["mpu9250"],
    "axial_damping": 8.0,
    "axial_stiffness": 2210.0,
    "bending_damping": 0.222,
    "bending_stiffening": 0.3,
    "bending_stiffness": 0.752,
    "current_limit": 0.072,
    "drive_latency": 0.0136,
    "guide_friction": 0.02,
    "hysteresis_angle": 0.04,
    "hysteresis_torque": 0.01,
    "link_length": 0.099,
    "payload_height": 0.0327,
    "position_gain": 14.9,
    "pretension": 1.53,
    "rest_pitch": 0.00293,
    "rest_roll": 0.0028,
    "sensor_delay": 0.00911,
    "sensor_lag": 0.0551,
    "stiffness_asymmetry": -0.0213,
    "tendon_stiffness": 2860.0,
    "winch_radius": 0.01,
}

# Found by `benchmarks/rough_neck.py`: a line follows it no better than the paper's neck. Slow winches tell fast motion
# from slow, stiffer planes between the motors' and tendons out of place tell pitch from roll.
_ROUGH = {
    "bending_damping": 0.05443,
    "bending_stiffness": 0.562,
    "drive_latency": 0.08012,
    "guide_friction": 0.06954,
    "position_gain": 24.39,
    "pretension": 1.701,
    "rest_pitch": -0.01606,
    "rest_roll": -0.0102,
    "sensor_delay": 0.07097,
    "speed_limit": 4.123,
    "stiffness_angle": 0.5332,
    "stiffness_asymmetry": 0.3541,
    "tendon_angle_2": 2.066,
    "tendon_angle_3": 4.186,
}

# Of the robot `trunk4`, whose tendons stand against each other in pairs: with the paper's, a winch stalls before its
# link bends by 4 deg. Together they press it as the paper's three do, and 3 rad on one of them bend it by 14 deg.
_TRUNK = {"attachment_radius": 0.042, "current_limit": 0.045, "pretension": 0.75 * 3.25}

# What each preset has other than the defaults, which are those of `paper`.
PRESETS: dict[str, dict[str, float]] = {"paper": {}, "lab": _LAB, "rough": _ROUGH, "trunk": _TRUNK}
