"""`PerConstraint`: one number for each entry of each constraint."""

import equinox as eqx

from ._types import Array, Float


class PerConstraint(eqx.Module):
    """Multipliers, weights or violations, entry by entry.

    Multipliers belong to the Lagrangian J + sum(multiplier x constraint), with the
    constraints defects = 0, g <= 0 at the nodes, peaks <= 0 between them, and integral
    minus its active bound.
    """

    dynamics: Float[Array, "I n"]
    path: Float[Array, "N p"]
    between: Float[Array, "I b"]
    integral: Float[Array, " q"]
