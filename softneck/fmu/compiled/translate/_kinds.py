"""The runtimes that the library holds, and the rank of each of their arrays.

The types of a runtime's arrays decide all other types in it. A runtime that is not here, or that the translator does
not know how to write in C, cannot be in a compiled FMU; `refused` says why.
"""

from __future__ import annotations

# One digit for each array.
_RANKS = {
    "softneck.identification.linear._rls_runtime": "122221",
    "softneck.identification.linear._oe_runtime": "1222211",
    "softneck.identification.linear._state_space_runtime": "122221",
    "softneck.identification.set_membership._nlsm_runtime": "1221322332221",
    "softneck.identification.networks._nn_runtime": "1223232213212",
    "softneck.identification.structured._play_runtime": "12121122221",
    "softneck.identification.networks._nss_runtime": "121211222221221221",
    "softneck.identification.structured._greybox_runtime": "121121",
    # Those of its members come behind.
    "softneck.identification.uncertainty._residual_runtime": "112132233",
    "softneck.identification.uncertainty._ensemble_runtime": "11",
    "softneck.plant._neck_runtime": "2",
    "softneck.estimation._kalman_runtime": "222222221",
    "softneck.estimation._steady_kalman_runtime": "222222221222222",
    "softneck.design.linear._linear_controller_runtime": "2222222222222221",
    "softneck.design.varying._scheduled_runtime": "222222222222222111",
    "softneck.design.varying._adaptive_runtime": "2222222122111",
    "softneck.design.predictive._mpc_runtime": "1222212121222222221",
    "softneck.loop._reference_runtime": "12",
}

# Which of a step's functions are compiled for speed, all others for size: those with so many loops within each other.
# A network, a search among thousands of points and a quadratic program spend their time in every loop; the neck in
# sine and tangent (2 % slower without its entry, and 3 kB less).
FAST = {
    "softneck.identification.linear._rls_runtime": 1,
    "softneck.identification.set_membership._nlsm_runtime": 1,
    "softneck.identification.networks._nn_runtime": 1,
    "softneck.estimation._kalman_runtime": 2,
    "softneck.design.predictive._mpc_runtime": 1,
}

RANKS: dict[str, tuple[int, ...]] = {name: tuple(map(int, ranks)) for name, ranks in _RANKS.items()}
