"""The project's pages: what they show, to be run."""

import contextlib
import io
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


class Page:
    """One page of Markdown."""

    def __init__(self, path: str):
        self.path = ROOT / path
        self.text = self.path.read_text(encoding="utf-8")

    def blocks(self, language: str) -> list[str]:
        """Its fenced blocks of one language."""
        return [block for kind, block in self._fenced() if kind == language]

    def run(self) -> dict:
        """Run its Python, one block after the other, and return what they define.

        A block of `text` that follows one of Python is what that prints.
        """
        names: dict = {}
        printed = ""
        for language, block in self._fenced():
            if language == "python":
                with contextlib.redirect_stdout(io.StringIO()) as out:
                    exec(compile(block, str(self.path), "exec"), names)
                printed = out.getvalue()
            elif language == "text":
                assert printed == block
        return names

    def links(self) -> list[str]:
        """Where its links lead."""
        return re.findall(r"\]\(([^)]+)\)", self.text)

    def _fenced(self) -> list[tuple[str, str]]:
        return re.findall(r"^```(\w+)\n(.*?)^```$", self.text, re.DOTALL | re.MULTILINE)
