"""Docstrings are plain text as Markdown reads it: `code`, *emphasis*, equations in indented blocks.

Autodoc would read them as reStructuredText. Each is put into a directive that hands it to MyST instead.
"""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.utils import new_document
from myst_parser.parsers.sphinx_ import MystParser
from sphinx.application import Sphinx


class MarkdownText(Directive):
    """A block of Markdown inside reStructuredText."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return what MyST makes of the block."""
        document = new_document(self.state.document["source"], self.state.document.settings)
        MystParser().parse("\n".join(self.content), document)
        return document.children


def as_markdown(_app: Sphinx, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Put a docstring into the directive."""
    if any(line.strip() for line in lines):
        text = re.sub(r"^(\S.*)\n-{3,}$", r"**\1**", "\n".join(lines), flags=re.MULTILINE)  # opens no section
        text = re.sub(r"::$", ":", text, flags=re.MULTILINE)
        lines[:] = [".. markdown-text::", "", *(f"   {line}" for line in text.splitlines()), ""]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive and the hook."""
    app.add_directive("markdown-text", MarkdownText)
    app.connect("autodoc-process-docstring", as_markdown)
    return {"parallel_read_safe": True}
