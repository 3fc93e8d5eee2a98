"""Print peers beside our kinds: same data, same split, each tuned by the free run on the last fifth of its rows.

`python benchmarks/peers.py --python INTERPRETER [--peers frols mlp jax_sysid_nss] [--seeds 0 1] [--drives]`

INTERPRETER is of an environment with `pip install sysidentpy scikit-learn jax-sysid`, which need other versions of
numpy and jax than ours; without it one is made under build/peers. Peers are given set-points and outputs, as their own
examples are; with `--drives` the motors as our drive model simulates them, in place of the set-points.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

import numpy as np
from five_seeds import TESTS, recordings

from softneck.identification import WARM_UP, nrmse_fit
from softneck.identification.models._drive import LoadedDrive, drive_start, fit_loaded_drive
from softneck.signals import Recording

PEERS = ("frols", "mlp", "jax_sysid_nss")
HERE = Path(__file__).parent
SETS = ("validation", *TESTS)


def interpreter(given: Path | None) -> Path:
    """Return the peers' interpreter, of an environment that is made where none was given."""
    if given is not None:
        return given
    folder = HERE.parent / "build" / "peers"
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
        packages = ["sysidentpy", "scikit-learn", "jax-sysid"]
        subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    return python


def written(made: dict[str, Recording], drive: LoadedDrive | None, path: Path) -> None:
    """Write what a peer is given."""
    arrays = {}
    for name, recording in made.items():
        u = recording.set_points
        arrays[f"u_{name}"] = u if drive is None else drive.simulate(u, drive_start(recording))
        arrays[f"y_{name}"] = recording.outputs
    np.savez(path, **arrays)


def judged(peer: str, python: Path, made: dict[str, Recording], data: Path, seed: int) -> str:
    """Return a line on one peer and seed."""
    result, begin = data.with_name("result.npz"), time.perf_counter()
    script = HERE / "peers" / f"{peer}.py"
    # Ours are no packages of the peer's environment.
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    call = [python, script, data, result, str(seed)]
    done = subprocess.run(call, env=clean, capture_output=True, text=True, check=False)
    if done.returncode:
        return f"failed: {done.stderr.strip().splitlines()[-1:]}"
    seconds = time.perf_counter() - begin
    answer, row = np.load(result), []
    for name in SETS:
        y, free = made[name].outputs[WARM_UP:], answer[name][WARM_UP:]
        row.append("/".join(f"{nrmse_fit(y[:, axis], free[:, axis]):.1f}" for axis in range(2)))
    return f"{' '.join(row)}; {seconds:.0f} s; {answer['chosen']}"


def main() -> None:
    """Read the command line and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--python", type=Path)
    parser.add_argument("--peers", nargs="+", default=list(PEERS), choices=PEERS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--drives", action="store_true")
    wanted = parser.parse_args()
    python = interpreter(wanted.python)
    print(f"Eq. 22, columns: {', '.join(SETS)}; fit in % pitch/roll; ours: five_seeds.py", file=sys.stderr)
    for seed in wanted.seeds:
        made = recordings("eq22", seed)
        drive = fit_loaded_drive(made["train"]) if wanted.drives else None
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder) / "data.npz"
            written(made, drive, data)
            for peer in wanted.peers:
                what = f"{peer}{' with our drives' if wanted.drives else ''}"
                print(f"{what} seed {seed}: {judged(peer, python, made, data, seed)}", flush=True)


if __name__ == "__main__":
    main()
