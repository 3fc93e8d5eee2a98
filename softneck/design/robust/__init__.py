"""Robust control: H-infinity and loop shaping, structured singular values, disk margins, nu-gap, weights.

Functions carry the field's names: `hinfsyn`, `mixsyn`, `ncfsyn`, `diskmargin`, `robstab`, `wcgain`.
May import `design.linear` and `design.plants`.
"""
