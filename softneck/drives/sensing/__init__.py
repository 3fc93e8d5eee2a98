"""Inclinometers: on the bus, on a serial port, or one's own.

What a sensor says is checked by the master, not here.
May import `drives.bus` and `drives.master`.
"""
