"""Which kind and which settings: tried and ranked in simulation over rows held out.

Searches repeat to the bit with the same seed.
May import all other subpackages of `identification`.
"""
