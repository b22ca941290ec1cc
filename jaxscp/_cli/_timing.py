"""What a run spends on imports and on compilation."""

import math
import os
import time
from typing import Any

import jax.monitoring

from .._kept import LOADING

COMPILATION = "/jax/core/compile/"


class CompileClock:
    """Counts the seconds of tracing, lowering and compiling, or of reading what was
    compiled before, while it is open.
    """

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []

    @property
    def seconds(self) -> float:
        return math.fsum(end - begin for begin, end in self._spans)

    def __enter__(self) -> "CompileClock":
        jax.monitoring.register_event_duration_secs_listener(self._record)
        return self

    def __exit__(self, *exception: object) -> None:
        jax.monitoring.unregister_event_duration_listener(self._record)

    def _record(self, event: str, duration_secs: float, **details: Any) -> None:
        del details
        if event != LOADING and not event.startswith(COMPILATION):
            return
        end = time.perf_counter()
        begin = end - duration_secs
        # A function's tracing contains that of the functions it calls: a later span
        # swallows the earlier ones it overlaps, so that no second counts twice.
        while self._spans and self._spans[-1][1] > begin:
            begin = min(begin, self._spans.pop()[0])
        self._spans.append((begin, end))


def process_age() -> float:
    """Seconds since this process started (processor seconds where unknown)."""
    try:
        with open("/proc/self/stat", encoding="utf-8", errors="replace") as file:
            # The second field, the program's name, may hold spaces and brackets.
            fields = file.read().rpartition(")")[2].split()
        started = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime(time.CLOCK_BOOTTIME) - started
    except (AttributeError, IndexError, OSError, ValueError):
        return time.process_time()
