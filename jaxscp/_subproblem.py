"""The convex subproblem as a JAX function: scaled blocks in, a step out."""

import dataclasses
import functools
import hashlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ._constraints import integral_limits
from ._damping import Damping
from ._host import call_on_host
from ._layout import Structure
from ._model import Model
from ._per_constraint import PerConstraint
from ._qp import PIQP
from ._scaling import Scaling
from ._subproblem_data import Limits, Outline, Prices, SubproblemData
from ._subproblem_solver import subproblem_solver
from ._transcription import Transcription, Variables
from ._types import Array, Float, Scalar


class Effort(eqx.Module):
    """How a subproblem went.

    - `solved`, `infeasible`: truth values of the last QP.
    - `relaxed`: whether it had virtual control.
    - `primal_residual`, `dual_residual`: of the last QP, as PIQP reports them.
    - `solves`: QPs solved. `iterations`: interior-point iterations in all of them.
        `seconds`: time in PIQP.
    """

    solved: Array
    infeasible: Array
    relaxed: Array
    primal_residual: Scalar
    dual_residual: Scalar
    solves: Array
    iterations: Array
    seconds: Scalar

    @classmethod
    def of_linear_system(cls) -> "Effort":
        """Of a subproblem that took no QP."""
        zero, none = jnp.zeros(()), jnp.zeros((), int)
        yes = jnp.array(True)
        return cls(yes, ~yes, ~yes, zero, zero, none, none, zero)

    def after(self, earlier: "Effort") -> "Effort":
        """This outcome, with what an earlier subproblem took added."""
        return Effort(
            self.solved,
            self.infeasible,
            self.relaxed,
            self.primal_residual,
            self.dual_residual,
            self.solves + earlier.solves,
            self.iterations + earlier.iterations,
            self.seconds + earlier.seconds,
        )


class SubproblemSolution(eqx.Module):
    """Step and multipliers of a subproblem, scaled.

    - `state`, `control`, `final_time`: multipliers of the variables' limits, upper minus
        lower; of equalities where the variable is fixed.
    """

    step: Variables
    multipliers: PerConstraint
    state: Float[Array, "N n"]
    control: Float[Array, "M m"]
    final_time: Scalar
    effort: Effort

    @classmethod
    def none(cls, structure: Structure) -> "SubproblemSolution":
        """Of a subproblem not solved yet: no step, no multipliers, no effort."""
        nodes, n = structure.nodes, structure.state_size
        states = jnp.zeros((nodes, n))
        controls = jnp.zeros((structure.control_nodes, structure.control_size))
        zero, watch = jnp.zeros(()), structure.watch
        multipliers = PerConstraint(
            dynamics=states[1:],
            path=jnp.zeros((nodes, watch.path)),
            between=jnp.zeros((nodes - 1, structure.parts * watch.size)),
            integral=jnp.zeros(structure.integrals),
        )
        return cls(
            step=Variables(states, controls, zero),
            multipliers=multipliers,
            state=states,
            control=controls,
            final_time=zero,
            effort=Effort.of_linear_system(),
        )


def step_limits(
    transcription: Transcription, scaling: Scaling, reference: Variables
) -> Limits:
    """How far a scaled step may go from a reference."""
    problem = transcription.problem

    def relative(limits, origin, scale):
        *limits, scale = (jnp.broadcast_to(x, origin.shape) for x in (*limits, scale))
        return tuple((limit - origin) / scale for limit in limits)

    time = reference.final_time[None]
    return Limits(
        state=relative(transcription.state_limits, reference.states, scaling.state),
        control=relative(problem.control.ends, reference.controls, scaling.control),
        time=relative(problem.final_time.ends, time, scaling.time),
        integral=integral_limits(transcription, scaling),
    )


def solve_subproblem(
    structure: Structure,
    settings: PIQP,
    model: Model,
    damping: Damping,
    prices: Prices,
    limits: Limits,
) -> SubproblemSolution:
    """The best step of a damped model; may be called under `jax.jit`.

    Where the structure is not relaxed and the dynamics cannot be met within the limits,
    or only at far more than the price of virtual control, the relaxed one is solved
    instead, if the prices allow it.
    """
    data = SubproblemData.of(model, damping, prices, limits)
    answer, unravel = ravel_pytree(SubproblemSolution.none(structure))
    # One vector each way: an array passed to the host costs as much as a thousand of
    # its numbers.
    told = (structure, settings, Outline.of(data))
    vector = call_on_host(
        f"jaxscp_subproblem_{hashlib.sha256(repr(told).encode()).hexdigest()}",
        functools.partial(_on_host, *told),
        answer.size,
        jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(data)]),
    )
    return unravel(vector)


def _on_host(
    structure: Structure, settings: PIQP, outline: Outline, numbers: np.ndarray
) -> np.ndarray:
    solver = subproblem_solver(structure, settings, outline)
    answer, effort = solver(numbers)
    if not solver.would_relax(numbers, answer):
        return solver.read(answer, effort)
    with_virtual = dataclasses.replace(structure, relaxed=True)
    relaxed = subproblem_solver(with_virtual, settings, outline)
    answer, more = relaxed(numbers)
    return relaxed.read(answer, effort + more)
