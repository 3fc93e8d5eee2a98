"""Linear kinds: recursive least squares and output error, with confidence intervals in continuous time.

Sections 2 and 4 of the paper, and Ljung 1999.
May import `identification.models`.
"""
