"""System structures of SSP archives (SSP 1.0 and 2.0), read, made flat, and told as the table of a loop file.

An archive from outside is opened as if hostile.
May import `cosim.parts`.
"""
