"""The reproduction as a page of Markdown."""

from collections.abc import Iterator, Sequence

import numpy as np

from . import missions
from ._reproduction import (
    NAMES,
    PUBLISHED,
    READINGS,
    Reproduction,
    detour,
    least_energy,
    least_time,
)

_HEAD = (
    "mission",
    "paper, s",
    "ours, s",
    "ours, N² s",
    "least energy of the paper's time, N² s",
    "least time for the data, s",
    "status",
    "verified",
)


def markdown(reproduction: Reproduction) -> str:
    """Times, trends, and what follows from them, for both readings of b."""
    manifest = reproduction.sweep.manifest
    parts = [
        "# The paper's missions",
        f"jaxscp {manifest['jaxscp']}, {manifest['settings']['nodes']} nodes, limits "
        f"{_PLACES[manifest['settings']['enforce']]}. Each flight was flown again by an "
        "integrator that shares no code with the optimizer; `verified` says whether "
        "nodes, limits and data were confirmed.",
        "## Mission times",
        _table(_HEAD, [_mission_row(reproduction, name) for name in NAMES]),
        "Least energy: a flight from rest to rest of T seconds takes at least (m g)² T, "
        "since its thrust has to give the weight's impulse. Least time: the data divided "
        "by the highest rate there is, straight above the station at the lowest altitude "
        "allowed.",
        "## Trends",
        _table(("the paper's claim", *READINGS), list(_claims(reproduction))),
        "## What follows",
        *_conclusions(reproduction),
    ]
    return "\n\n".join(parts) + "\n"


_PLACES = {"between": "at the nodes and between them", "nodes": "at the nodes"}


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _mission_row(reproduction: Reproduction, name: str) -> list[str]:
    mission, row = missions.get(name), reproduction.row(name)
    published = _published(name)
    return [
        f"`{name}`",
        f"{published:.0f}",
        f"{row['final_time']:.2f}",
        f"{row['objective']:,.1f}",
        f"{least_energy(mission, published):,.0f}",
        f"{least_time(mission):.1f}",
        str(row["status"]),
        "yes" if row["verified"] else "no",
    ]


def _published(name: str) -> float:
    return PUBLISHED[name.removesuffix("-60dB")]


def _claims(reproduction: Reproduction) -> Iterator[list[str]]:
    """A row for each: the claim, and what the missions say in each reading."""
    free = [name for name in PUBLISHED if name.startswith("free")]
    for claim, names, quantity, unit in (
        ("more data take longer", free, _time, "s"),
        ("more data lead farther from the straight line", free, _detour, "m"),
        ("buildings make 30 MB take longer", (free[0], "urban-30MB"), _time, "s"),
    ):
        yield [claim] + [
            _rising([quantity(reproduction, name + ending) for name in names], unit)
            for ending in READINGS.values()
        ]


def _rising(values: Sequence[float], unit: str) -> str:
    """Whether each is above the one before by more than a thousandth."""
    rises = np.diff(values) > 1e-3 * np.abs(values[:-1])
    listed = ", ".join(f"{value:.4g}" for value in values)
    return f"{'yes' if rises.all() else 'no'}: {listed} {unit}"


def _time(reproduction: Reproduction, name: str) -> float:
    return float(reproduction.row(name)["final_time"])


def _detour(reproduction: Reproduction, name: str) -> float:
    flight = reproduction.flight(name)
    if flight is None:
        return np.nan
    return detour(missions.get(name), np.asarray(flight.states))


def _conclusions(reproduction: Reproduction) -> Iterator[str]:
    """What the numbers say of the paper's, reading by reading."""
    for reading, ending in READINGS.items():
        names = [f"{name}{ending}" for name in PUBLISHED]
        short = [n for n in names if _published(n) < least_time(missions.get(n))]
        dear = [
            name
            for name in names
            if reproduction.confirmed(name)
            and least_energy(missions.get(name), _published(name))
            > float(reproduction.row(name)["objective"])
        ]
        said = []
        if short:
            said.append(
                f"In the published times of {_listed(short)} the data cannot be sent, "
                "wherever the vehicle flies above the floor set here, which the paper "
                "leaves open."
            )
        if dear:
            said.append(
                f"Any flight of the published times of {_listed(dear)} takes more energy "
                "than the verified flights here, so that the published ones are not the "
                "least-energy flights of this problem."
            )
        if not said:
            said.append("The published times are neither too short nor too long to be.")
        yield f"**{reading}.** {' '.join(said)}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)
