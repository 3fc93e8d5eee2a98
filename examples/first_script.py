"""From the paper's experiment on the virtual neck to a controller and an FMU, in ten lines."""

import softneck

recording = softneck.record("eq22", "paper", seed=1)  # the paper's experiment on its virtual neck
model = softneck.identify("rls", recording)  # trained on the first 70 %
print(model.summary())  # with the fit on the rest
controller = softneck.design_controller("pi", model)
print(controller.summary())
softneck.build_fmu(model, "build/Neck.fmu", force=True)
