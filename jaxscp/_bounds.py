"""`Bounds`: the one boundary object, for states, controls, times and integrals."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ._tree import as_floats, constant
from ._types import Array, ArrayLike, Float, is_concrete


class Bounds(eqx.Module):
    """Lower and upper limits, entry by entry.

    Equal ends mean fixed, infinite ends mean free. Which entries are fixed and which
    have a limit at all is part of the problem's structure (static: changing it compiles
    anew); the values are data, differentiable, and may change without compiling anything.

    **Arguments:**

    - `lower`, `upper`: limits in the quantity's own unit, broadcast against each other.
    - `scale`: typical size of the quantity, same unit, broadcast to the same shape. It
        is the scale of the variable, and with it of errors and tolerances. Give it where
        the limits do not say how large the variable becomes; NaN entries mean
        "automatic".
    - `fixed`: which entries are equalities. Found from the values by default; needed
        only if bounds are made from traced values inside `jax.jit` or `jax.vmap`, where
        [`Bounds.exactly`][] is the simpler way.
    - `limited`: which entries have a finite lower and which a finite upper limit, found
        likewise; of traced values every entry counts as limited.

    **Raises:** `ValueError` if a limit is NaN or a lower limit exceeds its upper one.
    """

    lower: Float[Array, "*shape"]
    upper: Float[Array, "*shape"]
    scale: Float[Array, "*shape"] | None
    fixed: tuple[bool, ...] = eqx.field(static=True)
    limited: tuple[tuple[bool, ...], tuple[bool, ...]] = eqx.field(static=True)

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        scale: ArrayLike | None = None,
        fixed: tuple[bool, ...] | None = None,
        limited: tuple[tuple[bool, ...], tuple[bool, ...]] | None = None,
    ):
        same = lower is upper
        low, high = as_floats(lower), as_floats(upper)
        # `jnp.broadcast_arrays` would be compiled for shapes that are the same, too.
        shape = np.broadcast_shapes(low.shape, high.shape)
        low, high = jnp.broadcast_to(low, shape), jnp.broadcast_to(high, shape)
        self.lower, self.upper = low, high
        if scale is None:
            self.scale = None
        else:
            self.scale = jnp.broadcast_to(as_floats(scale), low.shape)
        # What is fixed or has a limit can be told while derivatives are taken, too.
        low, high = constant((low, high))
        if fixed is not None:
            self.fixed = fixed
        elif is_concrete(low, high):
            equal = np.asarray(low) == np.asarray(high)
            self.fixed = tuple(bool(entry) for entry in equal.ravel())
        else:
            self.fixed = (same,) * low.size
        found = tuple(_finite(limit) for limit in (low, high))
        self.limited = (found[0], found[1]) if limited is None else limited

    def __check_init__(self):
        low, high = constant((self.lower, self.upper))
        if not is_concrete(low, high):
            return
        lower, upper = np.asarray(low), np.asarray(high)
        if np.isnan(lower).any() or np.isnan(upper).any():
            at = _largest(np.isnan(lower) | np.isnan(upper))
            raise ValueError(
                f"Bounds: lower{_place(at)}={lower[at]:g}, upper{_place(at)}="
                f"{upper[at]:g} must not be NaN; write an infinite limit where an "
                "entry is free."
            )
        if (lower > upper).any():
            at = _largest(lower - upper)
            raise ValueError(
                f"Bounds: lower{_place(at)}={lower[at]:g} exceeds "
                f"upper{_place(at)}={upper[at]:g}; swap them or widen the range."
            )
        self._check_scale()
        if len(self.fixed) != lower.size:
            raise ValueError(
                f"Bounds: fixed has {len(self.fixed)} entries for {lower.size} limits; "
                "give one truth value for each entry."
            )
        if any(len(mask) != lower.size for mask in self.limited):
            lengths = ", ".join(str(len(mask)) for mask in self.limited)
            raise ValueError(
                f"Bounds: limited has {lengths} entries for {lower.size} limits; give "
                "one truth value for each lower and for each upper limit."
            )

    def _check_scale(self):
        scale = constant(self.scale)
        if scale is None or not is_concrete(scale):
            return
        sizes = np.asarray(scale)
        wrong = ~(np.isnan(sizes) | (np.isfinite(sizes) & (sizes > 0.0)))
        if wrong.any():
            at = _largest(wrong)
            raise ValueError(
                f"Bounds: scale{_place(at)}={sizes[at]:g}; give a positive number, or "
                "NaN for an automatic one."
            )

    @classmethod
    def exactly(cls, value: ArrayLike, *, scale: ArrayLike | None = None) -> "Bounds":
        """Every entry fixed to `value`, which may be traced."""
        value = as_floats(value)
        return cls(value, value, scale=scale, fixed=(True,) * value.size)

    @classmethod
    def free(cls, size: int, *, scale: ArrayLike | None = None) -> "Bounds":
        """`size` entries without limits."""
        return cls(np.full(size, -np.inf), np.full(size, np.inf), scale=scale)

    @classmethod
    def at_least(cls, lower: ArrayLike, *, scale: ArrayLike | None = None) -> "Bounds":
        """Limited from below only."""
        return cls(lower, jnp.inf, scale=scale)

    @classmethod
    def at_most(cls, upper: ArrayLike, *, scale: ArrayLike | None = None) -> "Bounds":
        """Limited from above only."""
        return cls(-jnp.inf, upper, scale=scale)

    def followed_by(self, other: "Bounds") -> "Bounds":
        """The entries of both vectors; a number counts as a vector of one."""
        both = (self, other)
        scales = [
            jnp.full(b.lower.size, jnp.nan) if b.scale is None else b.scale.ravel()
            for b in both
        ]
        below, above = (sum((b.limited[side] for b in both), ()) for side in (0, 1))
        return Bounds(
            jnp.concatenate([b.lower.ravel() for b in both]),
            jnp.concatenate([b.upper.ravel() for b in both]),
            scale=jnp.concatenate(scales),
            fixed=self.fixed + other.fixed,
            limited=(below, above),
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Of each of the limits."""
        return self.lower.shape

    @property
    def is_fixed(self) -> np.ndarray:
        """Static mask of the entries that are equalities, in the bounds' shape."""
        return np.array(self.fixed, dtype=bool).reshape(self.shape)

    def prevails(self, other: "Bounds") -> tuple[Array, Array]:
        """Whether lower and upper limits of the same quantity are rather these than the
        others: where this one is fixed, or at least as tight.
        """
        lower = jnp.isfinite(self.lower) & (self.lower >= other.lower)
        upper = jnp.isfinite(self.upper) & (self.upper <= other.upper)
        fixed = jnp.asarray(self.is_fixed)
        return fixed | lower, fixed | upper

    @property
    def target(self) -> Float[Array, "*shape"]:
        """The value of a fixed entry.

        The mean of both ends, so that a derivative splits evenly between them and a
        change of both together moves the target by exactly that change.
        """
        return 0.5 * (self.lower + self.upper)

    @property
    def ends(self) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
        """Lower and upper limits; both the target where an entry is fixed."""
        low, high = (
            jnp.where(self.is_fixed, self.target, limit)
            for limit in (self.lower, self.upper)
        )
        return low, high

    def clip(self, value: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The nearest value within the limits; fixed entries take their target.

        Leading axes of `value` beyond those of the bounds are a batch.
        """
        low, high = (jnp.broadcast_to(limit, value.shape) for limit in self.ends)
        return jnp.clip(value, low, high)


def _finite(limit: Array) -> tuple[bool, ...]:
    if not is_concrete(limit):
        return (True,) * limit.size
    return tuple(bool(entry) for entry in np.isfinite(np.asarray(limit)).ravel())


def _largest(values: ArrayLike) -> tuple[int, ...]:
    shaped = np.nan_to_num(np.asarray(values, float))
    return tuple(int(i) for i in np.unravel_index(np.argmax(shaped), shaped.shape))


def _place(index: tuple[int, ...]) -> str:
    return "".join(f"[{entry}]" for entry in index)
