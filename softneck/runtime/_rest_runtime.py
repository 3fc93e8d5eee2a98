"""Decaying states become exactly zero and never subnormal numbers, which are slow on processors.

A pole of 0.9 decays below 2.2e-308 within 6,700 samples and stays there, as 0.9 times the smallest number rounds to the
smallest number; a step then took up to four times as long. `(x + REST) - REST` is x to the bit for |x| > 2^54 REST
= 1.8e-64, and a multiple of 2.2e-96 below: even the product of three such states is a normal number. It has no branch,
its derivative is 1, and plain Python, numba and C agree to the bit.
"""

REST = 1e-80
