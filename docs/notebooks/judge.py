# %% [markdown]
# # What a fit is worth
#
# A one-step fit that is not above persistence (the last sample, once more) says nothing. The free run does.

# %%
import numpy as np

import softneck
from softneck.plant import NeckParameters
from softneck.signals import signal

neck = softneck.VirtualNeck(NeckParameters.paper())
train = softneck.record(signal("eq22", duration=40.0), neck, seed=1)
test = softneck.record(signal("sine"), neck, seed=3)
model = softneck.identify("rls", train)
found = softneck.validate(model, test)

# %%
print("persistence", {name: round(fit, 1) for name, fit in found.persistence["1"].items()})
print("one step   ", {name: round(fit, 1) for name, fit in found.fits["1"].items()})
print("free run   ", {name: round(fit, 1) for name, fit in found.fits["inf"].items()})

# %%
found.plot("Free run on a sine of rising frequency")

# %% [markdown]
# The largest error, and when it is.

# %%
error = np.degrees(np.abs(found.measured - found.free_run))
row = int(np.nanargmax(error.max(axis=1)))
print(f"{error[row].max():.1f} deg at {found.time[row]:.2f} s")
