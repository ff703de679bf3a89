"""Intermediate results: made once, kept whole, and never those of anything else.

Every field of the experiment and of the options is varied, as their types list them: a new one cannot be forgotten.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc import sections
from pdvc.digest import digest
from pdvc.experiment import Experiment, InterruptedScan, Series
from pdvc.geometry import ConeBeam
from pdvc.history import TimeFunction
from pdvc.options import MeasureOptions
from pdvc.protocol import measure
from pdvc.sections import SectionPattern
from pdvc.settings import Settings
from pdvc.store import Store, experiment_digest, reference_digest
from validation.batch.trial import LeastError, Trial
from validation.testing.small_cases import SmallExperiment, small_scenario

GEOMETRY = ConeBeam(source_axis_mm=20, source_detector_mm=40, pixel_mm=0.1, rows=3, columns=4)
WITHOUT_EFFECT = {"title", "material"}
"""Fields of an experiment that only a reader looks at."""
TEST_ALONE = {"test", "interrupted"}
"""Fields of an experiment that a reconstruction of the reference scan does not see."""


def series(images: int) -> Series:
    return Series(
        counts=np.arange(images * 12, dtype=np.uint16).reshape(images, 3, 4),
        angle_rad=np.linspace(0, 3, images),
        time_s=np.arange(images, dtype=float),
        force_N=np.full(images, 7.0),
    )


def experiment() -> Experiment:
    return Experiment(
        title="a test",
        material="iron",
        geometry=GEOMETRY,
        frames=2,
        photons_per_count=3.0,
        readout_noise_counts=None,
        reference=series(20),
        test=series(9),
        flats=series(2).counts,
        darks=series(1).counts,
        interrupted=(InterruptedScan(step=4, series=series(5)),),
    )


def every_options() -> MeasureOptions:
    """Return options in which every kind of time function occurs."""
    ours = [kind for kind in TimeFunction.kinds() if kind.__module__ == TimeFunction.__module__]
    assert len(ours) == 7
    return MeasureOptions(time=tuple(kind() for kind in ours))


Path = tuple[str | int, ...]


def leaves(value: Any, path: Path = ()) -> Iterator[Path]:
    """Yield the path of every field that is no record itself, within records and tuples of them."""
    if is_dataclass(value):
        names: Any = [each.name for each in fields(value)]
    elif isinstance(value, Settings):
        names = list(type(value).model_fields)
    elif isinstance(value, tuple) and value:
        for place, part in enumerate(value):
            yield from leaves(part, (*path, place))
        return
    else:
        yield path
        return
    for name in names:
        yield from leaves(getattr(value, name), (*path, name))


def changed(value: Any, path: Path, element: int = 0) -> Any:
    """Return a record that differs in one field, by as little as can be."""
    if path:
        head, *rest = path
        if isinstance(value, tuple):
            assert isinstance(head, int)
            return (*value[:head], changed(value[head], tuple(rest), element), *value[head + 1 :])
        part = {str(head): changed(getattr(value, str(head)), tuple(rest), element)}
        return value.model_copy(update=part) if isinstance(value, Settings) else replace(value, **part)
    if isinstance(value, np.ndarray):
        other = value.copy()
        flat = other.reshape(-1)
        k = element % flat.size
        flat[k] = flat[k] + 1 if other.dtype.kind == "u" else np.nextafter(flat[k], np.inf)
        return other
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return float(np.nextafter(value, np.inf))
    return "other" if isinstance(value, str) else 1.0  # not given, or an empty tuple


def name_of(path: Path) -> str:
    return ".".join(map(str, path))


@pytest.mark.parametrize("path", list(leaves(experiment())), ids=name_of)
@given(element=st.integers(0, 10_000))
@settings(max_examples=10)
def test_another_value_in_any_field_of_an_experiment_is_another_experiment(path, element):
    """Of an array any element: a digest of a sample of the counts once let a replaced radiograph pass."""
    here, other = experiment(), changed(experiment(), path, element)
    assert (experiment_digest(other) != experiment_digest(here)) == (path[0] not in WITHOUT_EFFECT)
    seen_by_the_reference = path[0] not in WITHOUT_EFFECT | TEST_ALONE
    assert (reference_digest(other) != reference_digest(here)) == seen_by_the_reference


@pytest.mark.parametrize("path", list(leaves(every_options())), ids=name_of)
def test_another_value_of_any_option_is_another_key(tmp_path, path):
    make, store = Maker(), Store(tmp_path, experiment())
    for options in (every_options(), changed(every_options(), path)):
        store.arrays("stage", (options,), make)
    assert make.calls == 2


def test_equal_values_have_equal_digests_whatever_holds_them():
    assert digest(every_options()) == digest(every_options())
    assert experiment_digest(experiment()) == experiment_digest(experiment())


def test_values_that_print_alike_are_told_apart():
    long = np.zeros(2000)
    other = long.copy()
    other[1000] = 1  # numpy prints the ends alone
    assert repr(long) == repr(other)
    assert digest(long) != digest(other)
    assert digest(0.1 + 0.2) != digest(0.3)
    assert digest("a", "b") != digest("ab", "")
    assert digest(1) != digest(1.0) != digest("1") != digest(True)
    assert digest(np.zeros((2, 3))) != digest(np.zeros((3, 2))) != digest(np.zeros((3, 2), dtype=np.float32))
    with pytest.raises(TypeError, match="got object"):
        digest(object())


class Maker:
    """Count how often it is asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"values": np.full(3, float(self.calls)), "text": np.array("why")}


