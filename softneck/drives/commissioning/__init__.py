"""Before any controller runs: zeroing, jogging, recording an experiment.

Each is a session of `drives.running` with a pilot of its own.
May import `drives.running`.
"""
