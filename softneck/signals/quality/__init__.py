"""Quality of a recording: faults of its channels, and whether its inputs excite the system.

Numbers come first, then findings in plain words.
May import `signals.recording`.
"""
