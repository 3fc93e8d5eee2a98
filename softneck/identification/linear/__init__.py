"""Linear kinds: recursive least squares, output error, continuous-time instrumental variables, subspaces.

Sections 2 and 4 of the paper, and Ljung 1999.
May import `identification.models`.
"""
