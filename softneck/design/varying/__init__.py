"""Controllers whose gains vary as they run: scheduled over the inclination, or adaptive.

Each keeps the checks of the linear design it is made of.
May import `design.linear` and `design.plants`.
"""
