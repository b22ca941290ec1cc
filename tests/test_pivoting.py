"""Which of the limits in the wrong change from one try to the next."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, strategies as st

from jaxscp._peaks import Watch
from jaxscp._per_limit import PerLimit
from jaxscp._pivoting import pivoted
from jaxscp._transcription import Variables

NODES = 12
# The first of two entries has a lower limit, both have an upper one; one path constraint.
WATCH = Watch((0,), (0, 1), 1)
LOWER, UPPER, SECOND, PATH = range(WATCH.size)

# Where in a `PerLimit`: what of it, node or interval, entry or row.
Place = tuple[str, int, int]
WHERE = {
    "state": lambda per: per.variables.states,
    "path": lambda per: per.path,
    "between": lambda per: per.between,
    "control": lambda per: per.variables.controls,
}


def state(node: int, entry: int = 0) -> Place:
    return "state", node, entry


def path(node: int) -> Place:
    return "path", node, 0


def between(interval: int, row: int = UPPER, part: int = 0) -> Place:
    return "between", interval, part * WATCH.size + row


def filled(parts: int, values: dict[Place, float]) -> PerLimit:
    """Of two states, one control and one integral; zero but for these."""
    variables = Variables(jnp.zeros((NODES, 2)), jnp.zeros((NODES, 1)), jnp.zeros(()))
    peaks = jnp.zeros((NODES - 1, parts * WATCH.size))
    per = PerLimit(variables, jnp.zeros((NODES, 1)), peaks, jnp.zeros(1))
    for (kind, *index), value in values.items():
        where = WHERE[kind]
        per = eqx.tree_at(where, per, where(per).at[tuple(index)].set(value))
    return per


def changed(wrongs: dict[Place, float], parts: int = 1) -> set[Place]:
    """Which of what is in the wrong changes: what is violated, if positive, becomes
    active; what has a wrong multiplier, if negative, ceases to be.
    """
    before = {place: float(wrong < 0.0) for place, wrong in wrongs.items()}
    wanted = {place: float(wrong > 0.0) for place, wrong in wrongs.items()}
    sides, towards, by = (filled(parts, each) for each in (before, wanted, wrongs))
    after = pivoted(sides, towards, by, WATCH)
    now = {place: float(WHERE[place[0]](after)[place[1:]]) for place in wrongs}
    for one, other in zip(
        *map(jax.tree.leaves, (after, filled(parts, now))), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    return {place for place in wrongs if now[place] != before[place]}


def test_of_neighbours_the_most_violated_becomes_active():
    peak = between(5)
    assert changed({state(5): 0.2, peak: 0.3, state(6): 0.1}) == {peak}
    assert changed({state(5): 0.2, between(4): 0.3}) == {between(4)}
    assert changed({path(3): 0.2, path(4): 0.1, between(3, PATH): 0.1}) == {path(3)}


def test_of_neighbours_the_most_wrong_multiplier_goes():
    peak = between(5)
    assert changed({state(5): -0.2, peak: -3.0, state(7): -1.0}) == {peak}


def test_what_is_dropped_comes_first():
    assert changed({state(5): 9.0, between(5): -1e-3}) == {between(5)}
    # An entry's other limit is as near.
    assert changed({between(5, LOWER): 9.0, between(6): -1e-3}) == {between(6)}


def test_neighbours_are_two_intervals_apart():
    assert changed({state(3): 0.2, state(5): 0.1}) == {state(3)}
    for far in (state(6), between(5), state(NODES - 1)):
        assert changed({state(3): 0.2, far: 0.1}) == {state(3), far}


def test_other_quantities_are_no_neighbours():
    places = {state(5, 0): 0.2, state(5, 1): 0.1, path(5): 0.01, between(5, PATH): 0.001}
    assert changed(places) == {state(5, 0), state(5, 1), path(5)}
    assert len(changed({between(5): -0.2, between(5, SECOND): 0.1})) == 2


def test_controls_change_together():
    arc = {("control", node, 0): 0.1 * (node + 1) for node in range(NODES)}
    assert changed(arc) == set(arc)


def test_parts_of_an_interval_follow_each_other():
    first, last = between(5), between(5, part=1)
    assert changed({first: 0.2, last: 0.3}, parts=2) == {last}
    # Two intervals behind the node, and a little more.
    assert changed({state(6): 0.3, between(4, part=0): 0.2}, parts=2) == {state(6)}
    far = between(3, part=1)
    assert changed({state(6): 0.3, far: 0.2}, parts=2) == {state(6), far}


def test_without_any_between_the_nodes():
    wrongs = {state(5): 0.2, state(6): 0.1, path(6): 0.1}
    assert changed(wrongs, parts=0) == {state(5), path(6)}


places = st.one_of(
    st.builds(state, st.integers(0, NODES - 1), st.integers(0, 1)),
    st.builds(path, st.integers(0, NODES - 1)),
    st.builds(between, st.integers(0, NODES - 2), st.integers(0, WATCH.size - 1)),
)
amounts = st.floats(1e-3, 10.0).flatmap(lambda size: st.sampled_from([size, -size]))


@given(st.dictionaries(places, amounts, min_size=1))
def test_as_long_as_any_is_wrong_one_changes(wrongs):
    """The most wrong multiplier, or else the largest violation."""
    least = min(wrongs.values())
    first = least if least < 0.0 else max(wrongs.values())
    assert any(wrongs[place] == first for place in changed(wrongs))
