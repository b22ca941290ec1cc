"""Pages and pictures that live elsewhere in the repository."""

from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
ELSEWHERE = ("CHANGELOG.md", "CONTRIBUTING.md", "benchmarks/README.md")


def on_files(files, config):
    figures = sorted((ROOT / "benchmarks/figures").glob("*.png"))
    for path in [*ELSEWHERE, *(str(figure.relative_to(ROOT)) for figure in figures)]:
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files
