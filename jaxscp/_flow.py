"""The flow of one interval: classical Runge-Kutta steps of equal length."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._discretization import Discretization, Quadrature
from ._loop import repeat, sequence
from ._peaks import Watch, largest, moving
from ._problem import OptimalControlProblem
from ._sines import sines_once
from ._step import RK4_NODES, Span, Step
from ._tree import constant
from ._types import Array, Float, Scalar

# No peak is looked for nearer to a node, in shares of an interval: the node itself is
# enforced, and at a fixed one a limit just met would have no gradient.
_NODE_SHARE = 0.02


class Peaks(eqx.Module):
    """The largest values of what is watched, in each part of the interval.

    - `steps`: the substep each lies in. `shares`: and where in that.
    """

    values: Float[Array, "parts e"]
    steps: Array
    shares: Float[Array, "parts e"]


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
    - `reversible`: whether derivatives are taken backwards through it, by whatever it
        depends on, and of any order: slower to evaluate.
    - `unrolled`: whether the stages of a step are written out: slower to compile, faster
        where all tangents are carried through.
    """

    problem: OptimalControlProblem
    discretization: Discretization
    substeps: Array | int
    reversible: bool = eqx.field(static=True, default=False)
    unrolled: bool = eqx.field(static=True, default=False)

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

    @property
    def sums(self) -> int:
        """How many integrals grow along the flow, the running cost among them."""
        return len(self.problem.integrals) + 1 if self.gathers else 0

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
        nudges: Float[Array, "4 w"] | None = None,
    ) -> Step:
        """One step; together they lead a share `reach` (0 to 1) into the interval.

        **Arguments:**

        - `nudges`: added to the rates at each stage.
        """
        share = jnp.asarray(reach) / self.substeps
        seconds = span.seconds * share

        def stage(slope: Array, told: tuple) -> tuple[Array, tuple[Array, Array]]:
            node, nudge = told
            place = x + node * seconds * slope[: x.size]
            t, u = span.moment(self.discretization.hold, (index + node) * share)
            slope = sines_once(self.rates)(t, place, u) + nudge
            return slope, (slope, jnp.concatenate([t[None], place, u]))

        still = jnp.zeros((len(RK4_NODES), x.size + self.sums))
        told = (jnp.asarray(RK4_NODES), still if nudges is None else nudges)
        slopes, stages = sequence(stage, still[0], told, unrolled=self.unrolled)
        return Step(x, seconds, slopes, stages)

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
        flow, here, there = constant((self, span, step))
        shares = largest(
            lambda shares: flow.watched(here, index, there, shares),
            self.peak_range(index),
            self.watch.size,
        )
        if not self.reversible:
            return shares
        return moving(lambda shares: self.watched(span, index, step, shares), shares)

    def over(self, span: Span, x: Float[Array, " n"]) -> Course:
        """All of an interval, from the state at its left node."""
        advance = functools.partial(self.advance, span)
        if self.reversible:
            most = self.discretization.max_substeps
            return repeat(self.substeps, most, advance, self.start(x))
        return jax.lax.fori_loop(0, self.substeps, advance, self.start(x))

    def start(self, x: Float[Array, " n"]) -> Course:
        """The course before the first step."""
        parts = self.discretization.between
        flat = jnp.full((parts, self.watch.size), -jnp.inf)
        peaks = Peaks(flat, jnp.zeros(flat.shape, int), jnp.zeros(flat.shape))
        return Course(x, jnp.zeros(self.sums), peaks)

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
            jnp.where(higher, jax.lax.stop_gradient(shares)[None], peaks.shares),
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
