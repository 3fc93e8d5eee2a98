"""How much of the bus the cyclic traffic takes, in the worst case of stuffed bits."""

from __future__ import annotations

# Stuffing at its worst needs a fifth more than frames of real data: this part of a bus works and leaves some for SDO,
# emergencies and repeated frames.
MOST = 0.9
# Of set-points, of a drive's answer, of guarding (request, answer, heartbeat), of an inclinometer [bytes].
_RPDO, _TPDO, _GUARD, _SLOPES = 6, 8, 1, 8


def frame_bits(size: int, *, remote: bool = False) -> int:
    """Return the bits of a frame with `size` bytes, with stuffing and the gap behind it.

    A remote request carries none of them. (Davis, Burns et al. 2007, Eq. 2: g = 34 bits are stuffed beside the data.)
    """
    data = 0 if remote else 8 * size
    return data + 47 + (34 + data - 1) // 4


def bus_load(drives: int, *, cycle: float, guard_cycles: int, bit_rate: int, sensor_period: float = 0.0) -> float:
    """Return the part of the bus that set-points, SYNC, answers, life guarding and an inclinometer need.

    Args:
        drives: number of them.
        cycle: of the bus [s].
        guard_cycles: between two guarding requests to each.
        bit_rate: [bit/s].
        sensor_period: of an inclinometer on the bus [s]; 0 for none.
    """
    each = frame_bits(_RPDO) + frame_bits(_TPDO)
    each += (frame_bits(_GUARD, remote=True) + frame_bits(_GUARD)) / guard_cycles
    bits = (drives * each + frame_bits(0)) / cycle
    return (bits + (frame_bits(_SLOPES) / sensor_period if sensor_period else 0.0)) / bit_rate
