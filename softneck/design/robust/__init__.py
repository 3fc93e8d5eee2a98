"""Robust control: H-infinity synthesis, structured singular values, weights.

Functions carry the field's names: `hinfsyn`, `mixsyn`, `makeweight`, `mu_upper`.
May import `design.linear` and `design.plants`.
"""
