"""One Runge-Kutta step, and the interval it belongs to."""

import equinox as eqx
import numpy as np

from ._hold import AbstractHold
from ._types import Array, Float, Scalar

# Each stage starts from the one before it.
RK4_NODES = (0.0, 0.5, 0.5, 1.0)
RK4_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


class Span(eqx.Module):
    """One interval of a flight.

    - `start`, `width`: in shares of the flight time.
    - `left`, `right`: controls at the nodes of its ends.
    - `final_time`: the flight time [s].
    """

    start: Scalar
    width: Scalar
    left: Float[Array, " m"]
    right: Float[Array, " m"]
    final_time: Scalar

    @property
    def seconds(self) -> Scalar:
        return self.final_time * self.width

    def moment(
        self, hold: AbstractHold, fraction: Array
    ) -> tuple[Scalar, Float[Array, " m"]]:
        """Time and control at a fraction of the interval."""
        t = self.final_time * (self.start + self.width * fraction)
        return t, hold.interpolate(self.left, self.right, fraction)


class Step(eqx.Module):
    """One Runge-Kutta step.

    - `origin`: the state it starts from. `seconds`: its length.
    - `slopes`: rates at each stage: of the states, then of the integrals and the running
        cost, if they flow.
    - `stages`: time, state and control at each stage.
    """

    origin: Float[Array, " n"]
    seconds: Scalar
    slopes: Float[Array, "4 w"]
    stages: Float[Array, "4 q"]

    @property
    def ending(self) -> Float[Array, " n"]:
        return self.origin + self._total(RK4_WEIGHTS)[: self.origin.size]

    @property
    def growth(self) -> Float[Array, " r"]:
        """Of the integrals and the running cost; empty under the trapezoid rule."""
        return self._total(RK4_WEIGHTS)[self.origin.size :]

    def within(self, share: Scalar) -> Float[Array, " n"]:
        """The state at a share of the step."""
        return self.origin + self._total(inner_weights(share))[: self.origin.size]

    def entries_within(
        self, entries: np.ndarray, shares: Float[Array, " b"]
    ) -> Float[Array, " b"]:
        """Entries of the state, each at its own share of the step."""
        pairs = zip(inner_weights(shares), self.slopes, strict=True)
        moved = sum(weight * slope[entries] for weight, slope in pairs)
        return self.origin[entries] + self.seconds * moved

    def _total(self, weights) -> Float[Array, " w"]:
        # Not a product with a matrix: XLA fuses a sum with what comes before it.
        pairs = zip(weights, self.slopes, strict=True)
        return self.seconds * sum(weight * slope for weight, slope in pairs)


def inner_weights(share: Float[Array, "*b"]) -> tuple[Array, Array, Array, Array]:
    """What the slopes weigh at a share of a step: the method's own interpolation.

    Hairer, Norsett, Wanner, "Solving Ordinary Differential Equations I", Section II.6.
    """
    middle = share**2 * (1.0 - 2.0 / 3.0 * share)
    first = share - share**2 * (1.5 - 2.0 / 3.0 * share)
    last = share**2 * (2.0 / 3.0 * share - 0.5)
    return first, middle, middle, last
