"""What each ingredient of the default method is worth: python -m benchmarks.methods

Every variant solves the same missions from the same guesses at the same nodes; one run,
so that the times may be compared.
"""

import argparse

import jax

import jaxscp
from jaxscp import missions

from .report import HEADINGS, cells, facts_of
from .timing import timed_solve
from .variants import HardBall, SmoothMerit

VARIANTS = {
    "default": jaxscp.ProximalSCP(),
    "polished to 1e-6": jaxscp.ProximalSCP(tolerance=1e-6),
    "no second-order correction": jaxscp.ProximalSCP(correction=False),
    "curvature without the dynamics'": jaxscp.ProximalSCP(curvature="nodes"),
    "curvature of the cost only": jaxscp.ProximalSCP(curvature="cost"),
    "hard norm ball": HardBall(),
    "merit: augmented Lagrangian (SCvx*)": SmoothMerit(),
    "the paper's Algorithm 1": jaxscp.PaperSCP(),
}
MISSIONS = ("free-flight", "urban-flight", "free-space-30MB-60dB", "urban-30MB-60dB")


def measure(mission: str, method: jaxscp.AbstractSCP, nodes: int, repeats: int) -> str:
    """One row of the table, in Markdown."""
    chosen = missions.get(mission)
    problem, guess = chosen.problem(), chosen.guess(nodes)
    solution, _, warm = timed_solve(problem, guess, repeats, method)
    converged = "yes" if bool(solution.converged) else "no"
    return f" {cells(facts_of(solution))} | {warm:.2f} | {converged} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(MISSIONS))
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"| mission | method | {HEADINGS} | s | converged |")
    print("|---|---|---|---|---|---|---|---|")
    for mission in arguments.missions:
        for name, method in VARIANTS.items():
            row = measure(mission, method, arguments.nodes, arguments.repeats)
            print(f"| {mission} | {name} |{row}", flush=True)


if __name__ == "__main__":
    main()
