"""The package as a user installs it: a wheel, outside of the checkout, with and without what the extras bring."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from simulator.scanner import simulate
from validation.testing.small_cases import small_scenario

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OWN = {"pdvc", "simulator", "validation", "pdvc_bench"}

WITHOUT_EXTRAS = "import sys\nsys.modules.update(dict.fromkeys({missing}))\n"
"""None in place of a module: it cannot be imported, and is not found where it is looked for."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build a wheel from a copy of the sources, and unpack it as pip installs it."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    source = folder / "source"
    for package in ("pdvc", "pdvc_bench", "simulator", "validation"):
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    subprocess.run([*command, "-w", folder, source], check=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def python(site, *arguments, cwd, first=None):
    """Run Python on the installed packages, away from the checkout; `first` is a folder that is found before them."""
    paths = [str(path) for path in (first, site) if path is not None]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


def test_the_wheel_holds_what_is_read_at_run_time(site, tmp_path):
    code = """
import pdvc, simulator, validation
from pathlib import Path
print(*(Path(each.__file__).parent for each in (pdvc, simulator, validation)), sep="\\n")
from simulator.scenario import builtin_names, load_scenario
from validation.study.description import builtin_studies
assert {"quick", "jailin2018"} <= set(builtin_names()) and "coverage" in builtin_studies()
load_scenario("quick")
"""
    done = python(site, "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert {str(Path(line).parent) for line in done.stdout.split()} == {str(site)}
    for name in ("report", "study", "comparison"):
        assert (site / "validation" / "report" / "templates" / f"{name}.html").is_file()
    for name in ("index.html", "page.css", "page.js", "chart.js", "figures.js", "record.js", "icon.svg"):
        assert (site / "validation" / "view" / "page" / "assets" / name).is_file()
    for package in ("pdvc", "simulator", "validation"):
        assert (site / package / "py.typed").is_file()
    assert not (site / "tests").exists()


SIMULATING = {"trimesh", "xraylib", "spekpy"}
MANY = {"dask", "distributed", "pyarrow"}
LIVE = {"tornado"}


ONE_AFTER_THE_OTHER = """
import sys
from pdvc_bench.__main__ import main
for command in {commands}:
    sys.argv = ["pdvc-bench", *command]
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"expected exit code 0 of {{command}}, found {{end.code}}") from None
"""
"""Commands in one process: to load the kernels takes a process longer than such a command."""


def bare(folder, missing):
    """Return a function that runs Python where some modules are not installed.

    It runs in the checkout, whose kernels are compiled already.
    """
    (folder / "bare").mkdir()
    (folder / "bare" / "sitecustomize.py").write_text(WITHOUT_EXTRAS.format(missing=missing))
    return lambda *arguments: python(ROOT, *arguments, cwd=folder, first=folder / "bare")


def test_a_laboratory_needs_no_extra_to_measure(tmp_path):
    simulate(small_scenario({}), tmp_path / "experiment")
    (tmp_path / "options.toml").write_text("sections = 4\n")
    run = bare(tmp_path, SIMULATING | MANY | LIVE | {"hypothesis"})
    commands = (
        ("inspect", "experiment"),
        ("measure", "experiment", "-o", "motion.nc", "--options", "options.toml"),
        ("report", "motion.nc", "--experiment", "experiment", "-o", "report"),
        ("plan", "experiment", "--options", "options.toml"),
        ("export", "motion.nc", "--experiment", "experiment", "--vtk", "vtk", "--csv", "motion.csv"),
        ("export", "experiment", "--nxtomo", "both.nx", "--geometry", "geometry.xml"),
        ("import", "--reference", "both.nx::reference", "--test", "both.nx::test", "-o", "again"),
    )
    done = run("-c", ONE_AFTER_THE_OTHER.format(commands=commands))
    assert done.returncode == 0, done.stderr
    for name in ("report/report.html", "vtk", "motion.csv", "both.nx", "geometry.xml", "again/experiment.toml"):
        assert (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("command", "missing", "extra"),
    [
        (("run", "quick", "-o", "out"), SIMULATING, "simulate"),
        (("plan", "quick"), SIMULATING, "simulate"),
        (("study", "noise", "-o", "out"), MANY, "many"),
        (("compare", "quick", "-o", "out"), MANY, "many"),
        (("study", "which-error-matters", "-o", "out"), {"SALib"}, "sensitivity"),
        (("page", "motion.nc"), LIVE, "live"),
        (("export", "motion.nc", "--parquet", "out"), {"pyarrow"}, "parquet"),
    ],
)
def test_what_needs_an_extra_names_it_in_one_line(tmp_path, command, missing, extra):
    done = bare(tmp_path, missing)("-m", "pdvc_bench", *command)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("error: ")
    assert f"pip install 'pdvc-bench[{extra}]'" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["simulator", "validation", "pdvc"])
def test_a_folder_that_hides_a_package_is_named_in_one_line(site, tmp_path, name):
    (tmp_path / "mine" / name).mkdir(parents=True)
    (tmp_path / "mine" / name / "__init__.py").write_text("")
    done = python(site, "-m", "pdvc_bench", "--help", cwd=tmp_path, first=tmp_path / "mine")
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f"error: {name}: expected the package of pdvc-bench in {site}, found {tmp_path}")


def test_a_file_that_hides_a_package_is_named_in_one_line(site, tmp_path):
    (tmp_path / "pdvc.py").write_text("raise RuntimeError('not to be run')")
    done = python(site, "-m", "pdvc_bench", "--help", cwd=tmp_path, first=tmp_path)
    assert done.returncode == 1
    assert f"found {tmp_path / 'pdvc.py'}, which hides it" in done.stderr
    done = python(site, "-c", "import validation", cwd=tmp_path, first=tmp_path)
    assert f"ImportError: pdvc: expected the package of pdvc-bench in {site}" in done.stderr


def test_a_package_notices_that_another_one_is_hidden(site, tmp_path):
    (tmp_path / "mine" / "simulator").mkdir(parents=True)
    (tmp_path / "mine" / "simulator" / "__init__.py").write_text("")
    done = python(site, "-c", "import validation", cwd=tmp_path, first=tmp_path / "mine")
    assert done.returncode == 1
    assert "ImportError: simulator: expected the package of pdvc-bench" in done.stderr
    # one that only measures is not bothered by a folder of this common name
    done = python(site, "-c", "import pdvc; pdvc.MeasureOptions()", cwd=tmp_path, first=tmp_path / "mine")
    assert done.returncode == 0, done.stderr


def declared(*extras):
    """Return the names of distributions that are declared, those of some extras included, as they are compared."""
    lines = list(PROJECT["dependencies"])
    for extra in extras:
        lines += PROJECT["optional-dependencies"][extra]
    return {re.split(r"[\[><=!~ ]", line)[0].lower().replace("_", "-") for line in lines}


@pytest.mark.parametrize(
    ("package", "extras"),
    [
        ("pdvc", ()),
        ("simulator", ("simulate", "spectra")),
        ("validation", ("simulate", "many", "live", "sensitivity", "strategies")),
    ],
)
def test_what_is_imported_is_declared(package, extras):
    owners = packages_distributions()
    imported = set()
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            imported |= {name.partition(".")[0] for name in names}
    others = imported - OWN - set(sys.stdlib_module_names)
    assert len(others) > 3
    for name in others:
        wanted = {owner.lower().replace("_", "-") for owner in owners.get(name, [name])}
        assert wanted & declared(*extras), f"{package} imports {name}, of {wanted}, which is not declared"
