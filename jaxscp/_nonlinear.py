"""Which entries of its argument a function is nonlinear in, found from its program.

Second derivatives by all other entries vanish everywhere: a quadrotor's rates are linear
in its position and velocity, and most path constraints know nothing but the position.
The program is read once, while JAX traces; whatever is not known to be linear counts as
nonlinear in all that enters it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ._types import Array, Float


class _Pattern(NamedTuple):
    """Of the entries of one array, by the entries `v` of the argument.

    - `enters`, `bends`: shape of the array and v: whether an entry depends on one of the
        argument's, and whether nonlinearly.
    - `value`: of constants that are known, such as indices.
    """

    enters: np.ndarray
    bends: np.ndarray
    value: np.ndarray | None = None

    @classmethod
    def none(cls, value, size: int) -> "_Pattern":
        """Of a constant."""
        nothing = np.zeros((*np.shape(value), size), bool)
        known = None if isinstance(value, jax.core.Tracer) else np.asarray(value)
        return cls(nothing, nothing, known)

    @property
    def depends(self) -> bool:
        return bool(self.enters.any())


def nonlinear_entries(
    function: Callable[[Float[Array, " v"]], Array], size: int
) -> np.ndarray:
    """Indices of the entries of a vector that a function is nonlinear in."""
    program = jax.make_jaxpr(function)(jnp.zeros(size))
    whole = _Pattern(np.eye(size, dtype=bool), np.zeros((size, size), bool))
    outputs = _run(program.jaxpr, program.consts, [whole], size)
    bends = [out.bends.reshape(-1, size).any(axis=0) for out in outputs]
    return np.flatnonzero(np.any(bends, axis=0))


def compact_hessian(
    function: Callable[[Float[Array, " v"]], Array],
    point: Float[Array, " v"],
    entries: np.ndarray,
) -> Float[Array, "e e"]:
    """Second derivatives by the entries that a function is nonlinear in."""
    return jax.hessian(lambda own: function(point.at[entries].set(own)))(point[entries])


def _run(jaxpr, constants, arguments: list[_Pattern], size: int) -> list[_Pattern]:
    """Patterns of a program's results."""
    known = dict(zip(jaxpr.invars, arguments, strict=True))
    fixed = [_Pattern.none(value, size) for value in constants]
    known |= dict(zip(jaxpr.constvars, fixed, strict=True))

    def read(atom) -> _Pattern:
        if isinstance(atom, core.Literal):
            return _Pattern.none(atom.val, size)
        return known[atom]

    for equation in jaxpr.eqns:
        found = _of_equation(equation, [read(atom) for atom in equation.invars], size)
        known |= dict(zip(equation.outvars, found, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _of_equation(equation, inputs: list[_Pattern], size: int) -> list[_Pattern]:
    name = equation.primitive.name
    shapes = [out.aval.shape for out in equation.outvars]
    if not any(each.depends for each in inputs):
        return _constants(equation, inputs, size)
    if not any(jnp.issubdtype(o.aval.dtype, jnp.inexact) for o in equation.outvars):
        # Comparisons have no derivatives.
        return [_Pattern(*2 * (np.zeros((*shape, size), bool),)) for shape in shapes]
    inner = equation.params.get("jaxpr")
    if name in ("jit", "pjit", "closed_call", "remat", "checkpoint"):
        jaxpr, constants = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
        return _run(jaxpr, constants, inputs, size)
    rule = _RULES.get(name)
    found = rule(equation, inputs) if rule else None
    if found is not None:
        return [found]
    every = np.any([each.enters.reshape(-1, size).any(axis=0) for each in inputs], axis=0)
    dense = [np.broadcast_to(every, (*shape, size)) for shape in shapes]
    return [_Pattern(each, each) for each in dense]


def _constants(equation, inputs: list[_Pattern], size: int) -> list[_Pattern]:
    """What does not depend on the argument, with its values if these are known."""
    nothing = [np.zeros((*o.aval.shape, size), bool) for o in equation.outvars]
    known = _values(inputs)
    if equation.params.get("jaxpr") or known is None:
        return [_Pattern(none, none) for none in nothing]
    values = _evaluated(equation, known)
    return [_Pattern(n, n, v) for n, v in zip(nothing, values, strict=True)]


def _values(patterns: list[_Pattern]) -> list[np.ndarray] | None:
    """What constants are, if that is known of all."""
    known = [each.value for each in patterns if each.value is not None]
    return known if len(known) == len(patterns) else None


def _evaluated(equation, values: list[np.ndarray]) -> list[np.ndarray]:
    with jax.ensure_compile_time_eval():
        found = equation.primitive.bind(*map(jnp.asarray, values), **equation.params)
        several = equation.primitive.multiple_results
        return [np.asarray(each) for each in (found if several else [found])]


def _linear(_, inputs: list[_Pattern]) -> _Pattern:
    """Entry by entry, linear in each operand; also where kinks join linear pieces."""
    shape = np.broadcast_shapes(*(each.enters.shape for each in inputs))
    enters, bends = np.zeros(shape, bool), np.zeros(shape, bool)
    for each in inputs:
        enters, bends = enters | each.enters, bends | each.bends
    return _Pattern(enters, bends)


def _bent(equation, inputs: list[_Pattern]) -> _Pattern:
    """Entry by entry, nonlinear in each operand."""
    enters = _linear(equation, inputs).enters
    return _Pattern(enters, enters)


def _product(equation, inputs: list[_Pattern]) -> _Pattern:
    found = _linear(equation, inputs)
    both = [each.enters.any(axis=-1, keepdims=True) for each in inputs]
    return _Pattern(found.enters, found.bends | (found.enters & both[0] & both[1]))


def _quotient(equation, inputs: list[_Pattern]) -> _Pattern:
    found, below = _linear(equation, inputs), inputs[1].enters
    bent = found.enters & below.any(axis=-1, keepdims=True)
    return _Pattern(found.enters, found.bends | bent)


def _power(equation, inputs: list[_Pattern]) -> _Pattern:
    return (_linear if equation.params["y"] == 1 else _bent)(equation, inputs)


def _chosen(equation, inputs: list[_Pattern]) -> _Pattern:
    """Derivatives of `select_n` are those of the case that is chosen."""
    return _linear(equation, inputs[1:])


def _moved(equation, inputs: list[_Pattern]) -> _Pattern | None:
    """Entries of the first operand at other places: they are told where by numbers."""
    first, *places = inputs
    known = _values(places)
    if known is None:
        return None
    shape = first.enters.shape[:-1]
    numbers = np.arange(1, np.prod(shape, dtype=int) + 1).reshape(shape)
    move = _MOVES.get(equation.primitive.name)
    if move is None:
        (sources,) = _evaluated(equation, [numbers, *known])
    else:
        sources = move(numbers, equation.outvars[0].aval.shape, equation.params)
    # What comes from beyond the array is a constant.
    flat = [np.vstack([np.zeros_like(e[:1]), e]) for e in _flat(first)]
    return _Pattern(*(each[np.maximum(sources, 0)] for each in flat))


def _sliced(numbers: np.ndarray, shape, params: dict) -> np.ndarray:
    starts, ends = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(starts)
    return numbers[tuple(map(slice, starts, ends, strides))]


def _broadcast(numbers: np.ndarray, shape, params: dict) -> np.ndarray:
    own = [1] * len(shape)
    for size, axis in zip(numbers.shape, params["broadcast_dimensions"], strict=True):
        own[axis] = size
    return np.broadcast_to(numbers.reshape(own), shape)


def _flat(pattern: _Pattern) -> tuple[np.ndarray, np.ndarray]:
    size = pattern.enters.shape[-1]
    return pattern.enters.reshape(-1, size), pattern.bends.reshape(-1, size)


def _joined(equation, inputs: list[_Pattern]) -> _Pattern:
    parts = ([each.enters for each in inputs], [each.bends for each in inputs])
    if equation.primitive.name == "stack":
        return _Pattern(*(np.stack(part, equation.params["axis"]) for part in parts))
    return _Pattern(
        *(np.concatenate(part, equation.params["dimension"]) for part in parts)
    )


def _summed(equation, inputs: list[_Pattern]) -> _Pattern:
    axes = tuple(equation.params["axes"])
    parts = (inputs[0].enters, inputs[0].bends)
    return _Pattern(*(np.asarray(part.any(axis=axes)) for part in parts))


def _contracted(equation, inputs: list[_Pattern]) -> _Pattern:
    """Matrix products: how many terms of each sum depend on what."""

    def terms(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        counts = [one.astype(float), other.astype(float)]
        with jax.ensure_compile_time_eval():
            found = equation.primitive.bind(*map(jnp.asarray, counts), **equation.params)
            return np.asarray(found > 0)

    left, right = inputs
    ones = [np.ones(each.enters.shape[:-1]) for each in inputs]

    def spread(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        entries = range(first.shape[-1])
        return np.stack(
            [
                terms(first[..., v], ones[1]) | terms(ones[0], second[..., v])
                for v in entries
            ],
            axis=-1,
        )

    enters = spread(left.enters, right.enters)
    both = left.depends and right.depends
    return _Pattern(enters, enters if both else spread(left.bends, right.bends))


# fmt: off
_LINEAR = ("abs", "add", "add_any", "convert_element_type", "copy", "max", "min", "neg",
           "real", "sub")
_BENT = ("acos", "asin", "atan", "atan2", "cbrt", "cos", "cosh", "erf", "exp", "exp2",
         "expm1", "log", "log1p", "logistic", "pow", "rsqrt", "sin", "sinh", "sqrt",
         "square", "tan", "tanh")
# fmt: on
# By NumPy: JAX would compile a program for each of them.
_MOVES: dict[str, Callable] = {
    **dict.fromkeys(
        ("expand_dims", "reshape", "squeeze"),
        lambda numbers, shape, _: numbers.reshape(shape),
    ),
    "broadcast_in_dim": _broadcast,
    "rev": lambda numbers, _, params: np.flip(numbers, params["dimensions"]),
    "slice": _sliced,
    "transpose": lambda numbers, _, params: numbers.transpose(params["permutation"]),
}
_RULES = {
    **dict.fromkeys(_LINEAR, _linear),
    **dict.fromkeys(_BENT, _bent),
    **dict.fromkeys((*_MOVES, "dynamic_slice", "gather"), _moved),
    "mul": _product,
    "div": _quotient,
    "integer_pow": _power,
    "select_n": _chosen,
    "concatenate": _joined,
    "stack": _joined,
    "reduce_sum": _summed,
    "dot_general": _contracted,
}
