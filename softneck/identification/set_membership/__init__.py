"""Nonlinear set membership (section 3 of the paper): the data set is the model, with bounds.

Exact bounds by branch and bound over trees, gamma and epsilon, learning as it goes.
May import `identification.models`.
"""
