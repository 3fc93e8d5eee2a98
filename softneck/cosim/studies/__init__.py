"""Studies: run one loop many times over ranges of its values, with workers, a store that survives a crash, rankings.

A study resumes where it was stopped.
May import `cosim.loops`.
"""
