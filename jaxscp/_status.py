"""`Status`: how a solve ended, as sentences."""

import equinox as eqx

from ._types import Array


class Status(eqx.Enumeration):
    """Why a solve stopped. `converged` is a success, and so is `converged_roughly`."""

    converged = (
        "Converged: the optimality conditions of the discrete problem hold to tolerance."
    )
    converged_roughly = (
        "Converged to a feasible point that no step improves; the optimality conditions "
        "do not hold to tolerance, or are not known. If they should hold, raise "
        "ProximalSCP's max_polish."
    )
    iteration_limit = (
        "The iteration limit was reached before convergence. Raise max_iterations, or "
        "start from a better guess; stiff dynamics need Discretization(min_substeps=...)."
    )
    subproblem_infeasible = (
        "A convex subproblem has no solution: limits contradict each other even with "
        "virtual control. Check the limits, boundary states and final time."
    )
    subproblem_failed = (
        "The QP solver failed on a subproblem. Check that the problem's functions are "
        "smooth at the guess and that its scales are right; stiff dynamics need "
        "Discretization(min_substeps=...)."
    )
    virtual_control_remains = (
        "The dynamics cannot be met within the limits from this guess: virtual control "
        "remains. Widen the limits or the final time, or start from another guess."
    )
    virtual_buffer_remains = (
        "A constraint cannot be met from this guess: a virtual buffer remains. Relax "
        "the constraint, or start from a guess that comes closer to meeting it."
    )
    stalled = (
        "No step improves a feasible point that is far from satisfying the optimality "
        "conditions, as happens where limits contradict or repeat each other. Leave out "
        "those that others imply, check the scales, or start from another guess."
    )
    trust_region_collapsed = (
        "The trust region collapsed: no step improves the penalized cost any more. "
        "Check that dynamics, costs and constraints are differentiable on the way."
    )
    non_finite = (
        "A function of the problem returned NaN or infinity. Guard it against "
        "singular points (division by zero, powers, roots, arcsines)."
    )


def has_converged(status: Status) -> Array:
    """Whether a solve ended at a feasible stationary point."""
    return (status == Status.converged) | (status == Status.converged_roughly)


def sentence_of(status: Status) -> str:
    """The sentence of a status that is a number already, not traced."""
    return str(Status[status])  # type: ignore[misc]


def name_of(status: Status) -> str:
    """The member's name, as scripts compare it: "converged", "iteration_limit", ..."""
    return next(
        name for name, item in Status._name_to_item.items() if bool(status == item)
    )
