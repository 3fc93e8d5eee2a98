"""The bus: `drives.toml`, links, objects by SDO, units, frames in words.

Real and simulated buses look alike from here.
May import `drives.master` and `drives.simulated`.
"""
