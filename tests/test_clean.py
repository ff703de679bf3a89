"""Noise-free radiographs are shared by all scenarios that differ in noise alone, and change no count."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from pdvc.experiment import DARKS, FLATS, REFERENCE, TEST, interrupted_stack, read_experiment
from pdvc.settings import Settings
from simulator.clean import clean_file, clean_stack
from simulator.images import prepare
from simulator.scanner import simulate
from simulator.scenario import course_of
from simulator.stacks import Stack, clear_images, image_count
from tests.tiny_scenarios import tinier

ALL = (REFERENCE, TEST, FLATS, DARKS, interrupted_stack(0))
REST, LOADED, HELD = STACKS = (Stack("reference"), Stack("test"), Stack("interrupted", 12))


CRACK = {"opening_mm": 0.2, "centre_mm": [0.1, 0.03, 0.2], "tilt_deg": 5.0, "first_step": 10, "opening_steps": 5}


def tiny(**changes):
    return tinier(interrupted={"steps": [12], "views": 6}, **{"crack": CRACK, **changes})


def stacks(folder):
    return [tifffile.imread(folder / name) for name in ALL]


def test_counts_are_those_without_kept_images(tmp_path):
    noisy = tiny(detector={"photons_per_pixel": 500.0, "frames": 2}, repetition=3)
    simulate(tiny(), tmp_path / "first", clean=tmp_path / "clean", workers=2)
    kept = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "clean").iterdir()}
    assert sorted(name.split("-")[0] for name in kept) == ["interrupted", "reference", "test"]
    simulate(noisy, tmp_path / "second", clean=tmp_path / "clean", workers=1)
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "clean").iterdir()} == kept
    for scenario, shared in ((tiny(), "first"), (noisy, "second")):
        simulate(scenario, tmp_path / f"{shared} alone", workers=1)
        for one, two in zip(stacks(tmp_path / shared), stacks(tmp_path / f"{shared} alone"), strict=True):
            np.testing.assert_array_equal(one, two)


def test_a_stack_is_computed_only_if_it_is_not_there(tmp_path):
    first = clean_stack(tiny(), LOADED, tmp_path, workers=1)
    idle = lambda *_: pytest.fail("nothing is left to compute")  # noqa: E731 - short
    again = clean_stack(tiny(repetition=1), LOADED, tmp_path, progress=idle)
    np.testing.assert_array_equal(first, again)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("left", [0, 40, 0.5, 0.999])
def test_a_stack_that_was_cut_short_is_computed_again(tmp_path, left):
    first = np.array(clean_stack(tiny(), LOADED, tmp_path, workers=1))
    path = tmp_path / clean_file(tiny(), LOADED)
    content = path.read_bytes()
    path.write_bytes(content[: left if isinstance(left, int) else int(left * len(content))])
    np.testing.assert_array_equal(clean_stack(tiny(), LOADED, tmp_path, workers=1), first)
    assert path.read_bytes() == content


def test_a_full_disk_is_an_error_and_not_the_end_of_the_process(tmp_path):
    """A file written through a memory map would end it with a signal."""
    code = (
        "import resource, pathlib, sys; from tests.test_clean import LOADED, clean_stack, tiny\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "try: clean_stack(tiny(), LOADED, pathlib.Path(sys.argv[1]), workers=1)\n"
        "except OSError as error: sys.exit(error.errno)"
    )
    found = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False, cwd=Path(__file__).parent.parent)
    assert found.returncode == errno.EFBIG
    assert not list(tmp_path.iterdir())


def test_what_changes_the_test_alone_shares_the_reference_scan():
    for changes in (
        {"motion": {"torsion": {"angle_deg": 1.0}}},
        {"acquisition": {"steps_per_turn": 7}},
        {"loading": {"plateau_steps": 5}},
        {"crack": {**CRACK, "first_step": 11}},
    ):
        same = {stack: clean_file(tiny(), stack) == clean_file(tiny(**changes), stack) for stack in STACKS}
        assert same == {REST: True, LOADED: False, HELD: False}


def leaves(record: Settings, path: tuple[str, ...] = ()):
    for name in type(record).model_fields:
        value = getattr(record, name)
        if isinstance(value, Settings):
            yield from leaves(value, (*path, name))
        else:
            yield (*path, name), value


def other(path: tuple[str, ...], value: Any) -> Any:
    """Return another valid value of a field of the tiny scenario."""
    special = {
        "spectrum": "w180_al1.0",
        "thinned": "x",
        "ingredients": ["tension"],
        "length_mm": 14.0,
        "facet_mm": 0.1,
        "rows": 41,
        "columns": 25,
        "direction_deg": 31.0,
        "sections": 5,
        "steps": [12, 13],
        "view_s": 3.0,
    }
    if path[-1] in special:
        return special[path[-1]]
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return value + "x"
    if isinstance(value, int):
        return value + 1
    if isinstance(value, tuple):
        return [part + 0.01 for part in value]
    return value * 0.95 if value else 0.04


def changed(path: tuple[str, ...], value: Any):
    values: Any = tiny().model_dump(mode="json")
    part = values
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    return type(tiny()).parse(values, where="changed")


def images(scenario):
    bench = prepare(scenario, course_of(scenario))
    return {stack: clear_images(bench, stack)(image_count(scenario, stack) - 1) for stack in STACKS}


def test_every_field_on_which_an_image_depends_changes_its_key():
    first = images(tiny())
    touched = {stack: set() for stack in STACKS}
    for path, value in leaves(tiny()):
        scenario = changed(path, other(path, value))
        same_key = {stack: clean_file(tiny(), stack) == clean_file(scenario, stack) for stack in STACKS}
        if any(same_key.values()):
            found = images(scenario)
            for stack in STACKS:
                if same_key[stack]:
                    np.testing.assert_array_equal(found[stack], first[stack], err_msg=f"{stack}: {path}")
        for stack in STACKS:
            if not same_key[stack]:
                touched[stack].add(path[-1])
    for noise in ("photons_per_pixel", "frames", "readout_noise_counts", "repetition", "flats", "gain_spread"):
        assert noise not in touched[REST] | touched[LOADED] | touched[HELD]
    assert {"blur_px", "seed", "volume_fraction", "lean_deg", "reference_views"} <= touched[REST]
    assert {"blur_px", "seed", "plateau_N", "steps_per_turn", "angle_deg"} <= touched[LOADED]


class TestRepetition:
    def test_another_one_has_other_noise_of_the_same_sample_and_detector(self, tmp_path):
        quiet = {"photons_per_pixel": 1e9, "readout_noise_counts": 0.0, "bad_pixel_fraction": 0.05}
        folders = [tmp_path / str(k) for k in range(2)]
        for k, folder in enumerate(folders):
            simulate(tiny(repetition=k, detector=quiet), folder, clean=tmp_path / "clean")
        for one, two in zip(*(stacks(folder)[:3] for folder in folders), strict=True):
            assert not np.array_equal(one, two)
            # photon noise is 40000 / sqrt(5e9) = 0.6 counts, and rounding adds as much: same gains, same bad pixels
            assert np.abs(one.astype(float) - two).max() < 8
        forces = [read_experiment(folder).test.force_N for folder in folders]
        assert 0 < np.abs(forces[0] - forces[1]).max() < 8

    def test_noise_of_two_repetitions_is_independent(self, tmp_path):
        still = {"motion": {"ingredients": []}, "acquisition": {"steps_per_turn": 20}, "crack": {}}
        noise = []
        for k in (1, 2):
            simulate(tiny(repetition=k, **still), tmp_path / str(k), clean=tmp_path / "clean")
            reference, test = stacks(tmp_path / str(k))[:2]
            noise.append((reference.astype(float) - test).ravel())
        # without motion the difference of the stacks is noise; bad pixels are equal in both
        drawn = (noise[0] != 0) | (noise[1] != 0)
        assert drawn.sum() > 15000
        assert abs(np.corrcoef(noise[0][drawn], noise[1][drawn])[0, 1]) < 5 / np.sqrt(drawn.sum())


REAL = {
    "stage": {"angle_jitter_deg": 0.05},
    "focal_spot": {"size_mm": 0.2, "drift_mm": [0.01, 0.0, 0.0]},
    "scatter": {"ratio": 0.1},
    "open_beam": {"current_spread": 0.01, "drift_per_hour": 0.1, "target_attenuation": 0.1, "anode_deg": 30.0},
    "panel": {"scintillator_blur_px": 0.3, "gain_drift_per_hour": 0.1, "nonlinearity": 0.02, "bad_columns": 1},
    "lag": {"share": 0.1, "afterglow_share": 0.02},
}


def test_counts_of_a_real_scanner_are_those_without_kept_images(tmp_path):
    real = tiny(scanner=REAL)
    simulate(real, tmp_path / "kept", clean=tmp_path / "clean", workers=2)
    simulate(real, tmp_path / "alone", workers=3)
    for one, two in zip(stacks(tmp_path / "kept"), stacks(tmp_path / "alone"), strict=True):
        np.testing.assert_array_equal(one, two)
    simulate(tiny(), tmp_path / "ideal", clean=tmp_path / "clean", workers=2)
    for name, one, two in zip(ALL, stacks(tmp_path / "kept"), stacks(tmp_path / "ideal"), strict=True):
        assert np.array_equal(one, two) == (name == DARKS)


def test_a_real_scanner_that_was_interrupted_goes_on_to_the_same_counts(tmp_path):
    def interrupt(name, done, total):
        if (name, done) == ("test", 7):
            raise KeyboardInterrupt

    real = tiny(scanner=REAL)
    with pytest.raises(KeyboardInterrupt):
        simulate(real, tmp_path / "cut", progress=interrupt, workers=2)
    simulate(real, tmp_path / "cut", workers=1)
    simulate(real, tmp_path / "whole", workers=2)
    for one, two in zip(stacks(tmp_path / "cut"), stacks(tmp_path / "whole"), strict=True):
        np.testing.assert_array_equal(one, two)


def test_what_comes_with_the_noise_shares_images_and_what_drifts_depends_on_the_time():
    drifting = {"focal_spot": {"drift_mm": [0.01, 0.0, 0.0]}}
    sooner = {"acquisition": {"reference_view_s": 1.0}}
    for stack in STACKS:
        noise = {part: REAL[part] for part in ("open_beam", "lag")}
        noise["panel"] = {**REAL["panel"], "scintillator_blur_px": 0.0}
        assert clean_file(tiny(scanner=noise), stack) == clean_file(tiny(), stack)
        assert clean_file(tiny(**sooner), stack) == clean_file(tiny(), stack)
        assert clean_file(tiny(scanner=drifting, **sooner), stack) != clean_file(tiny(scanner=drifting), stack)
