"""The paper's missions beside CasADi and IPOPT: python -m benchmarks.ipopt

The same discrete problem (held controls, classical Runge-Kutta with as many substeps as
jaxscp ended with, limits at the nodes) from the same guess in the same run. IPOPT has
its default settings, but for a time limit, and exact derivatives; the model is written
again in CasADi. Each solve has a process of its own, so that its memory can be told.
Needs the `bench` extra and Linux.

IPOPT's problem is given to it in four ways, since none is always best: with variables in
SI units, or scaled as jaxscp scales them; and with functions expanded to scalar
operations, or one interval's mapped over all.
"""

import argparse
import tempfile
from pathlib import Path

from . import peer
from .records import add_json_option, table, table_head, write_report

# Mission to quadrature. Literal missions mean nothing along the flow with limits at the
# nodes alone.
CASES = {
    "free-flight": "flow",
    "free-space-30MB-60dB": "flow",
    "free-space-30MB": "trapezoid",
}
# Name to the peer's arguments.
WAYS = {
    "expanded": ("--graph", "expanded"),
    "expanded, scaled": ("--graph", "expanded", "--scaled"),
    "mapped": ("--graph", "mapped"),
    "mapped, scaled": ("--graph", "mapped", "--scaled"),
    "compiled": ("--graph", "compiled"),
    "compiled, scaled": ("--graph", "compiled", "--scaled"),
}
DEFAULT_WAYS = [way for way in WAYS if not way.startswith("compiled")]
FINISHED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
OUT_OF_TIME = "Maximum_WallTime_Exceeded"
# Relative difference of objectives beyond which they belong to other optima.
APART = 1e-4
HEADINGS = (
    "mission | solver | objective | violation | iterations | s | CPU s | peak MB"
    " | ended | jaxscp faster by"
)


def measure(name: str, ways: list[str], limit: float, nodes: int, repeats: int) -> dict:
    """One case, jaxscp first: it settles the number of substeps."""
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / "case.json", Path(folder) / "result.json"
        counts = ("--nodes", str(nodes), "--repeats", str(repeats))
        where = ("--mission", name, "--quadrature", CASES[name])
        ours = peer.run("ipopt_jaxscp", *files, *where, *counts)
        print(jaxscp_line(name, ours), flush=True)
        theirs = {}
        for way in ways:
            options = (*WAYS[way], "--limit", str(limit))
            theirs[way] = peer.run("ipopt_peer", *files, *options)
            del theirs[way]["found"]
            theirs[way]["faster"] = comparison(ours, theirs[way])
            print(ipopt_line(name, way, theirs[way]), flush=True)
    return {"mission": name, "quadrature": CASES[name], "jaxscp": ours, "ipopt": theirs}


def comparison(ours: dict, theirs: dict) -> str:
    """How many times faster jaxscp is, where that can be said."""
    if not ours["converged"]:
        return "jaxscp fails"
    times = f"{theirs['seconds'] / ours['seconds']:.1f} times"
    if theirs["status"] == OUT_OF_TIME:
        return f"more than {times}"
    if theirs["status"] not in FINISHED:
        return "IPOPT fails"
    apart = theirs["objective"] / ours["objective"] - 1
    return times if abs(apart) <= APART else f"{times}, to {apart:+.1%}"


def jaxscp_line(name: str, facts: dict) -> str:
    """A row of the table, in Markdown."""
    ended = "polished" if facts["polished"] else "roughly"
    return (
        f"| {name} | jaxscp | {facts['objective']:,.2f} | "
        f" | {facts['iterations']} + {facts['polish_iterations']}"
        f" | {facts['seconds']:.2f} | {facts['cpu_seconds']:.2f}"
        f" | {facts['memory_peak']:,.0f}, {facts['memory_warm_peak']:,.0f} warm"
        f" | {ended if facts['converged'] else 'not converged'} | |"
    )


def ipopt_line(name: str, way: str, facts: dict) -> str:
    """A row of the table, in Markdown."""
    late = "> " if facts["status"] == OUT_OF_TIME else ""
    return (
        f"| {name} | IPOPT, {way} | {facts['objective']:,.2f} | {facts['violation']:.0e}"
        f" | {facts['iterations']} | {late}{facts['seconds']:.2f}"
        f" | {facts['cpu_seconds']:.2f} | {facts['memory_peak']:,.0f}"
        f" | {facts['status'].replace('_', ' ').lower()} | {facts['faster']} |"
    )


def tables(report: dict) -> str:
    """What was measured, in Markdown."""
    lines = []
    for case in report["cases"]:
        name = case["mission"]
        lines.append(jaxscp_line(name, case["jaxscp"]))
        lines += [ipopt_line(name, way, facts) for way, facts in case["ipopt"].items()]
    return table(HEADINGS, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", nargs="*", default=list(CASES), choices=CASES)
    parser.add_argument("--ways", nargs="*", default=DEFAULT_WAYS, choices=WAYS)
    parser.add_argument("--limit", type=float, default=600.0, help="of IPOPT [s]")
    parser.add_argument("--nodes", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=7, help="warm solves of jaxscp")
    add_json_option(parser, "ipopt")
    arguments = parser.parse_args()
    print(table_head(HEADINGS))
    cases = []
    for name in arguments.missions:
        rest = (arguments.limit, arguments.nodes, arguments.repeats)
        cases.append(measure(name, arguments.ways, *rest))
        write_report(arguments.json, cases=cases)


if __name__ == "__main__":
    main()
