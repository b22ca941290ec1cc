"""Checks of a problem and a guess before anything compiles.

Each error names the field, its value and the fix. Values are checked where they are
known, which is not so inside `jax.jit`; shapes always.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ._bounds import Bounds
from ._packed import Packed
from ._problem import GIVE_BOUNDS, OptimalControlProblem
from ._trajectory import Trajectory, time_grid
from ._types import check_kind, is_concrete


def check_precision() -> None:
    """**Raises:** `RuntimeError` if JAX is not in 64-bit mode."""
    if jnp.result_type(float) != jnp.float64:
        raise RuntimeError(
            "jaxscp computes in 64 bits, and JAX is in 32-bit mode; add "
            "jax.config.update('jax_enable_x64', True) before the first array is made."
        )


def check_problem(problem: OptimalControlProblem) -> None:
    """**Raises:** `ValueError` for the first inconsistency found."""
    for name, shape in (
        ("state", None),
        ("control", None),
        ("initial_state", problem.state.shape),
        ("final_state", problem.state.shape),
        ("final_time", ()),
    ):
        _check_bounds(name, getattr(problem, name), shape)
    for name, integral in problem.integrals.items():
        _check_bounds(f"integrals[{name!r}].bounds", integral.bounds, ())
    for names, size in (
        ("state_names", problem.state_size),
        ("control_names", problem.control_size),
    ):
        given = getattr(problem, names)
        if len(given) != size:
            raise ValueError(f"{names}={given}: give {size} names, one for each entry.")
    _check_names(problem)
    for name in ("initial_state", "final_state"):
        _check_reachable(problem, name)
    low = problem.final_time.lower
    if is_concrete(low) and not float(low) > 0:
        raise ValueError(
            f"final_time: lower={float(low):g} s must be positive; give the shortest "
            "flight time that makes sense, for example 0.1."
        )
    _check_functions(problem)


def _check_names(problem: OptimalControlProblem) -> None:
    """Each must name one thing."""
    names = [
        *(problem.state_names + problem.control_names),
        *(*problem.path_constraints, *problem.integrals, "final time", "objective"),
    ]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise ValueError(f"{name!r} names two quantities; rename one of them.")
    for name, unit in problem.units:
        check_kind(f"units[{name!r}]", unit, str, "text, such as 'm/s'")


def check_guesses(
    problem: OptimalControlProblem, guesses: tuple[Trajectory, ...]
) -> None:
    """**Raises:** `ValueError` for the first guess that does not fit its problem, or
    that has another time grid than those before it.
    """
    if not guesses:
        raise ValueError("guess=(): give at least one trajectory, or None.")
    for index, guess in enumerate(guesses):
        name = "guess" if len(guesses) == 1 else f"guess[{index}]"
        _check_same_grid(name, guess, guesses[0])
        check_guess(problem, guess, name)


def _check_same_grid(name: str, guess: Trajectory, first: Trajectory) -> None:
    if guess.nodes != first.nodes:
        raise ValueError(
            f"{name} has {guess.nodes} nodes and guess[0] has {first.nodes}; give all "
            "guesses the same time grid."
        )
    if not is_concrete(guess.fractions, first.fractions):
        return
    mine, its = np.asarray(guess.fractions), np.asarray(first.fractions)
    if (mine != its).any():
        at = int(np.argmax(mine != its))
        raise ValueError(
            f"{name}.fractions[{at}]={mine[at]:g} is {its[at]:g} in guess[0]; give all "
            "guesses the same time grid."
        )


def check_guess(
    problem: OptimalControlProblem, guess: Trajectory, name: str = "guess"
) -> None:
    """**Raises:** `ValueError` if a guess does not fit its problem."""
    time_grid(guess.fractions)
    for field, size in (
        ("states", problem.state_size),
        ("controls", problem.control_size),
    ):
        value = getattr(guess, field)
        if value.shape != (guess.nodes, size):
            raise ValueError(
                f"{name}.{field} has shape {value.shape}; give one row of {size} entries "
                f"for each of the {guess.nodes} nodes."
            )
    for field in ("states", "controls", "final_time"):
        value = getattr(guess, field)
        if is_concrete(value) and not np.isfinite(value).all():
            raise ValueError(
                f"{name}.{field} holds NaN or infinity; give finite numbers at every "
                "node."
            )
    time = guess.final_time
    if jnp.shape(time) != () or (is_concrete(time) and not float(time) > 0):
        raise ValueError(
            f"{name}.final_time={time}: give one positive number of seconds."
        )


def _check_bounds(name: str, bounds: Bounds, shape: tuple[int, ...] | None) -> None:
    check_kind(name, bounds, Bounds, GIVE_BOUNDS)
    if shape is None:
        if len(bounds.shape) != 1 or bounds.shape[0] == 0:
            raise ValueError(
                f"{name}: bounds of shape {bounds.shape}; give one lower and one upper "
                "limit for each entry, shape (n,)."
            )
    elif bounds.shape != shape:
        raise ValueError(
            f"{name}: bounds of shape {bounds.shape}; the problem needs {shape}."
        )
    if not is_concrete(bounds.lower, bounds.upper):
        return
    lower, upper = np.asarray(bounds.lower).ravel(), np.asarray(bounds.upper).ravel()
    fixed = np.array(bounds.fixed, bool)

    def entry(broken: np.ndarray) -> tuple[str, float, float]:
        first = int(np.argmax(broken))
        place = f"{name}[{first}]" if bounds.shape else name
        return place, float(lower[first]), float(upper[first])

    infinite = fixed & ~(np.isfinite(lower) & np.isfinite(upper))
    if infinite.any():
        place, *ends = entry(infinite)
        value = next(end for end in ends if not np.isfinite(end))
        raise ValueError(
            f"{place}={value:g} is fixed but not finite; give a number, or different "
            "infinite limits where an entry is free."
        )
    crossed = ~(lower <= upper)
    if crossed.any():
        place, low, high = entry(crossed)
        raise ValueError(
            f"{place}: lower={low:g} must not exceed upper={high:g}, nor may either be "
            "NaN; swap or widen them."
        )
    parted = fixed & (lower != upper)
    if parted.any():
        place, low, high = entry(parted)
        raise ValueError(
            f"{place} is fixed but has lower={low:g} and upper={high:g}; set both ends "
            "to the same number, or make new Bounds."
        )
    below, above = (np.array(mask, bool) for mask in bounds.limited)
    unseen = (np.isfinite(lower) & ~below) | (np.isfinite(upper) & ~above)
    if unseen.any():
        place, low, high = entry(unseen)
        raise ValueError(
            f"{place} is declared without a limit but has lower={low:g} and "
            f"upper={high:g}; make it infinite, or make new Bounds."
        )


def _check_reachable(problem: OptimalControlProblem, name: str) -> None:
    """A boundary state must leave room within the limits of the state."""
    boundary, limits = getattr(problem, name), problem.state
    ends = (boundary.lower, boundary.upper, limits.lower, limits.upper)
    if not is_concrete(*ends):
        return
    low, high, lower, upper = (np.asarray(end) for end in ends)
    slack = 1e-12 * np.maximum(1.0, np.abs(np.where(np.isfinite(low), low, 0.0)))
    outside = (low > upper + slack) | (high < lower - slack)
    if outside.any():
        entry = int(np.argmax(outside))
        raise ValueError(
            f"{name}: {problem.state_names[entry]} between {low[entry]:g} and "
            f"{high[entry]:g} lies outside its own limits {lower[entry]:g} to "
            f"{upper[entry]:g}; move it inside, or widen `state`."
        )


def _check_functions(problem: OptimalControlProblem) -> None:
    """Shapes and types of what the callables return, without computing anything.

    Looked at once for each structure of a problem: numbers do not change them.
    """
    packed = Packed.of(problem)
    outlines = tuple(
        None if array is None else (array.shape, array.dtype) for array in packed.arrays
    )
    _functions_fit(packed.structure, packed.others, outlines)


@functools.lru_cache(maxsize=128)
def _functions_fit(structure, others, outlines) -> None:
    arrays = [None if o is None else jax.ShapeDtypeStruct(*o) for o in outlines]
    packed = Packed(arrays, others, structure)

    def check(name: str, pick: Callable, shape: tuple[int, ...] | None, *arguments):
        def call(packed, *arguments):
            return pick(packed.unpack())(*arguments)

        _check_output(name, jax.eval_shape(call, packed, *arguments), shape)

    problem = packed.unpack()
    t = jax.ShapeDtypeStruct((), jnp.float64)
    x = jax.ShapeDtypeStruct(problem.state.shape, jnp.float64)
    u = jax.ShapeDtypeStruct(problem.control.shape, jnp.float64)
    check("dynamics", lambda p: p.dynamics, problem.state.shape, t, x, u)
    check("running_cost", lambda p: p.running_cost, (), t, x, u)
    check("terminal_cost", lambda p: p.terminal_cost, (), t, x)
    for name in problem.path_constraints:
        field = f"path_constraints[{name!r}]"
        check(field, lambda p, name=name: p.path_constraints[name], None, t, x, u)
    for name in problem.integrals:
        field = f"integrals[{name!r}].integrand"
        check(field, lambda p, name=name: p.integrals[name].integrand, (), t, x, u)


def _check_output(name: str, output: Any, shape: tuple[int, ...] | None) -> None:
    if not hasattr(output, "shape"):
        raise ValueError(
            f"{name} returns {type(output).__name__}; return one array, "
            "for example jnp.stack([...])."
        )
    if shape is None:
        shape = output.shape if len(output.shape) == 1 else (output.size,)
    if output.shape != shape:
        raise ValueError(f"{name} returns shape {output.shape}; return shape {shape}.")
    if not jnp.issubdtype(output.dtype, jnp.floating):
        raise ValueError(
            f"{name} returns {output.dtype}; return floating-point numbers, "
            "for example by writing 1.0 instead of 1."
        )
