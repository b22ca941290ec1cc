"""Directions in the space of parameters, by the parameters' names."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._bounds import Bounds
from ._records import unknown_path
from ._tree import as_floats
from ._types import Array, ArrayLike, PyTree


def direction(parameters: PyTree, changes: Mapping[str, ArrayLike]) -> PyTree:
    """The tree in which parameters change by so much, and nothing else.

    **Arguments:**

    - `changes`: by dotted paths, broadcast to their shapes. The path of `Bounds` moves
        both limits.

    **Raises:** `ValueError` for a path that names no inexact array, listing those that
    do, and for a change of the wrong shape.
    """
    numbers = eqx.filter(parameters, eqx.is_inexact_array)
    places, structure = jax.tree_util.tree_flatten_with_path(numbers)
    names = [_name(path) for path, _ in places]
    ways = [jnp.zeros_like(leaf) for _, leaf in places]
    for name, change in changes.items():
        ends = (name,) if name in names else (f"{name}.lower", f"{name}.upper")
        if not set(ends) <= set(names):
            raise unknown_path(name, names)
        for place in map(names.index, ends):
            ways[place] = _broadcast(name, change, ways[place])
    return jax.tree.unflatten(structure, ways)


def own_directions(
    parameters: PyTree, wrt: Sequence[str] | None = None
) -> dict[str, PyTree]:
    """For each parameter, by name, the tree in which it alone moves, by its own size.

    **Arguments:**

    - `wrt`: beginnings of names; all by default.

    **Raises:** `ValueError` if no name begins so, listing them.
    """
    every = dict(_own_directions(parameters))
    if wrt is None:
        return every
    chosen = {name: way for name, way in every.items() if name.startswith(tuple(wrt))}
    if not chosen:
        raise ValueError(
            f"wrt={list(wrt)}: no parameter's name begins so; the names are "
            f"{', '.join(every)}."
        )
    return chosen


def _own_directions(parameters: PyTree) -> Iterator[tuple[str, PyTree]]:
    numbers = eqx.filter(parameters, eqx.is_inexact_array)
    groups, structure = jax.tree_util.tree_flatten_with_path(numbers, is_leaf=_is_bounds)
    still = [jax.tree.map(jnp.zeros_like, group) for _, group in groups]
    for place, (path, group) in enumerate(groups):
        for limit, way in _ways(group):
            trees = [*still[:place], way, *still[place + 1 :]]
            yield _name(path) + limit, jax.tree.unflatten(structure, trees)


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _broadcast(name: str, change: ArrayLike, like: Array) -> Array:
    change = as_floats(change)
    try:
        return jnp.broadcast_to(change, like.shape)
    except ValueError:
        raise ValueError(
            f"{name} has shape {like.shape}, its change {change.shape}: give one number, "
            "or one for each entry."
        ) from None


def _ways(group: Any) -> Iterator[tuple[str, Any]]:
    """What of a parameter moves by itself: of bounds each limit, where equal both."""
    if not isinstance(group, Bounds):
        if group.size:
            yield "", _way(group, np.ones(group.shape, bool))
        return
    still, fixed = jax.tree.map(jnp.zeros_like, group), group.is_fixed
    none = jnp.zeros(group.shape)
    below, above = np.isfinite(group.lower), np.isfinite(group.upper)
    target = _way(group.target, fixed)
    for limit, moves, ends in (
        (".value", fixed, (target, target)),
        (".lower", below & ~fixed, (_way(group.lower, below & ~fixed), none)),
        (".upper", above & ~fixed, (none, _way(group.upper, above & ~fixed))),
    ):
        if moves.any():
            yield limit, eqx.tree_at(lambda b: (b.lower, b.upper), still, ends)


def _way(values: Array, moves: Any) -> Array:
    """A direction with signs of chance, as large as the largest number that moves."""
    sizes = np.abs(np.where(moves, values, 0.0))
    size = float(np.max(sizes, initial=0.0)) or 1.0
    signs = np.random.default_rng(0).choice([-1.0, 1.0], values.shape)
    return jnp.asarray(np.where(moves, size * signs, 0.0))


def _is_bounds(node: Any) -> bool:
    return isinstance(node, Bounds)
