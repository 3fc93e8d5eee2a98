"""The paper's signals and other excitations, and the limits and ramps under which they are played.

Definitions are frozen: the tests hold a hash of each.
May import `signals.recording`.
"""
