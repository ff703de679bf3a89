"""The command line, run in this process, and packages of methods that it finds."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from validation.cli import app
from validation.methods.registry import GROUP


def pdvc_bench(*arguments):
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def only_line(result):
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    return lines[0]


def install(
    folder: Path, entry_points: dict[str, str], module: str = "", name: str = "toy", group: str = GROUP
) -> None:
    """Lay out a package as pip installs it: a module, its metadata, and its entry points (name, value)."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = [f"{key} = {value}\n" for key, value in entry_points.items()]
    (info / "entry_points.txt").write_text(f"[{group}]\n{''.join(lines)}")
    (folder / f"{name}.py").write_text(module)
