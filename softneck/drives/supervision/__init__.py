"""Fault detection: comparison of motors, currents and tilt with undisturbed motion, and fault isolation.

A detector without I/O beside the master, and its calibration.
May import `signals` and below.
"""
