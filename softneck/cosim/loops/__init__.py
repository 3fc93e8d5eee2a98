"""Loop files: a TOML text becomes a loop, runs, and leaves a result.

Values are checked as they are read, by key.
May import `cosim.parts`.
"""
