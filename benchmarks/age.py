"""How long this process has existed, on Linux: what a cold start costs in all."""

import os
import time
from pathlib import Path


def age() -> float:
    """Seconds since the process began, its imports included."""
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    begun = int(fields[19]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - begun
