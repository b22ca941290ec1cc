"""Every notebook runs from its first cell to its last in a fresh kernel."""

import json
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
if not NOTEBOOKS:
    pytest.skip("a source distribution has no notebooks", allow_module_level=True)

MOST_BYTES = 500_000


def outputs(notebook):
    return [
        output
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
    ]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
# The kernel's connection, on this machine alone, is not encrypted.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::RuntimeWarning")
def test_it_runs_from_a_fresh_kernel(path):
    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": str(FOLDER)}}
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources=place
    ).execute()
    assert outputs(notebook)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_kept_with_what_it_shows_and_small(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < MOST_BYTES
    ran = [cell for cell in notebook.cells if cell.cell_type == "code"]
    counts = [cell.execution_count for cell in ran]
    assert counts == list(range(1, len(ran) + 1))
    kinds = {output.output_type for output in outputs(notebook)}
    assert "error" not in kinds
    pictures = [each for each in outputs(notebook) if "image/png" in each.get("data", {})]
    assert pictures
    # Nothing of whoever ran it last.
    assert "/home/" not in json.dumps(notebook)
