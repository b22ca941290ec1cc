"""How XLA compiles a solve, and what else is compiled by itself."""

import functools
import os
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax

from ._kept import kept_program
from ._tree import as_parameters
from ._types import is_concrete

_R = TypeVar("_R")

_LEVEL = "xla_backend_optimization_level"
# On the CPU a solve compiles in less than half the time, and runs as fast, with XLA's
# older emitters of kernels, fewer optimizations of these, and sums and maxima by one loop
# each: as trees of loops one takes the compiler 24 ms instead of 4.
_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    _LEVEL: 1,
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
}


@functools.cache
def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit`; none on other devices, or where XLA knows them no longer.

    What the environment's `XLA_FLAGS` name is the user's.
    """
    if jax.default_backend() != "cpu":
        return {}
    flags = os.environ.get("XLA_FLAGS", "")
    options = {name: value for name, value in _OPTIONS.items() if name not in flags}
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def compiled(function: Callable[..., _R]) -> Callable[..., _R]:
    """`eqx.filter_jit`, with [`compiler_options`][], and kept whole where it can be.

    Not where an argument is traced: only what is compiled by itself may have options of
    its own.
    """
    program = _with_options(function, compiler_options)

    @functools.wraps(function)
    def call(*arguments: Any) -> _R:
        if _is_alone(arguments):
            kept = kept_program(function, arguments, compiler_options())
            if kept is not None:
                return kept(arguments)
        return program(*arguments)

    return call


def compiled_quickly(function: Callable[..., _R]) -> Callable[..., _R]:
    """`eqx.filter_jit` without optimization, which takes longer than it gains where a
    program runs once.
    """
    return _with_options(function, _quick_options)


def _with_options(
    function: Callable[..., _R], options: Callable[[], dict[str, Any]]
) -> Callable[..., _R]:
    @functools.cache
    def program(alone: bool) -> Callable[..., _R]:
        # Equinox passes on what its signature does not name.
        named: dict[str, Any] = {"compiler_options": options()} if alone else {}
        return eqx.filter_jit(function, **named)

    @functools.wraps(function)
    def call(*arguments: Any) -> _R:
        return program(_is_alone(arguments))(*arguments)

    return call


def _is_alone(arguments: tuple[Any, ...]) -> bool:
    return is_concrete(eqx.filter(arguments, eqx.is_array))


def _quick_options() -> dict[str, Any]:
    options = compiler_options()
    return {name: 0 if name == _LEVEL else value for name, value in options.items()}


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
