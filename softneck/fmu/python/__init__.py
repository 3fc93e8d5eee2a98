"""FMI 2.0 Co-Simulation FMUs through pythonfmu, and FMUs unpacked where they are safe to run.

The slave's text runs inside the host and imports nothing of ours.
May import `fmu.describe`.
"""
