"""Linear controllers with limits and allocation: PI, PID, fractional order, LQG, your own.

Also what all linear designs share: settings, axis loop, margins, reduction, runtime.
May import `design.plants`.
"""
