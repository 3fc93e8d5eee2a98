"""`softneck drives`: arming, jogging, recording, running, stopping.

Whatever moves hardware asks first.
May import `drives` and `cli.shared`.
"""
