"""Pages that are made, not written: one for each module, and the two files at the top of the repository."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "pdvc": "the measurement",
    "simulator": "the synthetic experiment",
    "validation": "the bench",
}
COPIED = {"CONTRIBUTING.md": "project/contributing.md", "CHANGELOG.md": "project/changelog.md"}


def modules(package: str) -> Iterator[tuple[str, str, list[str]]]:
    """Yield name, first sentence and imported names of each public module of a package, the package first."""
    for path in sorted((ROOT / package).rglob("*.py"), key=lambda path: (path.name != "__init__.py", path)):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        code = ast.parse(path.read_text(encoding="utf-8"))
        said = ast.get_docstring(code)
        if said and not any(part.startswith("_") for part in name.split(".")):
            imports = (node for node in ast.walk(code) if isinstance(node, ast.Import | ast.ImportFrom))
            imported = sorted({each.asname or each.name for node in imports for each in node.names})
            yield name, " ".join(said.split("\n\n")[0].split()), imported


def api_pages() -> dict[str, str]:
    """Return a page for each module, and the overview of them all."""
    result = {}
    overview = ["# The API, module by module", "", "Made from the docstrings. Names that begin with `_` are left out."]
    contents = []
    for package, title in PACKAGES.items():
        (_, said, _), *inner = modules(package)
        overview += ["", f"## `{package}`: {title}", "", said, "", "| module | what lives there |", "| --- | --- |"]
        for name, said, imported in sorted(inner):
            if (ROOT / name.replace(".", "/")).is_dir():
                continue  # a package: its modules follow
            hidden = ", ".join([*imported, "model_config"])  # the last is pydantic's
            directive = f".. automodule:: {name}\n   :exclude-members: {hidden}"
            result[f"api/{name}.md"] = f"# `{name}`\n\n```{{eval-rst}}\n{directive}\n```\n"
            overview.append(f"| [{name.partition('.')[2]}]({name}.md) | {said.replace('|', '/')} |")
            contents.append(name)
    overview += ["", "```{toctree}", ":hidden:", "", *contents, "```", ""]
    result["api/index.md"] = "\n".join(overview)
    return result


def copied(source: str) -> str:
    """Return the text of a file at the top of the repository, with its links as from a folder under docs/."""
    text = (ROOT / source).read_text(encoding="utf-8").replace("](docs/", "](../")
    for other, page in COPIED.items():
        text = text.replace(f"]({other})", f"](../{page})")
    return text


def pages() -> dict[str, str]:
    """Return the text of each generated page by its path under docs/."""
    copies = {target: copied(source) for source, target in COPIED.items()}
    return {**api_pages(), **copies}


def write_pages(app: Sphinx) -> None:
    """Write what has changed, so that only that is built again, and remove what is no longer there."""
    folder = Path(app.srcdir)
    wanted = pages()
    for room in {Path(name).parent for name in wanted}:
        for path in (folder / room).glob("*.md"):
            if path.relative_to(folder).as_posix() not in wanted:
                path.unlink()
    for name, text in wanted.items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hook."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True}
