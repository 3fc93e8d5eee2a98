"""Why a device cannot be used, in words, and what to do about it: one line, without the operating system's numbers."""

from __future__ import annotations

import errno
import re

_ADVICE = {
    errno.EACCES: "Serial adapters belong to the group `dialout`: `sudo usermod -aG dialout $USER`, then log in again",
    errno.EPERM: "This user is not permitted; ask whoever looks after the machine",
    errno.ENOENT: "Is it plugged in, is the name right? `ls /dev/serial/by-id` lists serial ports",
    errno.ENODEV: "`ip link show` lists the interfaces of this machine",
    errno.EBUSY: "Another program has it open; end that one",
    errno.EAFNOSUPPORT: "This kernel has no CAN: `sudo modprobe can-raw`, and `vcan` to practise",
    errno.ENETDOWN: "`sudo ip link set can0 up`, with the bit rate set before",
    errno.ENOBUFS: "Nobody acknowledges them: is a drive on, the bit rate right, the line terminated",
    errno.EIO: "Was it unplugged?",
}
# How operating system and libraries number an error within its text.
_NUMBERS = re.compile(r"\[Errno (\d+)\] ?")


def reason(error: BaseException) -> str:
    """Return what `error` says as one sentence, with advice where its number is a known one.

    Libraries wrap the operating system's errors and keep the number in the text only.
    """
    text = " ".join(str(error).split()) or type(error).__name__
    number = error.errno if isinstance(error, OSError) else None
    found = _NUMBERS.findall(text)
    if number is None and found:
        number = int(found[-1])
    advice = _ADVICE.get(number or 0, "")
    text = _NUMBERS.sub("", text).rstrip(".")
    return f"{text}. {advice}." if advice else f"{text}."
