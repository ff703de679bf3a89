"""The rooms keep apart: the contracts of pyproject.toml hold, and a help page loads no numerics."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

from tests.mutants import TESTS

ROOT = Path(__file__).parent.parent


def test_import_contracts_hold():
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"]
    result = subprocess.run([*command, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "4 kept, 0 broken" in result.stdout


def test_the_command_line_starts_without_loading_numerics():
    heavy = ("numpy", "numba", "matplotlib", "xarray", "pandas", "pyarrow", "distributed")
    code = f"import sys, validation.cli; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_no_test_module_imports_another():
    """What several share is in a module that holds no tests: a test may then be moved or dropped by itself."""
    paths = sorted((ROOT / "tests").glob("*.py"))
    tests = {path.stem for path in paths if path.stem.startswith("test_")}
    assert len(tests) > 40  # they were found
    for path in paths:
        named: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                whole = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                named.update(
                    part for name in (*whole, *(each.name for each in node.names)) for part in name.split(".")
                )
        assert not named & tests, f"{path.name} imports a test module"


def test_every_room_that_faults_are_planted_in_and_every_test_file_that_guards_it_is_there():
    for room, files in TESTS.items():
        assert (ROOT / "pdvc" / f"{room}.py").is_file()
        for name in files:
            assert (ROOT / "tests" / f"test_{name}.py").is_file()
