"""The order of the pages, kept out of the pages: they are plain Markdown for readers on a code host."""

from __future__ import annotations

from sphinx.application import Sphinx

NAVIGATION = {
    "Start": ["start", "scenarios", "examples"],
    "How to": [
        "own-radiographs",
        "live",
        "walkthrough",
        "identification",
        "studies",
        "methods",
        "extend",
        "strategies",
    ],
    "Explanation": [
        "equations",
        "protocol",
        "paper",
        "uncertainty",
        "verdict",
        "limits",
        "architecture",
    ],
    "Results": ["results", "performance", "bad-inputs", "faults", "mutants"],
    "Reference": ["commands", "scores", "folder", "frame", "api/index"],
    "Project": ["project/contributing", "project/changelog"],
}


def with_contents(_: Sphinx, page: str, source: list[str]) -> None:
    """Add the contents of the whole site to the start page."""
    if page == "index":
        source[0] += "".join(
            f"\n\n```{{toctree}}\n:hidden:\n:maxdepth: 2\n:caption: {caption}\n\n" + "\n".join(pages) + "\n```\n"
            for caption, pages in NAVIGATION.items()
        )


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hook."""
    app.connect("source-read", with_contents)
    return {"parallel_read_safe": True}
