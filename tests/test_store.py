"""Intermediate results: made once, kept whole, never mixed up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdvc.experiment import Experiment, Series
from pdvc.geometry import ConeBeam
from pdvc.store import Store

GEOMETRY = ConeBeam(source_axis_mm=20, source_detector_mm=40, pixel_mm=0.1, rows=3, columns=4)


def experiment(force_N: float = 1.0) -> Experiment:
    series = Series(
        counts=np.arange(24, dtype=np.uint16).reshape(2, 3, 4),
        angle_rad=np.zeros(2),
        time_s=np.zeros(2),
        force_N=np.full(2, force_N),
    )
    return Experiment(
        title="",
        material="",
        geometry=GEOMETRY,
        frames=1,
        photons_per_count=None,
        readout_noise_counts=None,
        reference=series,
        test=series,
        flats=series.counts,
        darks=series.counts,
    )


class Maker:
    """Count how often it is asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"values": np.full(3, float(self.calls))}


def test_what_was_made_once_is_read_afterwards(tmp_path):
    make = Maker()
    first = Store(tmp_path, experiment()).arrays("volume a", make)
    again = Store(tmp_path, experiment()).arrays("volume a", make)
    assert make.calls == 1
    np.testing.assert_array_equal(first["values"], again["values"])


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("volume b", experiment()),
        ("volume a", experiment(force_N=2.0)),
        ("volume a", replace(experiment(), geometry=replace(GEOMETRY, pixel_mm=0.2))),
    ],
)
def test_another_name_or_experiment_is_made_anew(tmp_path, name, other):
    make = Maker()
    Store(tmp_path, experiment()).arrays("volume a", make)
    Store(tmp_path, other).arrays(name, make)
    assert make.calls == 2


def test_what_depends_on_the_reference_scan_alone_is_found_by_another_test_of_the_same_sample(tmp_path):
    make = Maker()
    one, two = experiment(), replace(experiment(), test=experiment(force_N=2.0).test)
    for each in (one, two):
        Store(tmp_path, each).arrays("volume a", make, reference_alone=True)
    assert make.calls == 1
    Store(tmp_path, replace(one, reference=two.test)).arrays("volume a", make, reference_alone=True)
    assert make.calls == 2


def test_without_a_folder_nothing_is_kept():
    make = Maker()
    store = Store(None, experiment())
    store.arrays("volume a", make)
    store.arrays("volume a", make)
    assert make.calls == 2


def test_an_interruption_leaves_nothing_that_looks_whole(tmp_path):
    def interrupted():
        raise KeyboardInterrupt

    make = Maker()
    store = Store(tmp_path, experiment())
    with pytest.raises(KeyboardInterrupt):
        store.arrays("volume a", interrupted)
    assert not list(tmp_path.glob("*.npz"))
    store.arrays("volume a", make)
    assert make.calls == 1
