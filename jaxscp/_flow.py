"""The flow of one interval: classical Runge-Kutta steps of equal length."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._discretization import Discretization, Quadrature
from ._hold import AbstractHold
from ._peaks import Watch, largest
from ._problem import OptimalControlProblem
from ._types import Array, Float, Scalar

# Each stage starts from the one before it.
RK4_NODES = (0.0, 0.5, 0.5, 1.0)
RK4_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
# No peak is looked for nearer to a node, in shares of an interval: the node itself is
# enforced, and at a fixed one a limit just met would have no gradient.
_NODE_SHARE = 0.02


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
    - `slopes`: rates at the four stages: of the states, then of the integrals and the
        running cost, if they flow.
    - `stages`: time, state and control at each stage.
    """

    origin: Float[Array, " n"]
    seconds: Scalar
    slopes: tuple[Array, ...]
    stages: tuple[Array, ...]

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


class Peaks(eqx.Module):
    """The largest values of what is watched, in each part of the interval.

    - `steps`: the substep each lies in.
    """

    values: Float[Array, "parts e"]
    steps: Array


class Course(eqx.Module):
    """What an interval ends with.

    - `growth`: of the integrals and the running cost; empty under the trapezoid rule.
    """

    ending: Float[Array, " n"]
    growth: Float[Array, " r"]
    peaks: Peaks


class Flow(eqx.Module):
    """What carries the state through an interval.

    - `substeps`: Runge-Kutta steps; may be traced.
    """

    problem: OptimalControlProblem
    discretization: Discretization
    substeps: Array | int

    @property
    def watch(self) -> Watch:
        """What is enforced on the way: nothing, if only the nodes matter."""
        if not self.discretization.between:
            return Watch((), (), 0)
        return Watch.of(self.problem)

    @property
    def gathers(self) -> bool:
        """Whether integrals grow along the flow."""
        return self.discretization.quadrature is Quadrature.FLOW

    def rates(self, t: Scalar, x: Array, u: Array) -> Float[Array, " w"]:
        """Of the states, then of the integrals and the running cost if they flow."""
        rate = self.problem.dynamics(t, x, u)
        if not self.gathers:
            return rate
        return jnp.concatenate([rate, self.problem.rates(t, x, u)])

    def step(
        self,
        span: Span,
        index: Array | int,
        x: Float[Array, " n"],
        *,
        reach: Array | float = 1.0,
        nudges: tuple[Array, ...] | None = None,
    ) -> Step:
        """One step; together they lead a share `reach` (0 to 1) into the interval.

        **Arguments:**

        - `nudges`: added to the rates at each stage.
        """
        share, place = jnp.asarray(reach) / self.substeps, x
        seconds = span.seconds * share
        slopes: list[Array] = []
        stages: list[Array] = []
        # All four in one loop pass: slower to compile than one by one, faster to run.
        for stage, node in enumerate(RK4_NODES):
            if stage:
                place = x + node * seconds * slopes[-1][: x.size]
            t, u = span.moment(self.discretization.hold, (index + node) * share)
            slope = self.rates(t, place, u)
            slopes.append(slope if nudges is None else slope + nudges[stage])
            stages.append(jnp.concatenate([t[None], place, u]))
        return Step(x, seconds, tuple(slopes), tuple(stages))

    def watched(
        self, span: Span, index: Array | int, step: Step, shares: Float[Array, " e"]
    ) -> Float[Array, " e"]:
        """What is watched, each quantity at its own share of a step."""
        watch, problem = self.watch, self.problem
        limits = watch.excess(
            problem, step.entries_within(watch.entries, shares[: watch.limits])
        )
        if not watch.path:
            return limits

        def one(entry, point):
            t, x, u = self.split(point)
            return problem.path(t, x, u)[entry]

        points = self.path_points(span, index, step, shares)
        path = jax.vmap(one)(jnp.arange(watch.path), points)
        return jnp.concatenate([limits, path])

    def path_points(
        self, span: Span, index: Array | int, step: Step, shares: Float[Array, " e"]
    ) -> Float[Array, "p q"]:
        """Time, state and control at which each path constraint is watched."""

        def at(share):
            fraction = (index + share) / self.substeps
            t, u = span.moment(self.discretization.hold, fraction)
            return jnp.concatenate([t[None], step.within(share), u])

        return jax.vmap(at)(shares[self.watch.limits :])

    def split(self, point: Float[Array, " q"]) -> tuple[Scalar, Array, Array]:
        """Time, state and control of a point."""
        n = self.problem.state_size
        return point[0], point[1 : 1 + n], point[1 + n :]

    def peak_range(self, index: Array | int) -> Float[Array, "2"]:
        """The shares of a step between which peaks are looked for."""
        ends = np.array([_NODE_SHARE, 1.0 - _NODE_SHARE]) * self.substeps
        return jnp.clip(jnp.asarray(ends) - index, 0.0, 1.0)

    def peak_shares(
        self, span: Span, index: Array | int, step: Step
    ) -> Float[Array, " e"]:
        """The share of a step at which each watched quantity is largest."""
        here, there = jax.lax.stop_gradient((span, step))
        return largest(
            lambda shares: self.watched(here, index, there, shares),
            self.peak_range(index),
            self.watch.size,
        )

    def over(self, span: Span, x: Float[Array, " n"]) -> Course:
        """All of an interval, from the state at its left node."""
        return jax.lax.fori_loop(
            0,
            self.substeps,
            lambda index, course: self.advance(span, index, course),
            self.start(x),
        )

    def start(self, x: Float[Array, " n"]) -> Course:
        """The course before the first step."""
        parts = self.discretization.between
        flat = jnp.full((parts, self.watch.size), -jnp.inf)
        sums = len(self.problem.integrals) + 1 if self.gathers else 0
        return Course(x, jnp.zeros(sums), Peaks(flat, jnp.zeros(flat.shape, int)))

    def advance(self, span: Span, index: Array, course: Course) -> Course:
        """The course after one more step."""
        step, peaks = self.step(span, index, course.ending), course.peaks
        if peaks.values.size:
            peaks = self._raised(span, index, step, peaks)
        return Course(step.ending, course.growth + step.growth, peaks)

    def _raised(self, span: Span, index: Array, step: Step, peaks: Peaks) -> Peaks:
        """The peaks with those of one more step."""
        shares = self.peak_shares(span, index, step)
        values = self.watched(span, index, step, shares)
        parts = self.discretization.between
        # Steps before and after the range that is looked at have no peak of their own.
        low, high = self.peak_range(index)
        here = (jnp.arange(parts) == index * parts // self.substeps) & (high > low)
        higher = here[:, None] & (values[None] > peaks.values)
        return Peaks(
            jnp.where(higher, values[None], peaks.values),
            jnp.where(higher, index, peaks.steps),
        )

    def along(
        self, span: Span, x: Float[Array, " n"], reach: Scalar
    ) -> Float[Array, " n"]:
        """The state a share `reach` (0 to 1) of an interval behind its left node."""
        return jax.lax.fori_loop(
            0,
            self.substeps,
            lambda index, x: self.step(span, index, x, reach=reach).ending,
            x,
        )
