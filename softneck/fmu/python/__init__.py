"""FMI 2.0 Co-Simulation FMUs through pythonfmu, and unpacking of FMUs into folders with plain paths.

The slave's text runs inside the host and imports no softneck module.
May import `fmu.describe`.
"""
