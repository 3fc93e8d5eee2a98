"""Linear systems near a moment, of any tool's FMU or of a block of ours.

Exact where a step has derivatives, else by pulses on a saved state.
May import `cosim.parts`.
"""
