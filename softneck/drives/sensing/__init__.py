"""Inclinometers: on the bus, on a serial port, or the user's own.

Their samples are checked by the master.
May import `drives.bus` and `drives.master`.
"""
