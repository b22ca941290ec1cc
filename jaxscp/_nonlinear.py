"""Second derivatives of a function, as few as its program says are other than zero.

A quadrotor's rates are linear in its position and velocity, and most path constraints
know nothing but the position. Columns of a Hessian that share no rows can be had from
one tangent (Curtis, Powell, Reid, 1974), and so can those that share only what its
symmetry tells from elsewhere (Powell, Toint, 1979). The program is read once, while JAX
traces; whatever is not known to be linear counts as nonlinear in all that enters it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ._pattern import RULES, Pattern, evaluated, values
from ._program import interpreted
from ._types import Array, Float, Scalar


class Nonlinearity(NamedTuple):
    """Where the second derivatives of a function may be other than zero.

    - `entries`: indices of the entries of its argument that it is nonlinear in.
    - `pairs`: whether the derivative by two of those may be other than zero.
    - `groups`: for each of them, the tangent that tells its column.
    """

    entries: np.ndarray
    pairs: np.ndarray
    groups: np.ndarray

    @classmethod
    def of(
        cls, function: Callable[[Float[Array, " v"]], Array], size: int
    ) -> "Nonlinearity":
        """That of all the numbers a function gives, together."""
        program = jax.make_jaxpr(function)(jnp.zeros(size))
        whole = Pattern.constant((size,), size)._replace(enters=np.eye(size, dtype=bool))
        outputs = _run(program.jaxpr, program.consts, [whole], size)
        bends = [out.bends.reshape(-1, size, size).any(axis=0) for out in outputs]
        pairs = np.any(bends, axis=0)
        entries = np.flatnonzero(pairs.any(axis=0))
        pairs = pairs[np.ix_(entries, entries)]
        return cls(entries, pairs, _groups(pairs))

    def hessian(
        self, function: Callable[[Float[Array, " v"]], Scalar], point: Float[Array, " v"]
    ) -> Float[Array, "e e"]:
        """By `entries`, of a function that is nonlinear in no other pairs."""
        if not self.entries.size:
            return jnp.zeros((0, 0))
        slope = jax.grad(lambda own: function(point.at[self.entries].set(own)))
        told = jax.vmap(lambda seed: jax.jvp(slope, (point[self.entries],), (seed,))[1])(
            jnp.asarray(_seeds(self.groups))
        )
        return jnp.append(told.ravel(), 0.0)[self._places()]

    def _places(self) -> np.ndarray:
        """Where each second derivative is found in what the tangents tell, flattened: in
        its column if no other of the group has that row, or else in its row's column.
        """
        size = self.entries.size
        own = self.groups[:, None] * size + np.arange(size)
        places = np.where(_alone(self.pairs, self.groups), own, own.T)
        return np.where(self.pairs, places, (self.groups.max() + 1) * size)


def hessian(
    function: Callable[[Float[Array, " v"]], Scalar], point: Float[Array, " v"]
) -> Float[Array, "v v"]:
    """As `jax.hessian`, from fewer tangents."""
    bent = Nonlinearity.of(function, point.size)
    nothing, places = jnp.zeros((point.size,) * 2), np.ix_(bent.entries, bent.entries)
    return nothing.at[places].set(bent.hessian(function, point))


def _seeds(groups: np.ndarray) -> np.ndarray:
    return (groups == np.arange(groups.max() + 1)[:, None]).astype(float)


def _alone(pairs: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """By column and row: whether no other column of the group has something there."""
    return (_seeds(groups) @ pairs)[groups] == 1


def _groups(pairs: np.ndarray) -> np.ndarray:
    """A group for each column, so that every pair is alone in one of its two columns.

    Each column joins the group that it shares the fewest rows with, if it can join any.
    """
    groups = np.arange(pairs.shape[0])
    for column in range(1, groups.size):
        shared = (_seeds(groups) @ pairs) @ pairs[column]
        for group in sorted(set(groups[:column].tolist()), key=shared.__getitem__):
            tried = groups.copy()
            tried[column] = group
            alone = _alone(pairs, tried)
            if (alone | alone.T)[pairs].all():
                groups = tried
                break
    return np.unique(groups, return_inverse=True)[1]


def _run(jaxpr, constants, arguments: list[Pattern], size: int) -> list[Pattern]:
    """Patterns of a program's results."""
    return interpreted(
        jaxpr,
        constants,
        arguments,
        of_value=lambda value: Pattern.of_value(value, size),
        of_equation=lambda equation, inputs: _of_equation(equation, inputs, size),
    )


def _of_equation(equation, inputs: list[Pattern], size: int) -> list[Pattern]:
    name = equation.primitive.name
    shapes = [out.aval.shape for out in equation.outvars]
    if not any(each.depends for each in inputs):
        return _constants(equation, inputs, size)
    if not any(jnp.issubdtype(o.aval.dtype, jnp.inexact) for o in equation.outvars):
        # Comparisons have no derivatives.
        return [Pattern.constant(shape, size) for shape in shapes]
    inner = equation.params.get("jaxpr")
    if name in ("jit", "pjit", "closed_call", "remat", "checkpoint"):
        jaxpr, constants = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
        return _run(jaxpr, constants, inputs, size)
    rule = RULES.get(name)
    found = rule(equation, inputs) if rule else None
    if found is not None:
        return [found]
    every = np.any([each.enters.reshape(-1, size).any(axis=0) for each in inputs], axis=0)
    dense = [np.broadcast_to(every, (*shape, size)) for shape in shapes]
    return [Pattern.bent(each) for each in dense]


def _constants(equation, inputs: list[Pattern], size: int) -> list[Pattern]:
    """What does not depend on the argument, with its values if these are known."""
    shapes = [out.aval.shape for out in equation.outvars]
    known = values(inputs)
    if equation.params.get("jaxpr") or known is None:
        return [Pattern.constant(shape, size) for shape in shapes]
    found = evaluated(equation, known)
    return [Pattern.constant(s, size, v) for s, v in zip(shapes, found, strict=True)]
