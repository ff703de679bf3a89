"""A class of settings is shown without its signature: pydantic's repeats every field and its bounds, unreadably."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from sphinx.application import Sphinx


def without_fields(
    _app: Sphinx, what: str, _name: str, subject: Any, _options: Any, _signature: str | None, _returned: str | None
) -> tuple[str, None] | None:
    """Return an empty signature for a class of settings, None for all else."""
    return ("", None) if what == "class" and issubclass(subject, BaseModel) else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hook."""
    app.connect("autodoc-process-signature", without_fields)
    return {"parallel_read_safe": True}
