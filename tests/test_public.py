"""The door for Python: the public names are pinned, load late, and do what the pages of the documentation say."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import pdvc
from pdvc.gauss_newton import GaussNewton
from pdvc.history import TimeFunction, time_basis
from pdvc.options import MeasureOptions, StageOptions
from pdvc.prior import Prior
from pdvc.sections import SectionBasis
from pdvc.settings import PLUGINS, SettingsError, load_plugins
from pdvc.solution import Problem
from simulator.scanner import simulate
from tests import synthetic_records as records
from tests.command_line import install, pdvc_bench
from tests.small_case import SECTIONS, STEPS, lineariser, radiographs, series
from tests.tiny_scenarios import TINY
from validation.plan.designs import design_of_experiment, planned_like
from validation.testing.small_cases import SmallExperiment, small_scenario

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


def blocks(page):
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def test_the_public_names_are_these():
    """A change here is a change for everyone who uses the package: say so in the changelog."""
    assert pdvc.__all__ == [
        "Experiment",
        "MeasureOptions",
        "Measurement",
        "dataset_of",
        "displacement",
        "inspect",
        "measure",
        "measure_into",
        "paper_options",
        "plot",
        "read_experiment",
        "read_measurement",
        "strain",
    ]
    for name in pdvc.__all__:
        found = getattr(pdvc, name)
        assert found is getattr(pdvc, name)  # not shadowed by a module once that is loaded
        assert callable(found)
        assert inspect.getdoc(found)
        assert name in dir(pdvc)
    with pytest.raises(AttributeError, match="no attribute 'displacements'"):
        _ = pdvc.displacements


def test_importing_the_package_loads_nothing_heavy():
    code = "import sys, pdvc; print([name for name in ('numpy', 'numba', 'matplotlib') if name in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_the_walk_through_runs(tmp_path, monkeypatch, capsys):
    simulate(small_scenario({"geometry.rows": 84}), tmp_path / "experiment")
    monkeypatch.chdir(tmp_path)
    session: dict[str, object] = {}
    for block in blocks("walkthrough.md"):
        exec(compile(block, "page", "exec", dont_inherit=True), session)
    told = capsys.readouterr().out
    assert "largest strain of the last step" in told
    assert (tmp_path / "motion.png").stat().st_size > 10_000
    assert (tmp_path / "amplitudes.nc").is_file()
    assert not (tmp_path / "motion.nc.work").exists()
    # beside the record's own numbers, in voxels
    measured, moved = session["measured"], session["moved"]
    voxel_mm = measured.recording.voxel_mm
    expected = measured.motion.displacement(3, np.array(session["points"])) * voxel_mm
    np.testing.assert_allclose(moved["displacement"].sel(step=3), expected)


@pytest.fixture(scope="module")
def added(tmp_path_factory):
    """Import the blocks of the how-to page once, as a module: kinds are offered for the whole process."""
    folder = tmp_path_factory.mktemp("extend")
    (folder / "added_by_the_page.py").write_text("\n\n".join(blocks("extend.md")))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        return vars(import_module("added_by_the_page"))


def test_a_time_function_is_added_by_the_page_alone(added, tmp_path):
    creep = added["Creep"]
    assert creep in TimeFunction.kinds()
    path = tmp_path / "options.toml"
    path.write_text('[[time]]\nkind = "force"\n[[time]]\nkind = "creep"\nstart = 12\n')
    options = MeasureOptions.read(path)
    assert options.time[1] == creep(start=12)
    assert "logarithm of the time since a step" in options.template()
    small = SmallExperiment(small_scenario({}))
    options = small.options.model_copy(update={"time": (*small.options.time, creep(start=12))})
    measured = pdvc.measure(small.experiment, options)
    series = small.experiment.test
    since = np.clip(series.time_s - series.time_s[12], 0, None)
    functions = measured.motion.time_functions
    wanted = np.log1p(since / 5.0)
    held = functions.T @ (functions @ wanted) / len(wanted)
    np.testing.assert_allclose(held, wanted, atol=1e-9)
    assert len(functions) == len(time_basis(small.options.time, series)) + 1
    assert creep(start=12).stretched(2.0).start == 24


def test_a_section_motion_is_added_by_the_page_alone(added, tmp_path):
    shear = added["SHEAR"]
    small = SmallExperiment(small_scenario({}))
    options = MeasureOptions(
        **{**dict(small.options), "section_motions": (*small.options.section_motions, "shear_xy")}
    )
    pdvc.measure_into(tmp_path / "motion.nc", small.experiment, options)
    measured = pdvc.read_measurement(tmp_path / "motion.nc")
    assert measured.motion.basis.motions[-1] == shear
    # the sample does not shear, and no fit would say so exactly
    z = measured.motion.amplitude[..., -1] / measured.motion.amplitude_std[..., -1]
    assert 0 < np.sqrt((z**2).mean()) < 4
    # a bar that does shear, by pdvc's own projector: to the sign, and to a twentieth
    sheared = replace(SECTIONS, motions=(*SECTIONS.motions, shear))
    amplitude = np.zeros((STEPS, *sheared.shape))
    amplitude[..., -1] = 0.4
    found = GaussNewton(most_passes=8, least_change_voxel=1e-5).solve(
        Problem(
            linearise=lineariser(radiographs(sheared, amplitude), sheared),
            basis=sheared,
            series=series(),
            time_functions=np.ones((1, STEPS)),
            start=np.zeros((1, *sheared.shape)),
            prior=Prior(deviation_voxel=np.full(sheared.shape, 30.0)),
            noise_rms=None,
        )
    )
    np.testing.assert_allclose(found.coefficients[0, 1:-1, -1], 0.4, atol=0.02)


def test_a_solver_is_added_by_the_page_alone(added, tmp_path):
    path = tmp_path / "options.toml"
    (toml,) = [text for text in re.findall(r"```toml\n(.*?)```", (DOCS / "extend.md").read_text(), re.DOTALL)
               if "one-step" in text]  # fmt: skip
    path.write_text(toml)
    options = MeasureOptions.read(path)
    assert options.deformation == (StageOptions(scale=1, solver=added["OneStep"]()),)
    small = SmallExperiment(small_scenario({}))
    measured = pdvc.measure(small.experiment, small.options.model_copy(update={"deformation": options.deformation}))
    assert measured.fit.stages[-1].solver == "one-step"
    assert len(measured.fit.stages[-1].rms) == 2


def test_a_scenario_ingredient_of_the_page_does_what_it_says(added):
    drive = SimpleNamespace(angle_rad=np.zeros(3), history=SimpleNamespace(time_s=np.array([0.0, 10.0, 50.0])))
    motion = added["Creeping"](speed_mm_s=2e-3).motion(drive)
    point = np.array([[0.1, -0.2, 1.0]])
    np.testing.assert_allclose(motion.forward(point, 2), [[0.1, -0.2, 0.9]])
    np.testing.assert_allclose(motion.inverse(motion.forward(point, 1), 1), point)


def test_an_unknown_kind_is_answered_with_the_known_ones():
    with pytest.raises(SettingsError, match=r"solver: unknown kind 'newton', expected 'gauss-newton'.*'pgd'"):
        MeasureOptions.parse({"deformation": [{"scale": 1, "solver": {"kind": "newton"}}]}, where="options")
    with pytest.raises(
        SettingsError, match=r"solver: expected a table with the kind 'gauss-newton' or .* given 'pgd'"
    ):
        MeasureOptions.parse({"deformation": [{"scale": 1, "solver": "pgd"}]}, where="options")
    with pytest.raises(SettingsError, match=r"deformation\.0\.solver\.most: unknown key"):
        MeasureOptions.parse({"deformation": [{"solver": {"kind": "pgd", "most": 3}}]}, where="options")
    with pytest.raises(SettingsError, match=r"solver\.most_modes: unknown key"):
        MeasureOptions.parse({"deformation": [{"solver": {"kind": "gauss-newton", "most_modes": 3}}]}, where="options")


def test_what_several_kinds_have_in_common_is_no_kind():
    class Delayed(TimeFunction):
        """Anything that begins later."""

        start: int = 0

    assert Delayed not in TimeFunction.kinds()
    with pytest.raises(SettingsError, match=r"time\.0: unknown kind 'nothing', expected 'angle'"):
        MeasureOptions.parse({"time": [{"kind": "nothing"}]}, where="options")


def test_a_plug_in_that_cannot_be_loaded_is_named(tmp_path, monkeypatch):
    install(tmp_path, {"mine": "broken_plug_in"}, "import nothing_like_this", name="broken_plug_in", group=PLUGINS)
    monkeypatch.syspath_prepend(tmp_path)
    load_plugins.cache_clear()
    with pytest.raises(SettingsError, match="plug-in broken_plug_in of broken_plug_in: cannot be loaded: No module"):
        MeasureOptions.parse({"time": [{"kind": "theirs"}]}, where="options")
    monkeypatch.undo()
    load_plugins.cache_clear()


def test_a_kind_is_offered_by_one_record_only(added):
    with pytest.raises(TypeError, match="kind 'creep': expected one record of this kind"):
        type("Other", (TimeFunction,), {"__annotations__": {"kind": str}, "kind": "creep", "__module__": "elsewhere"})


@pytest.fixture(scope="module")
def stretched():
    strain, offset = records.tensile_history()
    _, amplitude = records.stretched(strain, offset)
    return records.measurement(amplitude), strain, offset


class TestPoints:
    def test_displacements_are_those_of_the_closed_form_in_mm(self, stretched):
        """x = X + e Z e_z + d: u(x) = d + e / (1 + e) (z - d_z) e_z."""
        measured, strain, offset = stretched
        points = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, -2.0]])
        found = pdvc.displacement(measured, points, steps=(5, 20))
        for k, step in enumerate((5, 20)):
            rise = strain[step] / (1 + strain[step]) * (points[:, 2] - offset[step, 2])
            expected = offset[step] + np.stack([0 * rise, 0 * rise, rise], axis=1)
            np.testing.assert_allclose(found["displacement"][k], expected, atol=1e-12)
            angle = measured.recording.angle_rad[step]
            across, along = np.array([-np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
            np.testing.assert_allclose(found["turned"][k, :, 0], expected[:, :2] @ across)
            np.testing.assert_allclose(found["turned"][k, :, 2], expected[:, :2] @ along)
        expected = measured.turned_std(5, points) * records.VOXEL_MM
        np.testing.assert_allclose(found["deviation"][0], expected)
        assert found["deviation"].attrs["units"] == "mm"

    def test_strains_are_of_the_length_at_rest(self, stretched):
        measured, strain, _ = stretched
        found = pdvc.strain(measured, [-2.0, -0.5, 2.0])
        np.testing.assert_allclose(found["strain"], np.repeat(strain[:, None], 2, axis=1), atol=1e-12)
        # a small change of the slope, by the strain's own formula
        slope = strain[20] / (1 + strain[20])
        change = 1e-6
        expected = ((slope + change) / (1 - slope - change) - strain[20]) / change
        of_slope = measured.strain_std(20, np.array([-2.0, -0.5, 2.0]))
        np.testing.assert_allclose(found["deviation"][20], expected * of_slope, rtol=1e-4)

    def test_what_was_not_observed_is_not_a_number(self):
        measured = records.measurement(np.ones((records.STEPS, 9, 6)), unobserved=(8,))
        found = pdvc.displacement(measured, [[0.0, 0.0, 3.5], [0.0, 0.0, 0.0]])
        assert np.isnan(found["displacement"][:, 0]).all()
        assert np.isnan(found["deviation"][:, 0]).all()
        assert np.isfinite(found["deviation"][:, 1]).all()
        assert np.isnan(pdvc.strain(measured)["strain"][:, -1]).all()
        pdvc.plot(measured).draw_without_rendering()

    @pytest.mark.parametrize(
        ("call", "told"),
        [
            (lambda m: pdvc.displacement(m, [0.0, 0.0, 1.0]), r"points_mm: expected \(point, 3\)"),
            (lambda m: pdvc.displacement(m, [[0.0, 0.0, 1.0]], steps=[99]), "steps: expected some of 0 to 23"),
            (lambda m: pdvc.displacement(m, [[0.0, 0.0, 1.0]], steps=[]), "steps: expected some of 0 to 23"),
            (lambda m: pdvc.strain(m, [1.0, 1.0]), "heights_mm: expected two or more, increasing"),
        ],
    )
    def test_wrong_questions_are_answered_in_one_line(self, stretched, call, told):
        with pytest.raises(ValueError, match=told) as caught:
            call(stretched[0])
        assert "\n" not in str(caught.value)


def test_sections_that_cannot_follow_a_rigid_motion_say_so_and_the_rigid_stage_leaves_it_out():
    basis = SectionBasis(height_mm=np.array([-1.0, 1.0]), radius_mm=0.5, motions=SectionBasis.__dataclass_fields__[
        "motions"].default[:3])  # fmt: skip
    whole = SectionBasis(height_mm=np.array([0.0]), radius_mm=0.5)
    with pytest.raises(ValueError, match="section motions: expected motions that can follow"):
        basis.reproduced(np.eye(6)[5][None], whole)
    small = SmallExperiment(small_scenario({}))
    names = ("translation_x", "translation_y", "translation_z", "rotation_z")
    measured = pdvc.measure(small.experiment, MeasureOptions(**{**dict(small.options), "section_motions": names}))
    assert measured.fit.stages[0].spatial.shape[2] == 4


@pytest.mark.parametrize(
    "angle_deg",
    [137.5 * np.arange(30), (200 + 7.0 * np.arange(30)) % 360, -7.2 * np.arange(30), np.zeros(30)],
    ids=["golden", "modulo a turn", "clockwise", "standing still"],
)
def test_the_own_design_of_a_laboratory_is_what_it_planned(angle_deg):
    """Whatever the angles are: only other designs change them, along the way that was planned."""
    angle, steps = np.deg2rad(angle_deg), len(angle_deg)
    series = SimpleNamespace(angle_rad=angle, time_s=2.0 * np.arange(steps), force_N=np.linspace(250, 700, steps))
    test = _Sized(series, steps)
    geometry = SimpleNamespace(voxel_mm=0.05, rows=120)
    experiment = SimpleNamespace(test=test, frames=2, flats=np.zeros(3), geometry=geometry)
    own = design_of_experiment(experiment, MeasureOptions())
    same = planned_like(experiment, own, own)
    assert len(same.recorded()) == steps
    np.testing.assert_allclose(np.exp(1j * same.angle_rad), np.exp(1j * angle), atol=1e-9)
    np.testing.assert_allclose(same.force_N, series.force_N)
    denser = planned_like(experiment, replace(own, turns=2 * own.turns), own)
    turned = np.unwrap(angle)[-1] - np.unwrap(angle)[0]
    assert denser.angle_rad[-1] - denser.angle_rad[0] == pytest.approx(2 * turned)


class _Sized(SimpleNamespace):
    """A series with a length."""

    def __init__(self, values, steps):
        super().__init__(**vars(values))
        self._steps = steps

    def __len__(self):
        return self._steps


def test_a_laboratory_plans_from_its_reference_scan(tmp_path):
    """The folder of an experiment whose test is still to be made: its radiographs are not there."""
    fewer = TINY.replace("2.3968", "3.6").replace("rows = 119", "rows = 80").replace("columns = 54", "columns = 36")
    (tmp_path / "tiny.toml").write_text(fewer)
    assert pdvc_bench("simulate", tmp_path / "tiny.toml", "-o", tmp_path / "experiment").exit_code == 0
    (tmp_path / "experiment" / "test" / "radiographs.tif").unlink()
    found = pdvc_bench("plan", tmp_path / "experiment", "-o", tmp_path / "real.csv")
    assert found.exit_code == 0, found.stderr
    simulated = pdvc_bench("plan", tmp_path / "tiny.toml", "-o", tmp_path / "simulated.csv")
    assert simulated.exit_code == 0, simulated.stderr

    def own(name):
        heads, first, *_ = (line.split(",") for line in (tmp_path / name).read_text().splitlines())
        return dict(zip(heads, map(float, first), strict=True))

    real, known = own("real.csv"), own("simulated.csv")
    assert real["steps"] == known["steps"]
    # the same reference scan, with noise and without; points of the hull for those of the specimen, and another
    # motion, on which depends how much of the flats' noise cancels
    assert real["std_across_beam"] == pytest.approx(known["std_across_beam"], rel=0.5)
    assert real["std_vertical"] == pytest.approx(known["std_vertical"], rel=0.5)
    rows = [line.split(",") for line in (tmp_path / "real.csv").read_text().splitlines()]
    flats, vertical = rows[0].index("flats"), rows[0].index("std_vertical")
    most = max(rows[1:], key=lambda row: int(row[flats]))
    # more flats help: they do not cancel, though most of their noise is found in the radiographs
    assert 0.9 * real["std_vertical"] < float(most[vertical]) < real["std_vertical"]
