"""Runs: pre-flight, enabling, ramps, the loop, ramps, off; keyboard, service.

One session for every command that moves the neck.
May import `drives.sensing`, `.logs`, `.bus`.
"""
