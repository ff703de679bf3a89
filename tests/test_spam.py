"""spam as a method: what its programs are handed, and how their answer is read; spam itself where it is installed."""

from __future__ import annotations

import shutil
import sys
import tomllib

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from pdvc.experiment import read_experiment
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.sections import SectionBasis, motions_named
from pdvc.volume import Grid, Volume, hull_of
from simulator.scanner import simulate
from simulator.scenario import Scenario
from simulator.truth import read_truth
from tests.tiny_scenarios import TINY
from validation.methods import spam as room
from validation.methods.registry import MethodError, find_method
from validation.methods.spam import PROGRAMS, Nodes, correlated, fitted, placed, union, with_air
from validation.scoring.scores import score

VOXEL_MM = 0.05

REGISTER = """
import sys
from pathlib import Path

import tifffile

assert tifffile.imread(sys.argv[1]).shape == tifffile.imread(sys.argv[2]).shape
status = {status}
if status is None:
    sys.exit("\\nTraceback\\nspam-reg: out of memory")
prefix = sys.argv[sys.argv.index("-pre") + 1]
header = "NodeNumber Zpos Ypos Xpos Zdisp Ydisp Xdisp error iterations returnStatus deltaPhiNorm".split()
row = [1, 0, 0, 0, 0, 0, 0, 0, 1, status, 0]
text = "\\t".join(header) + "\\n" + "\\t".join(map(str, row)) + "\\n"
Path(prefix + "-registration.tsv").write_text(text)
"""
CORRELATE = """
import sys
from pathlib import Path

import numpy as np
import tifffile

images = [tifffile.imread(name) for name in sys.argv[1:3]]
options = dict(zip(sys.argv[3::2], sys.argv[4::2], strict=True))
assert Path(options["-pf"]).is_file()
one, other = (np.array(np.unravel_index(image.argmax(), image.shape)) for image in images)
header = "NodeNumber Zpos Ypos Xpos Zdisp Ydisp Xdisp error iterations returnStatus deltaPhiNorm".split()
rows = [[1, *one, *(other - one), 0, 5, 2, 0], [2, *one, 9, 9, 9, 0, 50, 1, 1], [3, *one, 0, 0, 0, 0, 0, -5, 0]]
lines = ["\\t".join(header), *("\\t".join(map(str, row)) for row in rows)]
Path(options["-pre"] + "-ldic.tsv").write_text("\\n".join(lines) + "\\n")
"""


@pytest.fixture
def programs(tmp_path, monkeypatch):
    """Put programs in the place of spam's: they follow the brightest voxel, and take a status for the registration."""
    folder = tmp_path / "bin"
    folder.mkdir()

    def put(status):
        for name, text in (("spam-reg", REGISTER.replace("{status}", str(status))), ("spam-ldic", CORRELATE)):
            path = folder / name
            path.write_text(f"#!{sys.executable}\n{text}")
            path.chmod(0o755)
        monkeypatch.setattr(room, "program", lambda name: folder / name)

    return put


def volume(shape, first, bright):
    """Return ones on a grid from lattice point `first` (x, y, z) on, with one brighter voxel (z, y, x)."""
    values = np.ones(shape, dtype=np.float32)
    values[bright] = 2.0
    x, y, z = (VOXEL_MM * (at + 0.5) for at in first)
    grid = Grid(shape=shape, voxel_mm=VOXEL_MM, origin_mm=(x, y, z))
    return Volume(values=values, grid=grid, hull=hull_of(values > 0, grid, 4))


def test_without_spam_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        MethodError, match=r"expected the program spam-reg, found none: pip install 'pdvc-bench\[spam\]'"
    ):
        find_method("spam").check()


def test_programs_beside_this_python_are_found_before_those_of_the_path(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "own" / "python"))
    monkeypatch.setenv("PATH", str(tmp_path / "other"))
    for place in ("other", "own"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "spam-ldic").touch(mode=0o755)
        assert room.program("spam-ldic") == tmp_path / place / "spam-ldic"


