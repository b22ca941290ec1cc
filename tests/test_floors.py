"""The package is built in floors: a module imports only from floors below its own."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "jaxscp"

# From the ground up. A folder's `__init__` goes by the folder's name, the package's own
# by the empty one.
FLOORS = (
    {
        "_cache",
        "_flight_state",
        "_pickling",
        "_program",
        "_records",
        "_types",
        "_version",
        "_writing",
        "plot._contours",
        "plot._style",
    },
    {"_host", "_loop", "_packed", "_pattern", "_sines", "_tree"},
    {"_fingerprint", "_nonlinear"},
    {"_kept"},
    {"_compiler", "_status", "_bounds", "_hold", "_progress", "_qp"},
    {"_direction"},
    {"models._parameters", "models._smooth"},
    {"_attempt", "_curvature", "_max_norm", "_per_constraint"},
    {"_problem", "models.systems", "models.limits"},
    {"models.channel", "models.obstacles", "models.quadrotor"},
    {"_trajectory", "_routes", "_paced_problem", "models", "textbook"},
    {"_discretization", "_step", "_repropagation", "_limit_checks"},
    {"_captured", "_peaks", "_verification", "_diagnosis", "_validation"},
    {"_flow", "verify"},
    {"_intervals", "_second_order"},
    {"_transcription"},
    {"_lagrangian", "_layout", "_linearization", "_stages"},
    {"_riccati", "_scaling"},
    {"_constraints", "_model"},
    {"_damping", "_merit"},
    {"_subproblem_data"},
    {"_assembly"},
    {"_subproblem_solver"},
    {"_subproblem"},
    {"_per_limit"},
    {"_pivoting", "_refinement"},
    {"_active_system", "_state"},
    {"_active_set"},
    {"_iteration", "_kkt", "_optimality", "_scp"},
    {"_kkt_system", "_search", "_solution", "_trust_region"},
    {"_sensitivity"},
    {"_choice", "_limit_names", "_regularity", "_shadow_prices"},
    {"_exchange", "_smoothing"},
    {"_outcome"},
    {"_newton_scp", "_prospects"},
    {"_proximal", "_paper"},
    {"_free_intervals"},
    {"_response", "_solve"},
    {"_audit", "_continuation", "_sensitivity_report"},
    {"_guess_plan"},
    {"_mission"},
    {"_data_sent", "missions"},
    {"_files", "_sweep._points", "_sweep._record"},
    {"_sweep._folder", "_sweep._result", "_sweep._worker"},
    {"_sweep._run"},
    {"_sweep"},
    {"_reproduction"},
    {"_reproduction_text"},
    {"plot._numbers", "plot._places", "plot._series"},
    {"plot._energy", "plot._gradient_map", "plot._multipliers", "plot._pareto"},
    {"plot._ellipses", "plot._isometric", "plot._link", "plot._profile"},
    {"plot._top_view"},
    {"plot._animation", "plot._mission", "plot._reproduction"},
    {"plot"},
    {""},
    {"_cli._values"},
    {"_cli._arguments", "_cli._figures", "_cli._report", "_cli._timing"},
    {"_cli._reproduce"},
    {"_cli._commands"},
    {"_cli"},
    {"__main__"},
)
FLOOR = {name: level for level, names in enumerate(FLOORS) for name in names}


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def imported(name: str) -> set[str]:
    """Modules of the package that this one imports, anywhere in its text."""
    found = set()
    folder = ["jaxscp", *filter(None, name.split("."))]
    if MODULES[name].name != "__init__.py":
        folder.pop()
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = folder[: len(folder) - node.level + 1] if node.level else []
            origin = ".".join([*base, *filter(None, [node.module])])
            targets = [f"{origin}.{alias.name}" for alias in node.names]
        else:
            continue
        for target in targets:
            if target == "jaxscp" or target.startswith("jaxscp."):
                inner = target.removeprefix("jaxscp").removeprefix(".")
                # What is no module is a name in one.
                found.add(inner if inner in MODULES else inner.rpartition(".")[0])
    return found


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_point_down(name):
    assert name in FLOOR, f"{name} has no floor yet: add it to FLOORS"
    level = {other: FLOOR[other] for other in imported(name)}
    assert all(below < FLOOR[name] for below in level.values()), (name, level)


def test_the_floors_hold_modules_that_exist():
    assert set(FLOOR) <= set(MODULES)


def test_imports_are_seen():
    assert imported("_trajectory") == {"_problem", "_tree", "_types"}
    assert imported("models.channel") >= {"_types", "models._smooth"}
