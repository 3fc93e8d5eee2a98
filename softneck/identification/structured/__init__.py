"""Models with the neck's structure: grey-box equations, and play operators with polynomials.

Few numbers, strong in simulation.
May import `identification.models`.
"""
