"""One loop run many times over what varies: ranges, workers, a store that survives a crash, rankings.

A study resumes where it was stopped.
May import `cosim.loops`.
"""
