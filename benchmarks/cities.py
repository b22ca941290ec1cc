"""Random missions of which each can be flown."""

import numpy as np

from jaxscp.missions import BITS_PER_MEGABYTE, GuessPlan, Mission
from jaxscp.models import Channel, Cylinders, Limits, Quadrotor

# East and north from 0 to SIZE, altitudes of both ends, height of the antenna [m].
SIZE, ALTITUDES, ANTENNA = 600.0, (10.0, 120.0), (0.0, 30.0)
# Start and goal are at least so far apart [m].
APART = 100.0
SAFE_DISTANCES = (15.0, 50.0)
MOST_BUILDINGS = 6
# Free space around buildings: to each other, and to places the vehicle must reach [m].
PASSAGE = 10.0
MEGABYTES = (10.0, 60.0)
SNR_CONSTANT = 1e6
FLOOR = 10.0


def random_mission(seed: int, index: int) -> Mission:
    """Mission number `index` of a seed, whichever others are drawn.

    Numbers count through 0 to 6 buildings, seven missions without data, then seven with.
    Every mission can be flown:

    - Circles that do not touch leave the plane in one piece. The safe circles keep 10 m
        from each other, from start and goal, and from the place above the antenna: a
        passage 10 m wide leads everywhere, and the vehicle may fly it as slowly as it
        must, for up to 2000 s.
    - 30 m above the antenna 8.6 Mbit/s arrive: all data are sent in a minute there.
    """
    generator = np.random.default_rng([seed, index])
    needs_data = index // (MOST_BUILDINGS + 1) % 2 == 1
    start, goal = _ends(generator)
    station = _place(generator, ANTENNA)
    places = [start, station, goal] if needs_data else [start, goal]
    obstacles = _buildings(generator, index % (MOST_BUILDINGS + 1), np.array(places))
    amount = generator.uniform(*MEGABYTES) * BITS_PER_MEGABYTE
    return Mission(
        # All have one name: to JAX, missions that differ in it differ in structure.
        "random",
        vehicle=Quadrotor(),
        channel=Channel(ground_station=station, snr_constant=SNR_CONSTANT),
        obstacles=obstacles,
        limits=Limits(),
        start=start,
        goal=goal,
        altitude_floor=FLOOR if needs_data else None,
        data_required=amount if needs_data else None,
        plan=GuessPlan(),
    )


def _place(generator: np.random.Generator, heights: tuple[float, float]) -> np.ndarray:
    """A position anywhere in the city."""
    return np.array([*generator.uniform(0.0, SIZE, 2), generator.uniform(*heights)])


def _ends(generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Start and goal."""
    while True:
        start, goal = _place(generator, ALTITUDES), _place(generator, ALTITUDES)
        if np.hypot(*(goal - start)[:2]) >= APART:
            return start, goal


def _buildings(
    generator: np.random.Generator, count: int, places: np.ndarray
) -> Cylinders:
    """Buildings in nobody's place; half of those drawn stand where the way leads."""
    kept = places[:, :2]
    centers, radii = np.zeros((0, 2)), np.zeros(0)
    while radii.size < count:
        radius = generator.uniform(*SAFE_DISTANCES)
        center = generator.uniform(0.0, SIZE, 2)
        if generator.random() < 0.5:
            leg = generator.integers(len(kept) - 1)
            share, aside = generator.random(), generator.uniform(-radius, radius, 2)
            center = kept[leg] + share * (kept[leg + 1] - kept[leg]) + aside
        to_places = np.hypot(*(kept - center).T) - radius
        to_others = np.hypot(*(centers - center).T) - radii - radius
        if min(to_places.min(), to_others.min(initial=np.inf)) >= PASSAGE:
            centers, radii = np.vstack([centers, center]), np.append(radii, radius)
    return Cylinders(centers, radii)
