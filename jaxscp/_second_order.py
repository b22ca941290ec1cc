"""Second derivatives of one interval, contracted with multipliers.

Exact for the discrete flow. What an interval ends with is linear in its state and in the
step's length h times the rates at each Runge-Kutta stage. With the multipliers kappa of
the rates, from an adjoint sweep over the steps, its Hessian is therefore a sum over
stages,

    P' (kappa . rates)'' P + (dh / h) (kappa . d rates)' + (kappa . d rates) (dh / h)',

where P are the tangents of the stage's time, state and control. A peak between the nodes
adds the curvature of the path constraint there and, as its moment s moves along,
-(dg_s)(dg_s)' / g_ss, because g_s = 0.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from ._flow import Flow
from ._nonlinear import Nonlinearity
from ._peaks import derivatives, inner_peaks
from ._sines import sines_once
from ._step import Span, Step
from ._types import Array, Float, Scalar


def interval_hessian(
    flow: Flow,
    span: Span,
    x: Float[Array, " n"],
    weights: Float[Array, " w"],
    pushes: Float[Array, "parts e"],
) -> Float[Array, "v v"]:
    """Hessian of a weighted sum of what one interval ends with.

    **Arguments:**

    - `weights`: of the state at the end, then of the growth of integrals and cost if
        they flow. `pushes`: of the peaks of what is watched.

    **Returns:** by v = (x, control at the left, the one at the right if the hold knows
    it, final time).
    """
    variables = _Variables(flow, span)
    v, n = variables.pack(span, x), x.size

    def forward(index, carry):
        course, starts = carry
        starts = starts.at[index].set(course.ending)
        return flow.advance(span, index, course), starts

    starts = jnp.zeros((flow.discretization.max_substeps, n))
    course, starts = jax.lax.fori_loop(0, flow.substeps, forward, (flow.start(x), starts))

    def backward(count, carry):
        costate, hessian = carry
        index = flow.substeps - 1 - count
        here = course.peaks.steps == index
        # No two parts have a peak in the same step.
        push = jnp.sum(jnp.where(here, pushes, 0.0), axis=0)
        shares = jnp.sum(jnp.where(here, course.peaks.shares, 0.0), axis=0)
        own = weights.at[:n].set(costate)
        one = _StepHessian(flow, variables, index, own, push, shares)
        gradient, curved, slopes = one(v.at[:n].set(starts[index]))
        # Controls and flight time pass through every step unchanged.
        through = jnp.concatenate([slopes, jnp.eye(v.size)[n:]])
        return gradient[:n], through.T @ hessian @ through + curved

    nothing = jnp.zeros((v.size, v.size))
    _, hessian = jax.lax.fori_loop(0, flow.substeps, backward, (weights[:n], nothing))
    return hessian


class _Variables(eqx.Module):
    """What an interval depends on, as one vector."""

    flow: Flow
    span: Span

    def pack(self, span: Span, x: Array) -> Float[Array, " v"]:
        held = [span.left]
        if self.flow.discretization.holds_right:
            held.append(span.right)
        return jnp.concatenate([x, *held, span.final_time[None]])

    def unpack(self, v: Float[Array, " v"]) -> tuple[Span, Float[Array, " n"]]:
        n, m = self.flow.problem.state_size, self.flow.problem.control_size
        both = self.flow.discretization.holds_right
        right = v[n + m : n + 2 * m] if both else self.span.right
        span = Span(self.span.start, self.span.width, v[n : n + m], right, v[-1])
        return span, v[:n]


class _StepHessian(eqx.Module):
    """Gradient and Hessian of a weighted sum of what one step ends with.

    - `weights`: of the state and the growth at its end.
    - `push`: of what is watched. `shares`: of the step, where each peak lies.
    """

    flow: Flow
    variables: _Variables
    index: Array
    weights: Float[Array, " w"]
    push: Float[Array, " e"]
    shares: Float[Array, " e"]

    def __call__(self, v: Float[Array, " v"]) -> tuple[Array, Array, Array]:
        """Gradient, Hessian, and the Jacobian of the state at the end."""
        flow, (span, x) = self.flow, self.variables.unpack(v)
        step = flow.step(span, self.index, x)
        none = jnp.zeros_like(step.slopes)
        gradient, kappa = jax.grad(self._sum, argnums=(0, 1))(v, none)

        def followed(v):
            span, x = self.variables.unpack(v)
            step = flow.step(span, self.index, x)
            points, slopes = step.stages, jnp.zeros(0)
            if self.push.size:
                inner = flow.path_points(span, self.index, step, self.shares)
                points = jnp.concatenate([points, inner])
                slopes = self._slope(span, step)
            return step.ending, points, jnp.vdot(kappa, step.slopes), slopes

        (_, points, _, _), (by_v, tangents, moved, tilts) = jax.vmap(
            lambda tangent: jax.jvp(followed, (v,), (tangent,)),
            out_axes=((None,) * 4, -1),
        )(jnp.eye(v.size))
        hessian = self._of_stages(kappa, points[:4], tangents[:4])
        # The step's length depends on the flight time alone: dh / h = dT / T.
        mixed = jnp.outer(jnp.zeros_like(v).at[-1].set(1.0 / v[-1]), moved)
        hessian += mixed + mixed.T
        if self.push.size:
            if self.flow.watch.path:
                hessian += self._of_peaks(points[4:], tangents[4:])
            hessian += self._of_moments(span, step, tilts)
        return gradient, hessian, by_v

    def _sum(self, v, nudges) -> Scalar:
        span, x = self.variables.unpack(v)
        step = self.flow.step(span, self.index, x, nudges=nudges)
        total = self.weights[: x.size] @ step.ending
        if self.flow.gathers:
            total += self.weights[x.size :] @ step.growth
        if self.push.size:
            total += self.push @ self.flow.watched(span, self.index, step, self.shares)
        return total

    def _slope(self, span: Span, step: Step) -> Float[Array, " e"]:
        """Derivative of each watched quantity by its share of the step."""
        return jax.jvp(
            lambda shares: self.flow.watched(span, self.index, step, shares),
            (self.shares,),
            (jnp.ones_like(self.shares),),
        )[1]

    def _of_stages(self, kappa, points, tangents) -> Float[Array, "v v"]:
        def rates(point):
            return self.flow.rates(*self.flow.split(point))

        bent = Nonlinearity.of(rates, points.shape[1])

        def curved(point, kappa):
            return bent.hessian(lambda at: kappa @ sines_once(rates)(at), point)

        return _summed(jax.vmap(curved)(points, kappa), tangents[:, bent.entries])

    def _of_peaks(self, points, tangents) -> Float[Array, "v v"]:
        pushes = self.push[self.flow.watch.limits :]

        def path(point):
            return self.flow.problem.path(*self.flow.split(point))

        bent = Nonlinearity.of(path, points.shape[1])

        def curved(point, entry, push):
            return bent.hessian(lambda at: push * path(at)[entry], point)

        hessians = jax.vmap(curved)(points, jnp.arange(pushes.size), pushes)
        return _summed(hessians, tangents[:, bent.entries])

    def _of_moments(self, span, step, tilts) -> Float[Array, "v v"]:
        slope, bend = derivatives(
            lambda shares: self.flow.watched(span, self.index, step, shares), self.shares
        )
        inner = inner_peaks(slope, bend)
        gain = jnp.where(inner, -self.push / jnp.where(inner, bend, 1.0), 0.0)
        return jnp.einsum("cw,c,cv->wv", tilts, gain, tilts)


def _summed(hessians: Float[Array, "s e e"], tangents: Float[Array, "s e v"]) -> Array:
    """Curvatures at several points, seen along what they move by."""
    # The few entries one after the other, all columns at once: a matrix product for each
    # point takes longer.
    bent = jnp.zeros_like(tangents)
    for entry in range(tangents.shape[1]):
        bent += hessians[:, :, entry, None] * tangents[:, None, entry]
    return jnp.einsum("sew,sev->wv", tangents, bent)
