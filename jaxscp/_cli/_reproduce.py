"""The command that reproduces the paper."""

import argparse
from pathlib import Path

from .. import _writing
from .._reproduction import reproduce as solve_missions
from .._reproduction_text import markdown
from ._arguments import FAILURE, METHODS, SUCCESS, InputError
from ._figures import write_figure

PAGE, RESULTS = "reproduction.md", "reproduction.npz"


def reproduce(arguments: argparse.Namespace) -> int:
    """Solve the paper's missions; write a page, its figures and the trajectories."""
    folder = Path(arguments.output)
    try:
        _writing.check_folder("--output", folder)
        found = solve_missions(
            METHODS[arguments.method](),
            nodes=arguments.nodes,
            enforce=arguments.enforce,
            workers=arguments.workers,
            folder=arguments.folder,
        )
    except ValueError as error:
        raise InputError(error) from error
    # Imported where needed: Matplotlib takes a second.
    from ..plot import reproduction as drawn

    found.sweep.to_npz(folder / RESULTS)
    figures = drawn(found)
    for name, figure in figures.items():
        write_figure(folder / f"{name}.{arguments.format}", figure)
    pictures = [f"![{name}]({name}.{arguments.format})" for name in figures]
    page = "\n\n".join([markdown(found).rstrip(), "## Figures", *pictures]) + "\n"
    _writing.write_bytes(folder / PAGE, page.encode())
    print(found.sweep)
    print(f"written to {folder / PAGE}")
    return SUCCESS if found.succeeded else FAILURE
