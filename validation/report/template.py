"""The HTML templates of all pages, rendered alike: what a page shows is escaped, and what it lacks is an error."""

from __future__ import annotations

import jinja2


def template(name: str) -> jinja2.Template:
    """Return a template by the name of its file."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("validation.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)
