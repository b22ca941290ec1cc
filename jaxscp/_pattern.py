"""How the entries of an array depend on those of an argument, operation by operation."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ._program import applied


class Pattern(NamedTuple):
    """Of the entries of one array, by the entries `v` of the argument.

    - `enters`: shape of the array and v: whether an entry depends on one of the
        argument's.
    - `bends`: shape of the array, v and v: whether its second derivative by two of them
        may be other than zero.
    - `value`: of constants that are known, such as indices.
    """

    enters: np.ndarray
    bends: np.ndarray
    value: np.ndarray | None = None

    @classmethod
    def constant(
        cls, shape: tuple[int, ...], size: int, value: np.ndarray | None = None
    ) -> "Pattern":
        """Of what does not depend on the argument, with its value if that is known."""
        return cls(
            np.zeros((*shape, size), bool), np.zeros((*shape, size, size), bool), value
        )

    @classmethod
    def of_value(cls, value, size: int) -> "Pattern":
        """Of a constant of the program."""
        known = None if isinstance(value, jax.core.Tracer) else np.asarray(value)
        return cls.constant(np.shape(value), size, known)

    @classmethod
    def bent(cls, enters: np.ndarray) -> "Pattern":
        """Of what is nonlinear in all that enters it."""
        return cls(enters, _cross(enters, enters))

    @property
    def depends(self) -> bool:
        return bool(self.enters.any())


def values(patterns: list[Pattern]) -> list[np.ndarray] | None:
    """What constants are, if that is known of all."""
    known = [each.value for each in patterns if each.value is not None]
    return known if len(known) == len(patterns) else None


def evaluated(equation, known: list[np.ndarray]) -> list[np.ndarray]:
    """The results of an operation whose operands are known."""
    with jax.ensure_compile_time_eval():
        found = applied(equation, [jnp.asarray(each) for each in known])
        return [np.asarray(each) for each in found]


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pairs of an entry from the one and one from the other, in either order."""
    pairs = one[..., :, None] & other[..., None, :]
    return pairs | pairs.swapaxes(-1, -2)


def _linear(_, inputs: list[Pattern]) -> Pattern:
    """Entry by entry, linear in each operand; also where kinks join linear pieces."""
    return Pattern(
        functools.reduce(np.bitwise_or, [each.enters for each in inputs]),
        functools.reduce(np.bitwise_or, [each.bends for each in inputs]),
    )


def _bent(equation, inputs: list[Pattern]) -> Pattern:
    """Entry by entry, nonlinear in each operand."""
    return Pattern.bent(_linear(equation, inputs).enters)


def _product(equation, inputs: list[Pattern]) -> Pattern:
    found = _linear(equation, inputs)
    return found._replace(bends=found.bends | _cross(*(each.enters for each in inputs)))


def _quotient(equation, inputs: list[Pattern]) -> Pattern:
    found, below = _linear(equation, inputs), inputs[1].enters
    return found._replace(bends=found.bends | _cross(found.enters, below))


def _power(equation, inputs: list[Pattern]) -> Pattern:
    return (_linear if equation.params["y"] == 1 else _bent)(equation, inputs)


def _chosen(equation, inputs: list[Pattern]) -> Pattern:
    """Derivatives of `select_n` are those of the case that is chosen."""
    return _linear(equation, inputs[1:])


def _moved(equation, inputs: list[Pattern]) -> Pattern | None:
    """Entries of the first operand at other places: they are told where by numbers."""
    first, *places = inputs
    known = values(places)
    if known is None:
        return None
    shape = first.enters.shape[:-1]
    numbers = np.arange(1, np.prod(shape, dtype=int) + 1).reshape(shape)
    move = _MOVES.get(equation.primitive.name)
    if move is None:
        (sources,) = evaluated(equation, [numbers, *known])
    else:
        sources = move(numbers, equation.outvars[0].aval.shape, equation.params)
    # What comes from beyond the array is a constant.
    flat = (
        each.reshape(-1, *each.shape[len(shape) :])
        for each in (first.enters, first.bends)
    )
    padded = [np.concatenate([np.zeros_like(each[:1]), each]) for each in flat]
    return Pattern(*(each[np.maximum(sources, 0)] for each in padded))


def _sliced(numbers: np.ndarray, shape, params: dict) -> np.ndarray:
    starts, ends = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(starts)
    return numbers[tuple(map(slice, starts, ends, strides))]


def _broadcast(numbers: np.ndarray, shape, params: dict) -> np.ndarray:
    own = [1] * len(shape)
    for size, axis in zip(numbers.shape, params["broadcast_dimensions"], strict=True):
        own[axis] = size
    return np.broadcast_to(numbers.reshape(own), shape)


def _joined(equation, inputs: list[Pattern]) -> Pattern:
    parts = ([each.enters for each in inputs], [each.bends for each in inputs])
    if equation.primitive.name == "stack":
        return Pattern(*(np.stack(part, equation.params["axis"]) for part in parts))
    return Pattern(
        *(np.concatenate(part, equation.params["dimension"]) for part in parts)
    )


def _summed(equation, inputs: list[Pattern]) -> Pattern:
    axes = tuple(equation.params["axes"])
    parts = (inputs[0].enters, inputs[0].bends)
    return Pattern(*(np.asarray(part.any(axis=axes)) for part in parts))


def _contracted(equation, inputs: list[Pattern]) -> Pattern:
    """Matrix products: which of the sums have a term that depends on what."""
    left, right = inputs
    shape, size = equation.outvars[0].aval.shape, left.enters.shape[-1]
    axes = _product_axes(equation.params["dimension_numbers"], left, right)

    def terms(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """By what their last axes tell apart."""
        one, other = one.astype(float), other.astype(float)
        return np.einsum(one, axes[0], other, axes[1], axes[2], optimize=True) > 0.5

    every = [np.ones((*each.enters.shape[:-1], 1), bool) for each in inputs]
    enters = (
        terms(left.enters, every[1])[..., 0] | terms(every[0], right.enters)[..., 0, :]
    )
    flat = [each.bends.reshape(*each.enters.shape[:-1], -1) for each in inputs]
    bends = terms(flat[0], every[1])[..., 0] | terms(every[0], flat[1])[..., 0, :]
    both = terms(left.enters, right.enters)
    bends = bends.reshape(*shape, size, size) | both | both.swapaxes(-1, -2)
    return Pattern(enters, bends)


def _product_axes(numbers, left: Pattern, right: Pattern) -> tuple[list[int], ...]:
    """For `numpy.einsum`: axes of both operands of `jax.lax.dot_general` and of what it
    gives, and one more of each operand, last.
    """
    contracted, batched = numbers
    count = left.enters.ndim - 1
    first, second = list(range(count)), list(range(count, count + right.enters.ndim - 1))
    for own, others in (contracted, batched):
        for i, j in zip(own, others, strict=True):
            second[j] = first[i]
    shared = {first[i] for i in (*contracted[0], *batched[0])}
    free = [axis for axis in (*first, *second) if axis not in shared]
    last = [count + len(second), count + len(second) + 1]
    given = [first[i] for i in batched[0]] + free + last
    return [*first, last[0]], [*second, last[1]], given


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
RULES = {
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
