"""Plausibility: whether motors, currents and tilt behave as they did on undisturbed motion, and which fault they show.

An observer without I/O beside the master, and what it is calibrated from.
May import `signals` and below.
"""
