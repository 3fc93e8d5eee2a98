# %% [markdown]
# # From a recording to a model
#
# A recording of the virtual neck, a linear model of it, and what its free run is worth on rows that it never saw.

# %%
import softneck
from softneck.plant import NeckParameters
from softneck.signals import signal

neck = softneck.VirtualNeck(NeckParameters.paper())
recording = softneck.record(signal("eq22", duration=40.0), neck, seed=1)
recording

# %%
model = softneck.identify("rls", recording)  # on the first 70 %, judged on the rest
model

# %% [markdown]
# A free run has the motor set-points alone. What comes back is an array that knows its channels.

# %%
rest = recording.split(0.7)[1]
free = model.simulate(rest)
free

# %%
free.plot("Free run on rows that the model never saw")

# %%
free.to_pandas()[["pitch", "roll"]].describe().round(3)
