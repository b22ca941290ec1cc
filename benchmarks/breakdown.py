"""Where the time of a warm solve goes: python -m benchmarks.breakdown

The iterates of a solve are found again one by one, from Python, and each piece of an
iteration is timed at each of them as a program of its own, as often as the solve needed
it; the search for Newton's step is what the iteration takes beside the others.
Milliseconds are sums over all iterates, without what calling a program costs.
"""

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import jaxscp
from jaxscp import missions
from jaxscp._layout import Structure
from jaxscp._subproblem import _on_host
from jaxscp._subproblem_data import Outline
from jaxscp._transcription import Transcription

from . import pieces
from .records import add_json_option, table, table_head, write_report
from .timing import timed

MISSIONS = ("free-flight", "free-space-30MB-60dB", "urban-30MB-60dB")
# Calls whose median counts.
CALLS = 3
# A piece to what it is called.
NAMES = {
    "linearization": "linearization",
    "conditions": "optimality conditions",
    "curvature": "curvature and metric",
    "newton": "polishing: Newton's step and active constraints",
    "data": "QP: blocks",
    "piqp": "QP: PIQP itself",
    "host": "QP: the rest on the host (assembly, reading)",
    "callback": "QP: transfer and callback",
    "trial": "trial of a step",
}
HEADINGS = "mission | piece | calls | ms each | ms | share"


class Ledger:
    """Seconds and numbers of calls of each piece."""

    def __init__(self):
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)

    def add(self, piece: str, seconds: float, times: int = 1) -> None:
        self.seconds[piece] += times * seconds
        self.calls[piece] += times


def median(call: Callable[[], Any]) -> float:
    return timed(call, CALLS).warm


def replayed(
    transcription: Transcription, guess: jaxscp.Trajectory, whole: Callable[[], Any]
) -> tuple[Ledger, float]:
    """A solve from Python, with each piece timed where it was needed, and the seconds
    of whole solves in between: the machine has its phases.
    """
    ledger, done, seconds = Ledger(), False, []
    state = pieces.first(transcription, transcription.variables(guess))
    while not done:
        begun = time.perf_counter()
        jax.block_until_ready(whole())
        seconds.append(time.perf_counter() - begun)
        state, done = _iteration(transcription, state, ledger)
    return ledger, statistics.median(seconds)


def _iteration(transcription: Transcription, state, ledger: Ledger) -> tuple[Any, bool]:
    at = (transcription, state)
    idle = median(lambda: pieces.dispatch(*at))
    if not bool(state.iterate.fresh):
        spent = median(lambda: pieces.linearization(*at)) - idle
        ledger.add("linearization", spent)
    looked = pieces.look(*at)
    at = (transcription, looked)
    ledger.add("conditions", median(lambda: pieces.conditions(*at)) - idle)
    if float(looked.optimality) <= pieces.METHOD.tolerance:
        return looked, True
    moved = timed(lambda: pieces.move(*at), CALLS)
    (after, passes, tried, done), left = moved.result, moved.warm - idle
    curved = timed(lambda: pieces.curvature(*at), CALLS)
    spent = curved.warm - idle
    ledger.add("curvature", spent)
    left -= spent
    spent = median(lambda: pieces.trial(*at)) - idle
    ledger.add("trial", spent, int(passes))
    left -= int(passes) * spent
    if solves := int(after.subproblems - looked.subproblems):
        left -= _qp(transcription, looked, curved.result, idle, solves, ledger)
    if bool(tried):
        ledger.add("newton", left / int(passes), int(passes))
    return after, bool(done)


def _qp(transcription, state, parts, idle: float, solves: int, ledger: Ledger) -> float:
    """An iteration's subproblems, from the outside and on the host; their seconds."""
    at, structure = (transcription, state, parts), Structure.of(transcription)
    blocks, flat = jax.block_until_ready(pieces.data(*at))
    outline, settings = Outline.of(blocks), pieces.METHOD.qp
    numbers = np.asarray(flat)
    host = median(lambda: _on_host(structure, settings, outline, numbers))
    whole = median(lambda: pieces.subproblem(*at)) - idle
    built = median(lambda: pieces.data(*at)) - idle
    effort = pieces.subproblem(*at).effort
    # One with virtual control is solved after one without, in the same call.
    times = max(solves // int(effort.solves), 1)
    inside = float(effort.seconds)
    ledger.add("data", built, times)
    ledger.add("piqp", inside, times)
    ledger.add("host", host - inside, times)
    ledger.add("callback", whole - built - host, times)
    return times * whole


def measure(name: str) -> dict:
    """A mission's solve as a whole, and in pieces."""
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess(100)
    discretization = jaxscp.Discretization()

    def whole() -> jaxscp.Solution:
        return jaxscp.solve(problem, guess, throw=False)

    solution = whole()
    transcription = Transcription(solution.problem, discretization, guess.fractions)
    ledger, warm = replayed(transcription, guess, whole)
    known, steps = dict(ledger.seconds), solution.statistics
    return {
        "mission": name,
        "seconds": warm,
        "piqp_seconds": float(steps.qp_seconds),
        "iterations": int(steps.iterations),
        "polish_iterations": int(steps.polish_iterations),
        "subproblems": int(steps.subproblems),
        "pieces": {
            piece: {"seconds": known[piece], "calls": ledger.calls[piece]}
            for piece in NAMES
            if piece in known
        },
        "rest": warm - sum(known.values()),
    }


def lines(row: dict) -> list[str]:
    """What each piece takes: rows of the table, in Markdown."""
    whole = row["seconds"]

    def line(name: str, calls: str, seconds: float) -> str:
        each = f"{1e3 * seconds / int(calls):.2f}" if calls else ""
        return (
            f"| {row['mission']} | {name} | {calls} | {each}"
            f" | {1e3 * seconds:.1f} | {100 * seconds / whole:.0f} % |"
        )

    pieces_of = [
        line(NAMES[piece], str(own["calls"]), own["seconds"])
        for piece, own in row["pieces"].items()
    ]
    steps = f"{row['iterations']} + {row['polish_iterations']} iterations"
    rest, every = line("the rest", "", row["rest"]), line(f"all: {steps}", "", whole)
    return [*pieces_of, rest, every]


def tables(report: dict) -> str:
    """What was measured, in Markdown."""
    return table(HEADINGS, [line for row in report["missions"] for line in lines(row)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(MISSIONS))
    add_json_option(parser, "breakdown")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(table_head(HEADINGS))
    rows = []
    for name in arguments.missions:
        rows.append(measure(name))
        print(*lines(rows[-1]), sep="\n", flush=True)
        write_report(arguments.json, missions=rows)


if __name__ == "__main__":
    main()
