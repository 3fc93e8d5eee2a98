"""Imported by the process that `forked.py` forks from: a run of drives, sensor and host loads what is compiled."""

import os
from pathlib import Path

from softneck.cosim import load_loop
from softneck.drives import default_drives, prepare, run_simulated

if "SOFTNECK_WARM" in os.environ:
    _project = Path(os.environ["SOFTNECK_WARM"])
    run_simulated(prepare(load_loop(_project / "short.toml"), _project / "pi.npz"), default_drives("ipos2015"))