def test_volumes_come_onto_one_lattice():
    one, other = volume((4, 5, 6), (0, 0, 0), (1, 2, 3)), volume((3, 9, 4), (2, -3, -1), (0, 0, 0))
    grid = union(one.grid, other.grid)
    assert grid.shape == (5, 9, 6)
    np.testing.assert_allclose(grid.origin_mm, np.array([0.5, -2.5, -0.5]) * VOXEL_MM)
    wide = with_air(grid)
    assert wide.shape == (5, 9 + 6, 6 + 4)
    for each in (one, other):
        whole = placed(each, wide)
        assert whole.sum() == each.values.sum()
        # the brightest voxel keeps its place, mm
        at = [np.array(np.unravel_index(values.argmax(), values.shape)) for values in (whole, each.values)]
        place = [np.array(g.origin_mm) + VOXEL_MM * k[::-1] for g, k in zip((wide, each.grid), at, strict=True)]
        np.testing.assert_allclose(place[0], place[1], atol=1e-12)


def test_nodes_are_read_in_the_frame_of_the_volumes(tmp_path, programs):
    programs(2)
    one, other = volume((9, 8, 7), (0, 0, 0), (4, 3, 2)), volume((9, 8, 7), (1, 0, 0), (6, 2, 2))
    nodes = correlated(one, other, tmp_path, 5)
    # only the node that converged; the one in air was not tried
    assert nodes.tried == 2
    np.testing.assert_allclose(nodes.point_mm, [np.array([2.5, 3.5, 4.5]) * VOXEL_MM])
    np.testing.assert_allclose(nodes.displacement_voxel, [[1, -1, 2]])
    # grey levels of about one
    assert np.median(tifffile.imread(tmp_path / "reference.tif")[:, 3:-3, 3:-3]) == pytest.approx(1)


@pytest.mark.parametrize("status", [1, -1])
def test_a_sample_that_is_not_found_again_gives_nothing(tmp_path, programs, status):
    programs(status)
    one = volume((9, 8, 7), (0, 0, 0), (4, 3, 2))
    assert correlated(one, one, tmp_path, 5) is None


def test_a_program_that_fails_is_told_in_one_line(tmp_path, programs):
    programs(None)
    one = volume((9, 8, 7), (0, 0, 0), (4, 3, 2))
    with pytest.raises(
        ValueError, match="spam-reg: expected it to end well, it ended with 1: spam-reg: out of memory"
    ):
        correlated(one, one, tmp_path, 5)


BASIS = SectionBasis(
    height_mm=np.array([-1.0, 0.0, 1.2, 2.0]),
    radius_mm=0.4,
    motions=motions_named(("translation_x", "translation_z", "rotation_y", "contraction")),
)


def nodes_of(amplitude, low, high, *, noise=0.0):
    """Return nodes whose displacement is exactly that of a motion, at places that they have come to."""
    rng = np.random.default_rng(3)
    current = rng.uniform([-0.4, -0.3, low], [0.4, 0.3, high], size=(400, 3))
    moved = BASIS.displacement(amplitude, current)
    return Nodes(
        point_mm=current - VOXEL_MM * moved, displacement_voxel=moved + noise * rng.normal(size=moved.shape), tried=400
    )


def test_the_sections_motion_is_found_in_its_nodes():
    amplitude = np.random.default_rng(4).normal(scale=3, size=BASIS.shape)
    found, observed, misfit = fitted(BASIS, nodes_of(amplitude, -1.5, 2.5), VOXEL_MM, 30.0)
    np.testing.assert_allclose(found, amplitude, atol=1e-5)
    assert observed.all()
    assert misfit < 1e-9


def test_the_fit_averages_the_noise_of_nodes():
    amplitude = np.zeros(BASIS.shape)
    found, _, misfit = fitted(BASIS, nodes_of(amplitude, -1.0, 2.0, noise=0.05), VOXEL_MM, 30.0)
    assert misfit == pytest.approx(0.05, rel=0.1)
    assert np.abs(found[:, :2]).max() < 0.03


def test_a_section_without_nodes_is_unobserved_and_rests_on_the_prior():
    amplitude = np.random.default_rng(5).normal(scale=3, size=BASIS.shape)
    found, observed, _ = fitted(BASIS, nodes_of(amplitude, -1.0, -0.02), VOXEL_MM, 30.0)
    np.testing.assert_array_equal(observed, [True, True, False, False])
    np.testing.assert_allclose(found[:2], amplitude[:2], atol=1e-4)
    assert not found[2:].any()


