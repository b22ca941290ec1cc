"""Pages, pictures and notebooks that live elsewhere in the repository."""

from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
ELSEWHERE = ("CHANGELOG.md", "CONTRIBUTING.md", "benchmarks/README.md")


def on_files(files, config):
    found = [*ROOT.glob("benchmarks/figures/*.png"), *ROOT.glob("notebooks/*.ipynb")]
    for path in [*ELSEWHERE, *sorted(str(each.relative_to(ROOT)) for each in found)]:
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files
