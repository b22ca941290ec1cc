"""The median time of many calls; needs no jaxscp."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax

# Seconds that the calls may take, and most of them.
PATIENCE, CALLS = 3.0, 200


def median_seconds(call: Callable[[], Any]) -> float:
    """Of many warm calls; of few, or one, where these last longer."""
    seconds: list[float] = []
    while not seconds or (sum(seconds) < PATIENCE and len(seconds) < CALLS):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - begun)
    return statistics.median(seconds)
