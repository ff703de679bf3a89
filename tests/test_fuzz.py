"""Whatever is in a file is read or refused in one line; whatever is in a folder is measured or refused.

A few examples each; FUZZ=50 in the environment tries fifty times as many, as `make faults` does.
"""

from __future__ import annotations

import copy
import datetime
import math
import os
import shutil
import tomllib
import warnings
from contextlib import suppress

import numpy as np
import pytest
import tifffile
import tomlkit
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.faults import SCENARIO, STUDY
from pdvc.experiment import Description, ExperimentError, read_experiment
from pdvc.measurement_file import read_measurement
from pdvc.options import MeasureOptions
from pdvc.result_checks import check_finite
from pdvc.settings import SettingsError
from simulator.scanner import simulate
from simulator.scenario import load_scenario
from tests.command_line import pdvc_bench
from validation.study.description import Study, trials_of

MORE = int(os.environ.get("FUZZ", "1"))
STACKS = ("reference/radiographs.tif", "test/radiographs.tif", "flats.tif", "darks.tif")
FEW = """
sections = 5
time = [{ kind = "force" }, { kind = "angle" }, { kind = "polynomial" }]
rigid = [{ scale = 2, solver = { kind = "gauss-newton", most_passes = 2 } }]
deformation = [{ solver = { kind = "gauss-newton", most_passes = 2 } }]
"""


