"""Numbers such as each benchmark stores, and what its tables make of them."""

SOLVED = {
    "status": "Converged: as it should.",
    "mission": "free-flight",
    "objective": 24380.59,
    "iterations": 2,
    "polish_iterations": 14,
    "subproblems": 3,
    "optimality": 5e-9,
    "converged": True,
    "polished": True,
    "verified": True,
    "warm_seconds": 0.504,
    "cold_seconds": 30.0,
    "cpu_seconds": 2.0,
}


def of_discretizer(name, nodes, substeps, milliseconds, error):
    return {
        "integrals": "without",
        "discretizer": name,
        "nodes": nodes,
        "substeps": substeps,
        "seconds": 1e-3 * milliseconds,
        "error": error,
        "compile_seconds": 2.0,
    }


# Numbers of a benchmark, and a line that its tables have.
SAMPLES = {
    "missions": (
        {"missions": [SOLVED | {"above_best_known": None, "piqp_seconds": 0.02}]},
        "| free-flight | 24,380.59 | 2 + 14 | 3 | 5e-09 |  | yes | 0.504 | 0.020"
        " | 30.0 |",
    ),
    "ipopt": (
        {
            "cases": [
                {
                    "mission": "free-flight",
                    "jaxscp": SOLVED
                    | {"seconds": 0.5, "memory_peak": 534.4, "memory_warm_peak": 446.0},
                    "ipopt": {
                        "scaled": SOLVED
                        | {"seconds": 2.6, "memory_peak": 804.0, "violation": 1e-13}
                        | {"status": "Solve_Succeeded", "faster": "5.2 times"}
                    },
                }
            ]
        },
        "| free-flight | IPOPT, scaled | 24,380.59 | 1e-13 | 2 | 2.60 | 2.00 | 804"
        " | solve succeeded | 5.2 times |",
    ),
    "sweep": (
        {
            "sweeps": [
                {
                    "kind": "jaxscp",
                    "workers": workers,
                    "programs": "kept",
                    "seconds": seconds,
                    "cpu_seconds": 60.0,
                    "points": 64,
                    "succeeded": 63,
                    "same": True,
                }
                for workers, seconds in ((1, 80.0), (2, 44.0))
            ],
            "killed": {"kept": 32, "solved_again": 32, "seconds": 20.0, "succeeded": 63},
        },
        "| 2 jaxscp | kept | 44.0 | 0.55 | 60 | 63 of 64 | yes |",
    ),
    "solve": (
        {
            "rows": [
                SOLVED
                | {"solver": "jaxscp", "gap": 0.0, "defect": 3e-5, "broken": {}}
                | {"equal": True, "iterations": "2 + 14"},
                {"mission": "free-flight", "solver": "peer", "status": "is missing"},
            ]
        },
        "| jaxscp | 24,380.59 | 0.000 | 3e-05 | none | yes | 30.0 | 0.50 | 2 + 14 | yes"
        " | Converged |",
    ),
    "breakdown": (
        {
            "missions": [
                SOLVED
                | {"seconds": 0.5, "rest": 0.1}
                | {"pieces": {"curvature": {"seconds": 0.4, "calls": 16}}}
            ]
        },
        "| free-flight | curvature and metric | 16 | 25.00 | 400.0 | 80 % |",
    ),
    "showpieces": (
        {
            "showpieces": [
                {
                    "problem": "drone",
                    "jaxscp": SOLVED | {"flown": 1.2, "error": None, "objective": 1.2},
                    "OpenSCvx": {"failed": "is missing"},
                }
            ]
        },
        "| drone | jaxscp | 1.2 | 1.2 |  | 2 + 14 | yes, polished | yes | 30.0 | 0.504 |",
    ),
    "growth": (
        {
            "missions": {
                "b": [SOLVED | {"nodes": 50, "seconds_per_iteration": 0.02}],
                "a": [SOLVED | {"nodes": 10, "seconds_per_iteration": 0.01}],
            }
        },
        "| free-flight | 10 | 24,380.59 | 2 + 14 | 3 | 5e-09 | 0.50 | 2.00 | 10.0 | yes"
        " | yes |",
    ),
    "gradients": (
        {
            "missions": {
                "free-flight": [
                    SOLVED
                    | {"nodes": 50, "solve_seconds": 0.5, "differences_seconds": 12.0}
                    | {"objective_seconds": 0.005, "objective_bytes": 2**20}
                    | {"trajectory_seconds": 0.05, "trajectory_bytes": 2**22}
                ]
            }
        },
        "| free-flight | 50 | 0.50 | 5.0 (1.0 %) | 1.0 | 50.0 (10.0 %) | 4.0 | 12"
        " | yes |",
    ),
    "methods": (
        {"methods": [SOLVED | {"method": "default"}]},
        "| free-flight | default | 24,380.59 | 2 + 14 | 3 | 5e-09 | 0.50 | yes |",
    ),
    "random_missions": (
        {
            "missions": [
                {**SOLVED, "buildings": 2, "megabytes": None, "cpu_seconds": 1.0},
                {**SOLVED, "buildings": 2, "megabytes": None, "cpu_seconds": 3.0},
                SOLVED | {"verified": False, "buildings": 2, "megabytes": None},
            ]
        },
        "| no | 2 | 3 | 2 | 2, 2 | 14, 14 | 2.0, 3.0 |",
    ),
    "discretization": (
        {
            "discretization": [
                of_discretizer("jaxscp", 100, 4, 2.0, 8e-5),
                of_discretizer("NumPy", 100, 4, 1500.0, 8e-5),
                of_discretizer("adaptive", 100, None, 4.0, 1e-6),
                of_discretizer("jaxscp", 1000, 4, 20.0, None),
            ],
            "batches": [],
        },
        "| NumPy | 1,500.000 (8e-05) |  | 2.0 to 2.0 | 750.00 |",
    ),
}
