"""Loop files: a TOML text becomes a loop, which runs and has a result, or is written as an SSP archive.

Values are checked as they are read, by key.
May import `cosim.parts` and `cosim.ssp`.
"""
