"""The command line's arguments."""

import argparse
import json
from typing import Any, NoReturn

METHODS = ("proximal", "paper")
PLACES = ("nodes", "between")
GRIDS = ("uniform", "free")


class InputError(Exception):
    """A wrong argument, value or file; its text says what to change."""


class Parser(argparse.ArgumentParser):
    """Reports a wrong argument in one line, without the usage before it."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def parser() -> argparse.ArgumentParser:
    """The parser of `jaxscp`, with one subcommand each to list, solve and verify."""
    top = Parser(
        prog="jaxscp",
        description="Trajectory optimization by sequential convex programming.",
        epilog="Exit status: 0 if converged and verified, 1 if not, 2 on bad input.",
    )
    commands = top.add_subparsers(
        dest="command", required=True, metavar="{missions,solve,verify}"
    )
    commands.add_parser("missions", help="list the missions, a line each")
    _add_solve(commands)
    check = commands.add_parser("verify", help="check a saved solution independently")
    check.add_argument("file", metavar="FILE.npz", help="written by solve --save")
    _add_enforce(check, "nodes", "where limits must hold")
    return top


def _add_solve(commands: Any) -> None:
    solve = commands.add_parser(
        "solve",
        help="solve and verify a mission",
        description="Solve a mission, verify the solution and print a short table.",
    )
    solve.add_argument(
        "mission", metavar="MISSION", help="a name `jaxscp missions` lists"
    )
    solve.add_argument(
        "--set",
        metavar="PATH=JSON",
        action="append",
        default=[],
        type=assignment,
        dest="changes",
        help="change a value of the mission, as in --set vehicle.mass=2.5; repeatable",
    )
    solve.add_argument(
        "--nodes",
        type=node_count,
        default=100,
        metavar="N",
        help="nodes of the time grid (default: %(default)s)",
    )
    solve.add_argument(
        "--grid",
        choices=GRIDS,
        default=GRIDS[0],
        help="how they are spaced: evenly, or freely, each interval near the durations "
        "of its neighbours (default: %(default)s)",
    )
    solve.add_argument(
        "--method",
        choices=METHODS,
        default=METHODS[0],
        help="how the convex subproblems follow each other (default: %(default)s)",
    )
    _add_enforce(
        solve, "between", "where limits hold: also between the nodes, or there alone"
    )
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


def _add_enforce(command: Any, default: str, meaning: str) -> None:
    command.add_argument(
        "--enforce",
        choices=PLACES,
        default=default,
        help=f"{meaning} (default: %(default)s)",
    )


def assignment(text: str) -> tuple[str, Any]:
    """`PATH=JSON` as a path and a value."""
    path, equals, value = text.partition("=")
    if not (equals and path):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not PATH=JSON; write for example vehicle.mass=2.5"
        )
    try:
        return path, json.loads(value, parse_constant=_refuse_constant)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{path}={value}: the value is not JSON ({error}); write a finite number, "
            "a list such as [1, 2], or null"
        ) from error


def node_count(text: str) -> int:
    """A number of nodes: an integer of at least 2."""
    if not text.isdecimal() or int(text) < 2:
        raise argparse.ArgumentTypeError(f"{text!r}: give an integer of at least 2")
    return int(text)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")