def often(examples):
    return settings(
        deadline=None,
        max_examples=examples * MORE,
        suppress_health_check=[HealthCheck.too_slow],
        derandomize=MORE == 1,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return an experiment folder as it should be, with the files that are read beside it."""
    above = tmp_path_factory.mktemp("fuzz")
    simulate(load_scenario(SCENARIO), above / "experiment", workers=1)
    shutil.rmtree(above / "experiment" / "truth")
    (above / "description.toml").write_bytes((above / "experiment" / "experiment.toml").read_bytes())
    (above / "options.toml").write_text(MeasureOptions().template())
    (above / "scenario.toml").write_text(load_scenario(SCENARIO).template())
    (above / "faults.toml").write_bytes(SCENARIO.read_bytes())
    (above / "study.toml").write_bytes(STUDY.read_bytes())
    (above / "few.toml").write_text(FEW)
    return above


READERS = {
    "description": Description.read,
    "options": MeasureOptions.read,
    "scenario": load_scenario,
    "study": lambda path: trials_of(Study.read(path), path),
}
AWKWARD = (
    *(math.nan, math.inf, -math.inf, 0, 0.0, -0.0, -1, -1.0, 1e-300, 1e300, -1e300, 5e-324, 2**31, 2**63, 2**70),
    *("", "nan", "coarse", True, [], [[]], {}, {"a": 1}, [math.nan], [0.0] * 100, datetime.date(2018, 7, 4)),
)


def awkward():
    """Draw a value that hardly any key expects."""
    return st.sampled_from(AWKWARD) | st.floats() | st.integers() | st.text(max_size=6) | st.lists(st.floats())


def places(values, above=()):
    """Yield the paths to all values within nested tables and lists, long lists by their first three."""
    parts = values.items() if isinstance(values, dict) else enumerate(values[:3])
    for key, value in parts:
        yield (*above, key)
        if isinstance(value, dict | list):
            yield from places(value, (*above, key))


@st.composite
def changed(draw, values):
    """Draw nested values with a few of them replaced, removed, added or repeated."""
    values = copy.deepcopy(values)
    for _ in range(draw(st.integers(1, 3))):
        *above, key = draw(st.sampled_from(sorted(places(values), key=str)))
        part = values
        for name in above:
            part = part[name]
        how = draw(st.sampled_from(["replace", "replace", "remove", "add", "repeat"]))
        if how == "remove":
            del part[key]
        elif how == "replace":
            part[key] = draw(awkward())
        elif isinstance(part, dict):
            part["colour"] = draw(awkward())
        else:
            part.extend(part[:1] if how == "repeat" else [draw(awkward())])
        if not values:
            break
    return values


@st.composite
def damaged(draw, content):
    """Draw bytes with some of them flipped, cut off at the end, or left out or put in between."""
    content = bytearray(content)
    how = draw(st.sampled_from(["flip", "flip", "cut", "remove", "insert"]))
    place = draw(st.integers(0, len(content) - 1) | st.integers(0, min(len(content) - 1, 400)))
    if how == "flip":
        for _ in range(draw(st.integers(1, 8))):
            content[place] ^= draw(st.integers(1, 255))
            place = draw(st.integers(0, len(content) - 1))
    elif how == "cut":
        del content[place:]
    elif how == "remove":
        del content[place : place + draw(st.integers(1, 100))]
    else:
        content[place:place] = draw(st.binary(min_size=1, max_size=20))
    return bytes(content)


def one_line(read, place):
    """Return what is read; None where it is refused, which has to be told in one line that names the place."""
    try:
        return read()
    except (SettingsError, ExperimentError) as error:
        text = str(error)
    assert str(place) in text
    assert "\n" not in text
    return None


def finite(values):
    """Return whether all numbers of a record are finite."""
    if isinstance(values, dict):
        return all(finite(part) for part in values.values())
    if isinstance(values, list | tuple):
        return all(finite(part) for part in values)
    return not isinstance(values, float) or math.isfinite(values)


@pytest.mark.parametrize("kind", READERS)
@often(60)
@given(data=st.data())
def test_values_of_any_kind_are_read_or_refused(folder, kind, data):
    values = tomllib.loads((folder / f"{kind}.toml").read_text())
    path = folder / f"{kind}-changed.toml"
    path.write_text(tomlkit.dumps(data.draw(changed(values))), encoding="utf-8")
    found = one_line(lambda: READERS[kind](path), path.parent)
    if kind == "study":
        found = None if found is None else [each.scenario.model_dump() | each.options.model_dump() for each in found]
    assert finite(found if found is None or kind == "study" else found.model_dump())


@pytest.mark.parametrize("kind", READERS)
@often(60)
@given(data=st.data())
def test_bytes_of_any_kind_are_read_or_refused(folder, kind, data):
    path = folder / f"{kind}-damaged.toml"
    path.write_bytes(data.draw(damaged((folder / f"{kind}.toml").read_bytes())))
    one_line(lambda: READERS[kind](path), path.parent)


@pytest.mark.parametrize("kind", READERS)
def test_a_byte_order_mark_changes_nothing(folder, kind):
    path = folder / f"{kind}-marked.toml"
    path.write_bytes(b"\xef\xbb\xbf" + (folder / f"{kind}.toml").read_bytes())
    assert READERS[kind](path) == READERS[kind](folder / f"{kind}.toml")


@pytest.mark.parametrize(
    "text", ["a = " + "9" * 5000, "a = " + "[" * 5000, "a = 1979-05-27T07:32:00Z", "\x00", "[a]\n[a]"]
)
def test_toml_that_is_out_of_the_ordinary_is_refused(folder, text):
    path = folder / "odd.toml"
    path.write_text(text)
    assert one_line(lambda: MeasureOptions.read(path), path) is None


@st.composite
def stacks(draw):
    """Draw a stack of another size, of another kind of numbers, or stored in another way."""
    shape = draw(st.lists(st.integers(1, 40), min_size=2, max_size=4))
    kind = draw(st.sampled_from(["uint16", "uint8", "float32", "int16", "uint32"]))
    how = draw(st.sampled_from([{}, {"photometric": "minisblack"}, {"compression": "zlib"}, {"metadata": None}]))
    return np.zeros(shape, dtype=kind), how


def other_folder(folder, name="other"):
    """Return a new copy of the experiment folder, whose stacks are links to the first until they are replaced."""
    other = folder / name
    shutil.rmtree(other, ignore_errors=True)
    shutil.copytree(folder / "experiment", other, copy_function=os.link)
    return other


def replaced(path, content):
    """Write a file in place of a link."""
    path.unlink()
    path.write_bytes(content)


@st.composite
def broken_folder(draw, folder, name="other"):
    """Draw a folder in which one or two things are not as they should be."""
    other = other_folder(folder, name)
    for _ in range(draw(st.integers(1, 2))):
        stack = other / draw(st.sampled_from(STACKS))
        how = draw(st.sampled_from(["values", "bytes", "stack", "counts", "damage", "swap"]))
        if how == "values":
            values = tomllib.loads((folder / "description.toml").read_text())
            replaced(other / "experiment.toml", tomlkit.dumps(draw(changed(values))).encode())
        elif how == "bytes":
            replaced(other / "experiment.toml", draw(damaged((folder / "description.toml").read_bytes())))
        elif how == "stack":
            images, kind = draw(stacks())
            stack.unlink()
            # tifffile refuses some shapes, and warns of what it will do with others
            with suppress(ValueError), warnings.catch_warnings(action="ignore", category=DeprecationWarning):
                tifffile.imwrite(stack, images, **kind)
        elif how == "counts":
            counts = tifffile.imread(folder / "experiment" / stack.relative_to(other)).copy()
            counts[draw(st.integers(0, len(counts) - 1)) :] = draw(st.sampled_from([0, 1, 1000, 65535]))
            stack.unlink()
            tifffile.imwrite(stack, counts, photometric="minisblack")
        elif how == "damage":
            replaced(stack, draw(damaged((folder / "experiment" / stack.relative_to(other)).read_bytes())))
        else:
            replaced(stack, (folder / "experiment" / draw(st.sampled_from(STACKS))).read_bytes())
    return other


@often(100)
@given(data=st.data())
def test_a_folder_is_read_whole_or_refused(folder, data):
    other = data.draw(broken_folder(folder))
    found = one_line(lambda: read_experiment(other), other)
    if found is None:
        return
    rows, columns = found.geometry.rows, found.geometry.columns
    for stack in (found.reference.counts, found.test.counts, found.flats, found.darks):
        assert np.asarray(stack).shape[1:] == (rows, columns)
        assert stack.dtype.newbyteorder("=") == np.uint16
    for series in (found.reference, found.test):
        assert len(series.counts) == len(series.angle_rad) == len(series.time_s) == len(series.force_N)


@often(12)
@given(data=st.data())
def test_a_folder_is_measured_in_finite_numbers_or_refused(folder, data):
    measured(folder, data.draw(broken_folder(folder)))


def measured(folder, other):
    """Measure a folder by the command line, and check that it ends in a result or in one line."""
    out = folder / "m.nc"
    out.unlink(missing_ok=True)
    result = pdvc_bench("measure", other, "-o", out, "--options", folder / "few.toml")
    assert not out.with_name("m.nc.work").exists()
    if result.exit_code in (0, 3):  # 3: measured, and called failed
        check_finite(read_measurement(out))
        return
    assert result.exit_code == 2, result.stderr
    assert not out.exists()
    errors = [line for line in result.stderr.splitlines() if " of " not in line or line.startswith("error")]
    assert len(errors) == 1, result.stderr
    assert errors[0].startswith("error: ")
