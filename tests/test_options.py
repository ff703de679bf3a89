"""Options: what is left open follows the detector, what is impossible is refused, and the paper's are the paper's."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from pdvc.geometry import ConeBeam
from pdvc.history import PAPER
from pdvc.options import MeasureOptions, StageOptions, check_discarded, paper_options, resolved
from pdvc.pgd import Pgd
from pdvc.sections import RIGID, names_of
from pdvc.settings import SettingsError
from pdvc.volume import Grid, hull_of
from pdvc.window import used_window


def scanner(rows, columns):
    return ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.1, rows=rows, columns=columns)


def resolved_for(options, rows, columns, discarded=(3, 2)):
    """Return the options as they are for a detector, with some rows and columns left out."""
    test = SimpleNamespace(force_N=np.full(20, 250.0))
    return resolved(options, SimpleNamespace(geometry=scanner(rows, columns), test=test), *discarded)


def scales(stages):
    return [stage.scale for stage in stages]


@pytest.mark.parametrize(("rows", "sections"), [(954, 29), (320, 29), (318, 28), (238, 21), (33, 3), (10, 2)])
def test_there_are_as_many_sections_as_rows_allow_unless_a_number_is_asked_for(rows, sections):
    assert MeasureOptions().sections_for(rows) == sections
    assert MeasureOptions(sections=7).sections_for(rows) == 7


@pytest.mark.parametrize(
    ("rows", "columns", "coarse"),
    [(954, 432, 8), (238, 108, 2)],
    ids=["the paper's detector", "a quarter of it"],
)
def test_the_scales_left_open_follow_the_detector(rows, columns, coarse):
    options = resolved_for(MeasureOptions(), rows, columns)
    assert options.scales == tuple(sorted({coarse, max(coarse // 2, 2), 2, 1}, reverse=True))
    assert scales(options.rigid) == [coarse, 2]
    assert scales(options.deformation) == [max(coarse // 2, 2), 2, 1]


@pytest.mark.parametrize(
    ("rows", "coarse"), [(1, 1), (100, 1), (199, 1), (200, 2), (399, 2), (400, 4), (1600, 16), (9999, 16)]
)
def test_the_coarse_scale_leaves_a_hundred_rows(rows, coarse):
    options = MeasureOptions(rigid=(StageOptions(scale="coarse"),))
    assert scales(resolved_for(options, rows, 432).rigid) == [coarse]


def test_what_is_given_stays():
    options = MeasureOptions(
        discard_rows=0,
        discard_columns=7,
        sections=12,
        rigid=(StageOptions(scale=3),),
        deformation=(StageOptions(solver=Pgd(most_modes=1)),),
    )
    assert resolved_for(options, 954, 432, (0, 7)).model_dump() == options.model_dump()


def test_no_row_left_out_is_not_a_row_left_open():
    grid = Grid(shape=(40, 20, 20), voxel_mm=0.1, origin_mm=(-0.95, -0.95, -1.95))
    hull = hull_of(np.ones(grid.shape, dtype=bool), grid, 4)
    assert used_window(scanner(120, 60), hull, 0, 0) == (0, 120, 0, 60)
    assert used_window(scanner(120, 60), hull, None, 0)[0] > 0


def test_resolving_twice_changes_nothing_more():
    once = resolved_for(MeasureOptions(), 500, 300)
    assert resolved_for(once, 500, 300) == once


@pytest.mark.parametrize("change", [{"discard_rows": 477}, {"discard_columns": 216}, {"discard_rows": 9999}])
def test_a_crop_that_leaves_nothing_is_refused_with_the_detector_s_size(change):
    with pytest.raises(
        ValueError, match="discard_rows, discard_columns: expected to leave some of 954 x 432 px"
    ) as at:
        check_discarded(MeasureOptions(**change), scanner(954, 432))
    assert "\n" not in str(at.value)
    assert str(next(iter(change.values()))) in str(at.value)


def test_a_crop_that_leaves_a_row_and_a_column_passes():
    check_discarded(MeasureOptions(discard_rows=476, discard_columns=215), scanner(954, 432))


@pytest.mark.parametrize("stages", [(), ({"scale": 2},), ({"scale": 1}, {"scale": 2}), ({"scale": "coarse"},)])
def test_the_last_stage_of_deformation_is_at_scale_1(stages):
    with pytest.raises(SettingsError, match="deformation: expected at least one stage, the last at scale 1") as at:
        MeasureOptions.parse({"deformation": list(stages)}, where="options")
    assert "{" not in str(at.value)


def test_a_measurement_without_a_rigid_stage_is_refused():
    with pytest.raises(SettingsError, match="rigid: expected at least one stage"):
        MeasureOptions.parse({"rigid": []}, where="options")


@pytest.mark.parametrize("scale", [0, 17, "fine", "2"])
def test_a_scale_that_is_none_is_refused(scale):
    with pytest.raises(SettingsError, match=r"rigid\.0\.scale"):
        MeasureOptions.parse({"rigid": [{"scale": scale}]}, where="options")


@pytest.mark.parametrize("names", [("rotation_w",), ()])
def test_unknown_motions_are_refused(names):
    with pytest.raises(ValidationError, match=r"some of translation_x, .*contraction"):
        MeasureOptions(section_motions=names)


def test_a_motion_that_stands_there_twice_is_refused():
    with pytest.raises(SettingsError, match="every motion once, rotation_x stands there twice"):
        MeasureOptions.parse({"section_motions": ["rotation_x", "translation_x", "rotation_x"]}, where="options")


@pytest.mark.parametrize(
    "options",
    [MeasureOptions(), paper_options(), resolved_for(MeasureOptions(), 954, 432)],
    ids=["defaults", "paper", "resolved"],
)
def test_a_template_reads_back_as_the_same_options(tmp_path, options):
    path = tmp_path / "options.toml"
    path.write_text(options.template(), encoding="utf-8")
    assert type(options).read(path) == options
    assert MeasureOptions.read(path).model_dump() == options.model_dump()


def test_the_paper_s_options_are_the_paper_s():
    options = paper_options()
    assert options.sections == 15
    assert options.section_motions == names_of(RIGID)
    assert options.time == PAPER
    assert options.rigid == (StageOptions(scale=2, solver=Pgd(most_modes=8, passes_per_mode=1)),)
    assert options.deformation == (StageOptions(scale=1, solver=Pgd(most_modes=4, passes_per_mode=1)),)
    assert options.weighting == "uniform"
    assert options.subtract_systematic
    assert options.smooth_px == 0
    assert not options.sharpen
    assert not options.remove_pattern


def test_by_default_the_last_stage_smooths_and_the_views_are_sharpened():
    options = MeasureOptions()
    assert [stage.solver.kind for stage in options.deformation] == ["gauss-newton", "gauss-newton", "smoother"]
    assert options.remove_pattern
    assert options.deformation[-1].scale == 1
    assert options.sharpen
