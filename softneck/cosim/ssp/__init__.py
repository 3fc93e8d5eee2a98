"""Read system structures of SSP archives (SSP 1.0 and 2.0) as tables of loop files.

An archive from outside is opened as if hostile.
May import `cosim.parts`.
"""
