"""FMUs as parts of a loop, in this process or in one of their own, and linear systems near a moment.

All FMI calls of softneck are made here.
May import `fmu`.
"""
