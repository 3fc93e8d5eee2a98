"""`softneck drives`: arming, jogging, recording, running, replaying, and the live view.

Whatever moves hardware asks first.
May import `drives` and `cli.shared`.
"""
