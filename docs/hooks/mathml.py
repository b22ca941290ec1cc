"""Equations as MathML, which browsers draw without a script."""

import html
import logging
import re

from latex2mathml.converter import convert

log = logging.getLogger("mkdocs.hooks.mathml")

# What `pymdownx.arithmatex` leaves.
EQUATION = re.compile(
    r'<(?:span|div) class="arithmatex">\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]</\w+>',
    re.DOTALL,
)


def on_page_content(content, page, config, files):
    def drawn(found: re.Match) -> str:
        latex = html.unescape(found["latex"])
        mathml = convert(latex, display="block" if found["open"] == "[" else "inline")
        # What is not understood is passed on as text.
        if "\\" in mathml or re.search(r">&(?:amp;)?<", mathml):
            log.warning(f"{page.file.src_uri}: cannot be drawn: {latex.strip()}")
        return mathml

    return EQUATION.sub(drawn, content)
