"""Logs of runs, written beside the control loop and read back to the bit, and their replay.

The log of a killed run is readable up to its last second.
May import `drives.bus` and `drives.master`.
"""
