# %% [markdown]
# # From a model to a closed loop
#
# A PI controller on the linear model, run against the virtual neck, which shares no equation with that model.

# %%
import softneck
from softneck.plant import NeckParameters
from softneck.signals import signal

neck = softneck.VirtualNeck(NeckParameters.paper())
model = softneck.identify("rls", softneck.record(signal("eq22", duration=40.0), neck, seed=1))
controller = softneck.design_controller("pi", model)
controller

# %% [markdown]
# A loop is a table, as in a loop file; objects stand in it where a file would name them.

# %%
result = softneck.simulate(
    {
        "duration_s": 6.0,
        "plant": "paper",
        "controller": controller,
        "reference": {"kind": "step", "pitch_deg": 15.0, "at_s": 1.0},
        "limits": {"pitch.overshoot_pct": 10.0, "pitch.settling_s": 1.5},
    }
)
result

# %%
result.plot("A step of 15 deg")

# %%
for row in result.limits:
    print(f"{row['metric']}: {row['value']:.3g}, limit {row['limit']:g}, {'holds' if row['holds'] else 'fails'}")