def test_without_any_node_nothing_is_observed():
    empty = Nodes(point_mm=np.empty((0, 3)), displacement_voxel=np.empty((0, 3)), tried=7)
    found, observed, _ = fitted(BASIS, empty, VOXEL_MM, 30.0)
    assert not found.any()
    assert not observed.any()


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """Return the folder of a tiny experiment with two interrupted scans."""
    folder = tmp_path_factory.mktemp("held") / "experiment"
    values = tomllib.loads(TINY) | {"interrupted": {"steps": [12, 24]}}
    values["acquisition"] = {**values["acquisition"], "reference_views": 24}
    simulate(Scenario.parse(values, where="tiny"), folder, workers=1)
    return folder


def test_the_method_measures_the_scans_that_spam_finds(held, tmp_path, monkeypatch, programs):
    programs(2)
    truth, asked = read_truth(held), []

    def follow(reference, deformed, folder, spacing):
        """Answer with the true motion at the first scan, and with nothing at the second."""
        asked.append((reference.values.shape, deformed.values.shape, spacing))
        if len(asked) == 2:
            return None
        return Nodes(point_mm=truth.point_mm, displacement_voxel=truth.displacement_mm[12] / 0.0856, tried=500)

    monkeypatch.setattr(room, "correlated", follow)
    method = find_method("spam")
    assert method.looks_at == "volumes"
    measurement = method.measure(read_experiment(held))
    assert "step 12: 405 of 500 nodes converged" in measurement.fit.stages[0].stop_reason
    assert "step 24: spam-reg did not converge" in measurement.fit.stages[0].stop_reason
    assert {spacing for _, _, spacing in asked} == {5}  # half the distance of two sections
    known = np.isfinite(measurement.motion.amplitude[:, measurement.motion.observed]).all(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(known), [12])
    scores = score(measurement, truth)
    for name in ("across_beam", "vertical", "along_beam"):
        # 15 sections between which the truth bends a little
        assert getattr(scores.error_voxel, name) < 0.01
    write_measurement(measurement, tmp_path / "m.nc")
    np.testing.assert_array_equal(read_measurement(tmp_path / "m.nc").motion.amplitude, measurement.motion.amplitude)


def test_where_spam_finds_nothing_the_method_says_so(held, monkeypatch, programs):
    programs(2)
    monkeypatch.setattr(room, "correlated", lambda *_: None)
    with pytest.raises(ValueError, match="step 12: spam-reg did not converge; step 24"):
        find_method("spam").measure(read_experiment(held))


@pytest.mark.skipif(not all(shutil.which(name) for name in PROGRAMS), reason="spam is not installed")
def test_spam_itself_finds_a_known_motion(tmp_path):
    """A textured bar, stretched by 2 % and moved by some voxels: what its displacements mean, and their size."""
    shape = (80, 60, 56)
    texture = ndimage.gaussian_filter(np.random.default_rng(8).normal(size=shape), 1.5)
    _, y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in shape), indexing="ij")
    bar = ndimage.gaussian_filter(((np.abs(x) < 14) & (np.abs(y) < 16)).astype(float), 1.0)
    values = (bar * (1 + 0.3 * texture / texture.std())).astype(np.float32)
    shift, stretch = np.array([2.4, -1.3, 0.6]), 0.02  # x, y, z, voxels

    def inverse(index):
        centre = (shape[0] - 1) / 2
        return [(index[0] - centre - shift[2]) / (1 + stretch) + centre, index[1] - shift[1], index[2] - shift[0]]

    moved = ndimage.map_coordinates(values, inverse(np.indices(shape).astype(float)), order=3, mode="nearest")
    grid = Grid.around(-np.array(shape[::-1]) / 2 * VOXEL_MM, np.array(shape[::-1]) / 2 * VOXEL_MM, VOXEL_MM)
    volumes = [
        Volume(values=v.astype(np.float32), grid=grid, hull=hull_of(bar > 0.1, grid, 4)) for v in (values, moved)
    ]
    nodes = correlated(*volumes, tmp_path, 8)
    assert len(nodes.point_mm) > 20
    true = np.broadcast_to(shift, nodes.point_mm.shape).copy()
    true[:, 2] += stretch * nodes.point_mm[:, 2] / VOXEL_MM
    inside = np.abs(nodes.point_mm[:, 2]) < 1.2
    np.testing.assert_allclose(nodes.displacement_voxel[inside], true[inside], atol=0.1)
