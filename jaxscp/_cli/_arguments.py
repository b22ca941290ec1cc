"""The command line's arguments."""

import argparse
from typing import Any, NoReturn

from .._paper import PaperSCP
from .._proximal import ProximalSCP
from .._version import __version__
from ..missions import ENFORCED, GRIDS
from ._values import assignment, node_count, positive, share

# Exit statuses, as the parser's epilog tells them.
SUCCESS, FAILURE, BAD_INPUT = 0, 1, 2

METHODS = {"proximal": ProximalSCP, "paper": PaperSCP}
WHERE_LIMITS_HOLD = "where limits hold: at the nodes and between them, or at the nodes"
# What can be audited, and the relative difference that passes: a flight time moves along
# with what the cost hardly sees, and solves leave more of it open.
AUDITED = {"objective": 1e-3, "final_time": 1e-2}


class InputError(Exception):
    """A wrong argument, value or file; its text says what to change."""


class Parser(argparse.ArgumentParser):
    """Reports a wrong argument in one line, without the usage before it."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}\n")


def parser() -> argparse.ArgumentParser:
    """The parser of `jaxscp`, with one subcommand for each thing it does."""
    top = Parser(
        prog="jaxscp",
        description="Trajectory optimization by sequential convex programming.",
        epilog="Exit status: 0 if converged and verified, or if every derivative passed; "
        "1 if not; 2 on bad input.",
    )
    top.add_argument("--version", action="version", version=f"jaxscp {__version__}")
    commands = top.add_subparsers(
        dest="command",
        required=True,
        metavar="{missions,solve,sweep,reproduce,verify,audit}",
    )
    commands.add_parser("missions", help="list the missions, a line each")
    _add_solve(commands)
    _add_sweep(commands)
    _add_reproduce(commands)
    check = commands.add_parser("verify", help="check a saved solution independently")
    check.add_argument("file", metavar="FILE.npz", help="written by solve --save")
    _add_enforce(check, "nodes", "where limits must hold")
    _add_audit(commands)
    return top


def _add_solve(commands: Any) -> None:
    solve = commands.add_parser(
        "solve",
        help="solve and verify a mission",
        description="Solve a mission, verify the solution and print a short table.",
    )
    _add_mission(solve)
    _add_settings(solve)
    solve.add_argument("--json", metavar="FILE", help="write the result as JSON")
    solve.add_argument(
        "--save", metavar="FILE.npz", help="write time, state and control in SI units"
    )
    solve.add_argument(
        "--plot", metavar="FILE.png", help="draw the solution (also .pdf, .svg)"
    )
    solve.add_argument(
        "--quiet", action="store_true", help="print nothing but what went wrong"
    )


def _add_sweep(commands: Any) -> None:
    sweep = commands.add_parser(
        "sweep",
        help="solve and verify a mission with many values",
        description="Solve a mission with every combination of the values, side by side "
        "in several processes, verify the solutions and print a table.",
    )
    _add_mission(sweep)
    sweep.add_argument(
        "--over",
        metavar="PATH=JSON-LIST",
        action="append",
        required=True,
        type=assignment,
        help="values to take, as in --over vehicle.mass=[2.5,3]; repeatable",
    )
    sweep.add_argument(
        "--along",
        metavar="PATH",
        help="start each solve from the solution with the value before, where all else "
        "is the same",
    )
    _add_settings(sweep)
    _add_processes(sweep)
    sweep.add_argument("--csv", metavar="FILE", help="write the table as CSV")
    sweep.add_argument(
        "--npz", metavar="FILE", help="write table and trajectories for Sweep.load"
    )


def _add_reproduce(commands: Any) -> None:
    reproduce = commands.add_parser(
        "reproduce",
        help="solve the paper's missions and write its results beside ours",
        description="Solve and verify the missions of the paper's Section V in both "
        "readings of b, and write a page in Markdown, figures and trajectories.",
    )
    reproduce.add_argument(
        "--output",
        metavar="DIR",
        default="reproduction",
        help="where to write them (default: %(default)s)",
    )
    reproduce.add_argument(
        "--format",
        choices=("png", "svg", "pdf"),
        default="png",
        help="of the figures (default: %(default)s)",
    )
    _add_nodes(reproduce)
    _add_method(reproduce)
    _add_enforce(reproduce, "between", WHERE_LIMITS_HOLD)
    _add_processes(reproduce)


def _add_processes(command: Any) -> None:
    command.add_argument(
        "--workers",
        metavar="N",
        type=positive,
        help="number of processes (default: one for each core)",
    )
    command.add_argument(
        "--folder",
        metavar="DIR",
        help="keep each solution there at once, and solve only what is missing",
    )


def _add_audit(commands: Any) -> None:
    audit = commands.add_parser(
        "audit",
        help="check a mission's derivatives",
        description="Solve a mission and compare derivatives of its solution, by each of "
        "its numbers, with finite differences of further solves.",
    )
    _add_mission(audit)
    audit.add_argument(
        "--of",
        choices=AUDITED,
        default="objective",
        help="what is differentiated (default: %(default)s)",
    )
    audit.add_argument(
        "--wrt",
        metavar="PATH",
        action="append",
        help="by what, or how its path begins, as in --wrt vehicle.mass; repeatable "
        "(default: all but the plan of the guess)",
    )
    audit.add_argument(
        "--tolerance",
        type=share,
        help="relative difference that passes (default: 1e-3 of the objective, 1e-2 of "
        "the flight time)",
    )
    _add_enforce(audit, "between", WHERE_LIMITS_HOLD)
    audit.add_argument("--json", metavar="FILE", help="write the table as JSON")


def _add_mission(command: Any) -> None:
    command.add_argument(
        "mission", metavar="MISSION", help="a name `jaxscp missions` lists"
    )
    command.add_argument(
        "--set",
        metavar="PATH=JSON",
        action="append",
        default=[],
        type=assignment,
        dest="changes",
        help="change a value of the mission, as in --set vehicle.mass=2.5; repeatable",
    )
    _add_nodes(command)


def _add_nodes(command: Any) -> None:
    command.add_argument(
        "--nodes",
        type=node_count,
        default=100,
        metavar="N",
        help="nodes of the time grid (default: %(default)s)",
    )


def _add_method(command: Any) -> None:
    command.add_argument(
        "--method",
        choices=METHODS,
        default="proximal",
        help="how the convex subproblems follow each other (default: %(default)s)",
    )


def _add_settings(command: Any) -> None:
    command.add_argument(
        "--grid",
        choices=GRIDS,
        default="uniform",
        help="how they are spaced: evenly, or freely, each interval near the durations "
        "of its neighbours (default: %(default)s)",
    )
    _add_method(command)
    _add_enforce(command, "between", WHERE_LIMITS_HOLD)


def _add_enforce(command: Any, default: str, meaning: str) -> None:
    command.add_argument(
        "--enforce",
        choices=ENFORCED,
        default=default,
        help=f"{meaning} (default: %(default)s)",
    )
