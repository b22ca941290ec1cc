"""Random missions of which each can be flown."""

import numpy as np

from jaxscp.missions import BITS_PER_MEGABYTE, GuessPlan, Mission
from jaxscp.models import Channel, Cylinders, Limits, Quadrotor

# East and north from 0 to SIZE, heights of the antenna, and of both ends at most [m].
SIZE, ANTENNA, CEILING = 600.0, (0.0, 30.0), 120.0
# Start and goal are at least so far apart [m].
APART = 100.0
BUILDINGS = (0, 2, 4, 6)
SAFE_DISTANCES = (15.0, 50.0)
# Free space around buildings: to each other, and to places the vehicle must reach [m].
PASSAGE = 10.0
MEGABYTES = (10.0, 60.0)
SNR_CONSTANT = 1e6
# As in the paper's missions the floor lies above the antenna [m]: flying into it, where
# the rate is infinite, would be best.
FLOOR = 10.0


def random_mission(seed: int, index: int) -> Mission:
    """Mission number `index` of a seed, whichever others are drawn.

    Numbers count through 0, 2, 4 and 6 buildings, first without data, then with: eight
    structures, each to be compiled once. Every mission can be flown:

    - Circles that do not touch leave the plane in one piece. The safe circles keep 10 m
        from each other, from start and goal, and from the place above the antenna: a
        passage 10 m wide leads everywhere, and the vehicle may fly it as slowly as it
        must, for up to 2000 s.
    - 30 m above the antenna 8.6 Mbit/s arrive: all data are sent in a minute there.
    """
    generator = np.random.default_rng([seed, index])
    count = BUILDINGS[index % len(BUILDINGS)]
    needs_data = index // len(BUILDINGS) % 2 == 1
    station = _place(generator, *ANTENNA)
    floor = station[2] + FLOOR
    start, goal = _ends(generator, floor)
    places = [start, station, goal] if needs_data else [start, goal]
    obstacles = _buildings(generator, count, np.array(places))
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
        altitude_floor=floor if needs_data else None,
        data_required=amount if needs_data else None,
        plan=GuessPlan(),
    )


def _place(generator: np.random.Generator, lowest: float, highest: float) -> np.ndarray:
    """A position anywhere in the city."""
    return np.array(
        [*generator.uniform(0.0, SIZE, 2), generator.uniform(lowest, highest)]
    )


def _ends(generator: np.random.Generator, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Start and goal."""
    while True:
        start, goal = (_place(generator, floor, CEILING) for _ in range(2))
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
