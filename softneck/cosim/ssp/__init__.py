"""A loop as an SSP 1.0 archive for other masters.

The system structure is written here and nowhere else.
May import `cosim.parts` and `cosim.loops`.
"""
