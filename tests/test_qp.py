"""Quadratic programs solved by hand, and the pattern their matrices are filled by."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from scipy.sparse import coo_matrix, csc_matrix

from jaxscp._layout import Entries
from jaxscp._qp import PIQP, QP, Workspace

INF = np.inf
every_factorization = pytest.mark.parametrize(
    "multistage", [True, False], ids=("stages", "general")
)


def qp(P, c, A=(), b=(), G=(), h=(), lower=-INF, upper=INF) -> QP:
    """A QP from dense rows; `P` in full."""
    c = np.array(c, float)

    def rows(matrix):
        return csc_matrix(np.reshape(np.array(matrix, float), (-1, c.size)))

    return QP(
        P=csc_matrix(np.triu(np.array(P, float))),
        c=c,
        A=rows(A),
        b=np.array(b, float),
        G=rows(G),
        h=np.array(h, float),
        lower=np.broadcast_to(lower, c.shape).astype(float),
        upper=np.broadcast_to(upper, c.shape).astype(float),
    )


@dataclasses.dataclass
class ByHand:
    """A QP with its solution: Pz + c + A'y + G'w + bound = 0."""

    qp: QP
    z: tuple
    y: tuple = ()
    w: tuple = ()
    bound: tuple = (0, 0)


BY_HAND = {
    # (x^2 + y^2) / 2 on x + y = 2: both are 1 by symmetry, and 1 + y = 0.
    "equality": ByHand(qp(np.eye(2), [0, 0], A=[[1, 1]], b=[2]), z=(1, 1), y=(-1,)),
    # The point of x + y <= 1 next to (2, 1) is (1, 0), along (1, 1): w = 1. The second
    # row, x - y <= 3, is not active.
    "inequality": ByHand(
        qp(np.eye(2), [-2, -1], G=[[1, 1], [1, -1]], h=[1, 3]), z=(1, 0), w=(1, 0)
    ),
    # The point of the unit box next to (2, -3) is (1, 0): pushed back by 1 from its
    # upper limit, by 3 from its lower one.
    "box": ByHand(qp(np.eye(2), [-2, 3], lower=0.0, upper=1.0), z=(1, 0), bound=(1, -3)),
    # Half of [2 1; 1 2] in x, y and of z^2, on x + y + z = 3, x - y <= -1, z <= 1/2.
    # All three active: x + y = 5/2, hence x = 3/4, y = 7/4, z = 1/2. Rows x and y of the
    # gradient: 13/4 + y + w = 0, 17/4 + y - w = 0, hence y = -15/4, w = 1/2. Row z:
    # 1/2 - 15/4 + bound = 0.
    "mixed": ByHand(
        qp(
            [[2, 1, 0], [1, 2, 0], [0, 0, 1]],
            [0, 0, 0],
            A=[[1, 1, 1]],
            b=[3],
            G=[[1, -1, 0]],
            h=[-1],
            lower=[-INF, 0.0, -INF],
            upper=[INF, INF, 0.5],
        ),
        z=(0.75, 1.75, 0.5),
        y=(-3.75,),
        w=(0.5,),
        bound=(0, 0, 3.25),
    ),
}
every_example = pytest.mark.parametrize("name", BY_HAND)


def check(solution, known: ByHand):
    assert solution.solved
    assert not solution.infeasible
    assert_allclose(solution.z, known.z, atol=1e-7)
    assert_allclose(solution.y, known.y, atol=1e-7)
    assert_allclose(solution.w, known.w, atol=1e-7)
    assert_allclose(solution.bound, known.bound, atol=1e-7)
    assert 0 < solution.iterations < 30
    assert 0.0 < solution.seconds < 1.0
    assert max(solution.primal_residual, solution.dual_residual) < 1e-7


@every_factorization
@every_example
def test_by_hand(name, multistage):
    known = BY_HAND[name]
    check(Workspace(PIQP(), multistage=multistage).solve(known.qp), known)


@every_factorization
def test_infeasible(multistage):
    # x + y = 3 with both at most 1.
    impossible = qp(np.eye(2), [0, 0], A=[[1, 1]], b=[3], lower=0.0, upper=1.0)
    workspace = Workspace(PIQP(), multistage=multistage)
    solution = workspace.solve(impossible)
    assert solution.infeasible
    assert not solution.solved
    # The next one, x + y = 1, is none the worse for it.
    possible = dataclasses.replace(impossible, b=np.ones(1))
    check(workspace.solve(possible), ByHand(possible, z=(0.5, 0.5), y=(-0.5,)))


def test_too_few_iterations():
    solution = Workspace(PIQP(max_iterations=1), multistage=False).solve(
        BY_HAND["mixed"].qp
    )
    assert not solution.solved
    assert not solution.infeasible
    assert solution.iterations == 1


@every_factorization
def test_new_numbers_after_the_setup(multistage):
    workspace = Workspace(PIQP(), multistage=multistage)
    old = BY_HAND["mixed"].qp
    check(workspace.solve(old), BY_HAND["mixed"])
    # Every number is another one; the limits stay where they are finite.
    new = QP(
        P=3.0 * old.P,
        c=np.array([1.0, -2.0, 0.5]),
        A=-2.0 * old.A,
        b=np.array([-4.0]),
        G=0.5 * old.G,
        h=np.array([-0.2]),
        lower=np.array([-INF, 0.3, -INF]),
        upper=np.array([INF, INF, 0.4]),
    )
    fresh = Workspace(PIQP(), multistage=multistage).solve(new)
    updated = workspace.solve(new)
    assert fresh.solved
    assert updated.solved
    for name in ("z", "y", "w", "bound"):
        np.testing.assert_array_equal(getattr(updated, name), getattr(fresh, name))
    assert np.max(np.abs(updated.z - BY_HAND["mixed"].z)) > 0.1
    # The first answer again: nothing of the second is left behind.
    check(workspace.solve(old), BY_HAND["mixed"])


@every_factorization
def test_limits_come_and_go(multistage):
    """Which of them are finite is no part of the pattern."""
    workspace = Workspace(PIQP(), multistage=multistage)
    box, wish = BY_HAND["box"].qp, np.array([2.0, -3.0])
    for lower, upper in (
        ([0.0, 0.0], [1.0, 1.0]),
        ([-INF, -INF], [INF, INF]),
        ([-INF, -1.0], [0.5, INF]),
        ([0.0, -INF], [INF, 1.0]),
    ):
        limits = {"lower": np.array(lower), "upper": np.array(upper)}
        nearest = np.clip(wish, lower, upper)
        known = ByHand(
            dataclasses.replace(box, **limits), tuple(nearest), bound=wish - nearest
        )
        check(workspace.solve(known.qp), known)


@pytest.mark.parametrize("part", ["P", "A", "G", "c", "b", "h"])
def test_broken_numbers_are_not_solved(part):
    known = BY_HAND["mixed"]
    broken = dataclasses.replace(known.qp, **{part: getattr(known.qp, part).copy()})
    values = getattr(broken, part)
    (values.data if part in "PAG" else values)[0] = np.nan
    assert known.qp.is_finite
    assert not broken.is_finite
    workspace = Workspace(PIQP(), multistage=False)
    for _ in range(2):  # before the setup, and after it
        solution = workspace.solve(broken)
        assert not solution.solved
        assert not solution.infeasible
        assert solution.iterations == 0
        for vector, size in (
            (solution.z, 3),
            (solution.bound, 3),
            (solution.y, 1),
            (solution.w, 1),
        ):
            assert vector.shape == (size,)
            assert np.isnan(vector).all()
        check(workspace.solve(known.qp), known)


@st.composite
def matrices(draw):
    """Rows and columns of distinct entries in any order, their shape, and values."""
    height, width = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    place = st.tuples(st.integers(0, height - 1), st.integers(0, width - 1))
    places = draw(st.lists(place, unique=True, max_size=height * width))
    rows, columns = np.array(places, int).reshape(-1, 2).T
    numbers = st.lists(st.floats(-9, 9), min_size=len(places), max_size=len(places))
    return rows, columns, (height, width), [np.array(draw(numbers)) for _ in range(2)]


def entries_of(rows, columns, shape, values) -> Entries:
    """Entry by entry, after as many rows as the matrix has."""
    entries = Entries()
    entries.new_rows(shape[0])
    for row, column, value in zip(rows, columns, values, strict=True):
        entries.add(row, column, value)
    return entries


@given(matrices())
def test_entries_keep_their_places(matrix):
    rows, columns, shape, (values, others) = matrix
    for numbers in (values, others):
        built = entries_of(rows, columns, shape, numbers).matrix(shape[1])
        reference = coo_matrix((numbers, (rows, columns)), shape=shape)
        np.testing.assert_array_equal(built.toarray(), reference.toarray())
        # The solver takes over the structure: sorted, and zeros belong to it.
        built.check_format()
        assert built.has_canonical_format
        assert built.nnz == numbers.size


def test_a_qp_in_one_vector_follows_it():
    program = QP(
        *(csc_matrix(np.eye(2)), np.array([1.0, 2.0])),
        *(csc_matrix([[1.0, 1.0]]), np.array([3.0])),
        *(csc_matrix([[0.0, 4.0]]), np.array([5.0])),
        *(np.array([-6.0, -np.inf]), np.array([7.0, np.inf])),
    )
    whole = program.in_one_vector()
    whole *= 2.0
    np.testing.assert_array_equal(program.P.toarray(), 2.0 * np.eye(2))
    np.testing.assert_array_equal(program.A.toarray(), [[2.0, 2.0]])
    np.testing.assert_array_equal(program.G.toarray(), [[0.0, 8.0]])
    np.testing.assert_array_equal(program.c, [2.0, 4.0])
    np.testing.assert_array_equal(program.b, [6.0])
    np.testing.assert_array_equal(program.h, [10.0])
    np.testing.assert_array_equal(program.lower, [-12.0, -np.inf])
    np.testing.assert_array_equal(program.upper, [14.0, np.inf])


@given(matrices(), st.data())
def test_an_entry_must_not_appear_twice(matrix, data):
    rows, columns, shape, _ = matrix
    if not rows.size:
        return
    again = data.draw(st.integers(0, rows.size - 1))
    at = data.draw(st.integers(0, rows.size))
    with pytest.raises(ValueError, match="an entry appears twice"):
        entries_of(
            np.insert(rows, at, rows[again]),
            np.insert(columns, at, columns[again]),
            shape,
            np.ones(rows.size + 1),
        ).matrix(shape[1])