def test_what_was_made_once_is_read_afterwards(tmp_path):
    make = Maker()
    first = Store(tmp_path, experiment()).arrays("volume", (1,), make)
    again = Store(tmp_path, experiment()).arrays("volume", (1,), make)
    assert make.calls == 1
    np.testing.assert_array_equal(first["values"], again["values"])
    assert str(again["text"]) == "why"


def test_other_software_makes_it_anew(tmp_path, monkeypatch):
    make = Maker()
    Store(tmp_path, experiment()).arrays("volume", (1,), make)
    monkeypatch.setattr("pdvc.store.software", lambda *packages: "another version")
    Store(tmp_path, experiment()).arrays("volume", (1,), make)
    assert make.calls == 2


def test_what_depends_on_the_reference_scan_alone_is_found_by_another_test_of_the_same_sample(tmp_path):
    make = Maker()
    for test in (series(9), series(10)):
        Store(tmp_path, replace(experiment(), test=test)).of_reference("volume", (1,), make)
    assert make.calls == 1


@given(place=st.floats(0, 1, exclude_max=True), cut=st.booleans(), flip=st.integers(1, 255))
@settings(max_examples=60, deadline=None)
def test_a_kept_file_that_is_cut_short_or_damaged_is_made_again(tmp_path_factory, place, cut, flip):
    folder, make = tmp_path_factory.mktemp("store"), Maker()
    Store(folder, experiment()).arrays("volume", (1,), make)
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    k = int(place * len(content))
    if cut:
        content = content[:k]
    else:
        content[k] ^= flip
    path.write_bytes(content)
    again = Store(folder, experiment()).arrays("volume", (1,), make)
    assert make.calls == 2
    np.testing.assert_array_equal(again["values"], np.full(3, 2.0))


def test_without_a_folder_nothing_is_kept():
    make = Maker()
    store = Store(None, experiment())
    store.arrays("volume", (1,), make)
    store.arrays("volume", (1,), make)
    assert make.calls == 2


def test_an_interruption_leaves_nothing_that_looks_whole(tmp_path):
    def interrupted():
        raise KeyboardInterrupt

    make = Maker()
    store = Store(tmp_path, experiment())
    with pytest.raises(KeyboardInterrupt):
        store.arrays("volume", (1,), interrupted)
    assert not list(tmp_path.iterdir())
    store.arrays("volume", (1,), make)
    assert make.calls == 1


# Whole measurements in a folder that was used before


def another_radiograph(here: Experiment) -> Experiment:
    """Replace one radiograph by its neighbour."""
    counts = here.test.counts.copy()
    counts[7] = counts[8]
    return replace(here, test=replace(here.test, counts=counts))


CHANGES = {
    "one radiograph replaced": another_radiograph,
    "readout noise 300 times as large": lambda here: replace(here, readout_noise_counts=600.0),
}


@pytest.fixture(scope="module")
def used_before(tmp_path_factory):
    """Return a work folder in which an experiment was measured, the experiment, and the options."""
    case, work = SmallExperiment(small_scenario()), tmp_path_factory.mktemp("used")
    options = case.options.model_copy(update={"weighting": "noise"})
    here = replace(case.experiment, readout_noise_counts=2.0)
    measure(here, options, work=work)
    return work, here, options


@pytest.mark.parametrize("change", CHANGES)
def test_a_folder_that_was_used_before_gives_what_a_new_one_does(used_before, tmp_path, change):
    """These two once came back from the folder, voxels from what a new one gives."""
    work, here, options = used_before
    other = CHANGES[change](here)
    kept, fresh = measure(other, options, work=work), measure(other, options, work=tmp_path)
    for name in ("motion.amplitude", "motion.amplitude_std", "fit.residual_final"):
        np.testing.assert_array_equal(attrgetter(name)(kept), attrgetter(name)(fresh))


def test_the_same_experiment_is_measured_from_what_was_kept(used_before):
    work, here, options = used_before
    before = {path: path.stat().st_mtime_ns for path in work.iterdir()}
    measure(here, options, work=work)
    assert {path: path.stat().st_mtime_ns for path in work.iterdir()} == before


def test_a_kind_of_somebody_s_own_counts_with_what_it_does():
    """With its source and without, as where it was typed in; also what it is derived from."""

    def made(body, name="Mine", base="TimeFunction"):
        space = {"TimeFunction": TimeFunction, "np": np, "__name__": "typed_in"}
        exec(
            f"class {name}({base}):\n    kind: str = '{name}'\n    def functions(self, series):\n        {body}", space
        )
        TimeFunction._kinds.pop(name)
        return space[name]

    sine, cosine, wave = (
        made(f"return {each}(series.angle_rad)[None]") for each in ("np.sin", "np.cos", "(lambda x: np.sin(2 * x))")
    )
    digests = {digest(each()) for each in (sine, cosine, wave)}
    assert len(digests) == 3
    assert digest(made("return np.sin(series.angle_rad)[None]")()) in digests


def test_a_section_motion_counts_with_what_it_is_not_its_name_alone(monkeypatch):
    shear = SectionPattern(name="counted", gradient=((0, 1, 0), (1, 0, 0), (0, 0, 0)))
    other = replace(shear, gradient=((0, 1, 0), (0, 0, 0), (0, 0, 0)))
    keys = []
    for motion in (shear, other):
        monkeypatch.setitem(sections._OFFERED, "counted", motion)
        options = MeasureOptions(section_motions=("translation_x", "counted"))
        small = small_scenario({})
        run, bound = Trial(scenario=small, options=options, factors={}), LeastError(small, options)
        keys.append((run.key, bound.name, digest(options, options.motions)))
    assert all(one != two for one, two in zip(*keys, strict=True))
