"""The registry of methods: entry points as packages make them, and one line for each mistake."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from pdvc.history import Steps
from pdvc.options import MeasureOptions, paper_options
from tests.command_line import install
from validation.methods import own
from validation.methods import registry as methods
from validation.methods.registry import MethodError, find_method, method_names

METHOD = """
from validation.methods.registry import Method

MINE = Method(name="{name}", measure=print, assumes="{assumes}")
"""
ROOT = Path(__file__).parent.parent
OURS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"][methods.GROUP]


@pytest.fixture
def site(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_our_methods_are_installed_and_say_what_they_assume():
    assert set(OURS) <= set(method_names())
    for name in OURS:
        method = find_method(name)
        assert method.assumes.startswith("Assume ")
        assert method.assumes.endswith(".")
        assert len(method.assumes) < 300
        assert method.assumes in " ".join((ROOT / "docs" / "methods.md").read_text().split())


def test_our_methods_come_in_the_order_of_the_project():
    assert set(methods.OWN) == set(OURS)
    assert method_names()[: len(methods.OWN)] == methods.OWN


def test_the_example_of_the_documentation_is_found_and_measures(site, monkeypatch):
    """The two listings of docs/methods.md, installed as they stand."""
    text = (ROOT / "docs" / "methods.md").read_text()
    (module,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (entries,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert len(module.splitlines()) <= 10
    install(site, tomllib.loads(entries)["project"]["entry-points"][methods.GROUP], module, name="toy")
    method = find_method("five-sections")
    assert method.assumes == "Assume that five sections are enough for the whole sample."
    assert method.looks_at == "projections"
    handed = []
    monkeypatch.setattr(f"{method.measure.__module__}.measure", lambda *given: handed.append(given))
    method.measure("an experiment")
    ((experiment, options),) = handed
    assert experiment == "an experiment"
    assert options.sections == 5
    assert method_names()[-1] == "five-sections"


def test_classical_dvc_is_told_to_use_scans_and_measures_with_the_default_sections(monkeypatch):
    handed = []
    monkeypatch.setattr(own, "correlate", lambda *given: handed.append(given))
    method = find_method("classical-dvc")
    assert method.looks_at == "volumes"
    assert [name for name in OURS if find_method(name).looks_at == "volumes"] == ["classical-dvc", "spam"]
    method.measure("an experiment")
    ((experiment, options),) = handed
    assert experiment == "an experiment"
    assert (options.sections, options.section_motions) == (15, MeasureOptions().section_motions)


def options_of(name, monkeypatch, *, rows=238, steps=127):
    """Return the options that one of our methods hands to `measure`."""
    handed = []
    monkeypatch.setattr(own, "measure", lambda _, options: handed.append(options))
    find_method(name).measure(SimpleNamespace(geometry=SimpleNamespace(rows=rows), test=range(steps)))
    (options,) = handed
    return options


def test_pgd_is_the_paper_s_protocol_and_the_others_solve_directly(monkeypatch):
    assert options_of("pgd", monkeypatch) == paper_options()
    plain, weighted = options_of("gauss-newton", monkeypatch), options_of("weighted", monkeypatch)
    assert {stage.solver.kind for stage in (*plain.rigid, *plain.deformation)} == {"gauss-newton"}
    assert (plain.weighting, weighted.weighting) == ("uniform", "noise")
    assert weighted.model_copy(update={"weighting": "uniform"}) == plain


@pytest.mark.parametrize(("rows", "scales"), [(40, [2]), (119, [4, 2]), (238, [8, 4, 2]), (954, [16, 8, 4, 2])])
def test_each_step_has_no_time_basis_and_starts_where_its_motion_is_small(monkeypatch, rows, scales):
    options = options_of("each-step", monkeypatch, rows=rows, steps=25)
    assert options.time == (Steps(),)
    assert [stage.scale for stage in options.rigid] == scales
    # the displacement at a step is sqrt(steps) times the amplitude of its function
    assert options.prior_voxel * 5 == pytest.approx(30)
    assert options.section_motions == options_of("weighted", monkeypatch).section_motions


@pytest.mark.parametrize(
    ("given", "meant"), [("gaus-newton", "gauss-newton"), ("PGD", "pgd"), ("eachstep", "each-step")]
)
def test_a_misspelt_name_gets_a_hint(given, meant):
    with pytest.raises(MethodError, match=f"did you mean '{meant}'") as caught:
        find_method(given)
    assert ", ".join(methods.OWN) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unlike_name_gets_the_list_alone():
    with pytest.raises(MethodError) as caught:
        find_method("xyzzy")
    assert "did you mean" not in str(caught.value)
    assert "weighted" in str(caught.value)


@pytest.mark.parametrize(
    ("module", "told"),
    [
        ("import nothing_like_this", "cannot load it: No module named 'nothing_like_this'"),
        ("", "cannot load it: module 'wrong' has no attribute 'MINE'"),
        ("MINE = 7", "expected a Method at wrong:MINE, found int"),
        (
            METHOD.format(name="yours", assumes="Assume it."),
            "expected a Method of this name at wrong:MINE, found 'yours'",
        ),
        (METHOD.format(name="mine", assumes=" "), "expected wrong:MINE to say what the method assumes"),
    ],
)
def test_what_is_no_method_is_answered_in_one_line(site, monkeypatch, module, told):
    monkeypatch.delitem(__import__("sys").modules, "wrong", raising=False)
    install(site, {"mine": "wrong:MINE"}, module, name="wrong")
    with pytest.raises(MethodError, match=re.escape(told)) as caught:
        find_method("mine")
    assert str(caught.value).startswith("method 'mine': expected ")
    assert "\n" not in str(caught.value)


def test_a_name_offered_twice_is_refused(site):
    install(site, {"pgd": "other:function"}, "", name="other")
    with pytest.raises(MethodError, match=r"found several: other, pdvc-bench"):
        find_method("pgd")


def test_without_any_entry_point_the_installation_is_to_blame(monkeypatch):
    monkeypatch.setattr(methods, "entry_points", lambda **_: ())
    with pytest.raises(MethodError, match="install the package again"):
        find_method("pgd")
