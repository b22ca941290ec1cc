"""Resident memory of this process on Linux, in MB of 1e6 bytes.

Not `ru_maxrss`: a child's begins with what its parent held when it was started.
"""

import ctypes
from pathlib import Path

_PROCESS = Path("/proc/self")


def resident() -> float:
    """What the process holds now."""
    return _status("VmRSS")


def peak() -> float:
    """The most it held since it began, or since [`forget_peak`][]."""
    return _status("VmHWM")


def forget_peak() -> None:
    """Give back what is free, and measure the peak from now on."""
    ctypes.CDLL(None).malloc_trim(0)
    (_PROCESS / "clear_refs").write_text("5")


def _status(entry: str) -> float:
    for line in (_PROCESS / "status").read_text().splitlines():
        if line.startswith(f"{entry}:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise RuntimeError(f"/proc/self/status has no {entry}: memory needs Linux.")
