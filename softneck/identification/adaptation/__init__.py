"""A neck that changed: models adapted to a window of new data, from what they were.

What the window does not move stays as it was.
May import all subpackages of `identification` but `selection`.
"""
