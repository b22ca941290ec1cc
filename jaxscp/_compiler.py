"""How XLA compiles a solve, and what else is compiled by itself."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax

from ._tree import as_parameters
from ._types import is_concrete

_R = TypeVar("_R")

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


def compiled(function: Callable[..., _R]) -> Callable[..., _R]:
    """`eqx.filter_jit`, with [`compiler_options`][] unless an argument is traced: only
    what is compiled by itself may have options of its own.
    """

    @functools.cache
    def program(alone: bool) -> Callable[..., _R]:
        # Equinox passes on what its signature does not name.
        options: dict[str, Any] = (
            {"compiler_options": compiler_options()} if alone else {}
        )
        return eqx.filter_jit(function, **options)

    @functools.wraps(function)
    def call(*arguments: Any) -> _R:
        alone = is_concrete(eqx.filter(arguments, eqx.is_array))
        return program(alone)(*arguments)

    return call


def traced_once(function: Callable[..., _R]) -> Callable[..., _R]:
    """`eqx.filter_jit`, for what one program has in more than one place.

    JAX keeps what it traced for a context, of which the devices' mesh is a part: unnamed
    at first, named where it differentiates what is traced already. Always naming it
    makes these the same, and so do numbers that are never weakly typed.
    """
    program = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> _R:
        with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
            return program(*as_parameters(arguments), **named)

    return call
