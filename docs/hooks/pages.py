"""Pages, pictures and notebooks that live elsewhere in the repository."""

from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
PATTERNS = (
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "benchmarks/README.md",
    "benchmarks/figures/*.png",
    "notebooks/*.ipynb",
    "notebooks/reproduction/*.md",
    "notebooks/reproduction/*.png",
)


def on_files(files, config):
    found = [path for pattern in PATTERNS for path in sorted(ROOT.glob(pattern))]
    for path in found:
        place = str(path.relative_to(ROOT))
        files.append(File.generated(config, place, abs_src_path=str(path)))
    return files
