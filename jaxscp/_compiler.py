"""How XLA compiles a solve."""

import functools
from typing import Any

import jax

# Its older emitters of kernels: on the CPU a solve compiles in half the time with them
# and runs as fast.
_OPTIONS = {"xla_cpu_use_fusion_emitters": False}


@functools.cache
def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit`; none on other devices, or where XLA knows them no longer."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x, compiler_options=_OPTIONS).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return _OPTIONS
