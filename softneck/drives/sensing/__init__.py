"""Inclinometers: on the bus, on a serial port, from a recording, or one's own.

What a sensor says is checked by the master, not here.
May import `drives.logs`, from which one is replayed.
"""
