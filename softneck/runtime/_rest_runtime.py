"""What decays ends at rest: states do not linger among the subnormal numbers, with which processors are slow.

A pole of 0.9 leads below 2.2e-308 within 6,700 samples of rest and stays there, as 0.9 of the least number rounds to
the least number; a step then took up to four times as long. `(x + REST) - REST` is x to the bit for |x| > 2^54 REST =
1.8e-64, and a multiple of 2.2e-96 below: even the product of three such states is a normal number. It has no branch,
its derivative is 1, and plain Python, numba and C give the same bits.
"""

REST = 1e-80
