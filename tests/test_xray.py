import sys
from functools import partial

import numpy as np
import pytest

from simulator.xray import (
    Spectrum,
    TransmissionTable,
    XraySource,
    beam,
    direct_transmission,
    make_spectrum,
    read_spectrum,
    shipped_spectra,
    write_spectrum,
)

PURE_IRON = {"matrix_density_g_cm3": 7.874, "silicon_fraction": 0.0}

# NIST Standard Reference Database 126, mass attenuation coefficients mu/rho, cm2/g
NIST = {"iron": {40: 3.629, 60: 1.205, 100: 0.3717, 150: 0.1964}, "carbon": {40: 0.2076, 60: 0.1753, 100: 0.1514}}


def log_attenuation(source, matrix_mm, graphite_mm=0.0):
    return -np.log(direct_transmission(beam(source), np.asarray(matrix_mm), np.asarray(graphite_mm)))


def slope(source, matrix_mm):
    return (log_attenuation(source, matrix_mm + 1e-4) - log_attenuation(source, matrix_mm)) / 1e-4


@pytest.mark.parametrize(("material", "energy"), [(m, e) for m, row in NIST.items() for e in row])
def test_attenuation_is_that_of_the_published_table(tmp_path, material, energy):
    line = Spectrum(energy_keV=np.array([float(energy)]), fluence=np.ones(1))
    write_spectrum(tmp_path / "line.csv", line, "one energy")
    rays = beam(XraySource(spectrum=str(tmp_path / "line.csv"), **PURE_IRON))
    found, density = {"iron": (rays.matrix_per_mm, 7.874), "carbon": (rays.graphite_per_mm, 2.2)}[material]
    assert found[0] * 10 / density == pytest.approx(NIST[material][energy], rel=0.01)


@pytest.mark.parametrize(("name", "ratio"), [("w180_cu0.5", 0.66), ("w180_cu1.0", 0.76), ("w180_al1.0", 0.3)])
def test_the_beam_hardens_as_much_as_was_computed_elsewhere(name, ratio):
    source = XraySource(spectrum=name, **PURE_IRON)
    assert slope(source, 1.3) / slope(source, 0.0) == pytest.approx(ratio, abs=0.03)


def test_a_nodule_changes_the_log_radiograph_by_about_two_percent():
    source = XraySource()
    for thickness in (1.0, 1.3, 2.6):
        change = log_attenuation(source, thickness) - log_attenuation(source, thickness - 0.05, 0.05)
        assert 0.015 < change < 0.026


@pytest.mark.parametrize("name", shipped_spectra())
def test_the_table_interpolates_the_direct_sum(name):
    source = XraySource(spectrum=name)
    rng = np.random.default_rng(0)
    matrix = (rng.random((40, 50)) * 4.0).astype(np.float32)
    graphite = (rng.random((40, 50)) * 1.0).astype(np.float32)
    table = TransmissionTable.of(source, (4.0, 1.0))
    found = table.transmission(matrix, graphite)
    exact = direct_transmission(beam(source), matrix.astype(float), graphite.astype(float))
    assert found.dtype == np.float32
    assert np.abs(found / exact - 1).max() < 5e-5


@pytest.mark.parametrize("name", shipped_spectra())
def test_the_error_falls_with_the_square_of_the_step(name):
    source = XraySource(spectrum=name)
    matrix = np.linspace(0, 1, 173, dtype=np.float32)[:, None]
    none = np.zeros_like(matrix)
    exact = direct_transmission(beam(source), matrix.astype(float), none)
    tables = (TransmissionTable.of(source, (1.0, 0.1), step_mm=(step, 0.1)) for step in (0.2, 0.1, 0.05))
    errors = [np.sqrt(np.mean((t.transmission(matrix, none) / exact - 1) ** 2)) for t in tables]
    assert np.log2(np.divide(errors[:-1], errors[1:])).min() > 1.5


def test_air_transmits_everything():
    zero = np.zeros((2, 3), dtype=np.float32)
    assert np.all(TransmissionTable.of(XraySource(), (1.0, 0.5)).transmission(zero, zero) == 1)


def test_rounding_below_zero_is_extrapolated_and_anything_more_is_refused():
    table = TransmissionTable.of(XraySource(), (1.0, 0.5))
    at = partial(np.full, (1, 1), dtype=np.float32)
    assert table.transmission(at(-1e-6), at(0))[0, 0] == pytest.approx(1, abs=1e-5)
    with pytest.raises(ValueError, match=r"matrix length: expected 0 to .* mm"):
        table.transmission(at(-0.1), at(0))
    with pytest.raises(ValueError, match=r"graphite length: expected 0 to .* mm, got 0.7"):
        table.transmission(at(0), at(0.7))
    with pytest.raises(ValueError, match="matrix length"):
        table.transmission(at(np.nan), at(0))


def test_an_energy_integrating_detector_sees_a_harder_beam_than_a_counting_one():
    mean = [
        (rays.energy_keV @ rays.weight)
        for rays in (beam(XraySource(energy_integrating=flag)) for flag in (True, False))
    ]
    assert mean[0] > mean[1] + 5


@pytest.mark.parametrize("name", shipped_spectra())
def test_shipped_spectra_end_at_the_tube_voltage_and_show_the_tungsten_lines(name):
    spectrum = read_spectrum(name)
    assert spectrum.fluence.sum() == pytest.approx(1)
    assert 178 < spectrum.energy_keV.max() <= 180
    by_energy = dict(zip(spectrum.energy_keV.tolist(), spectrum.fluence.tolist(), strict=True))
    # K alpha 1 of tungsten, 59.32 keV, against the continuum beside it
    assert by_energy[59.5] > 1.5 * by_energy[61.5]


def test_a_spectrum_survives_its_file(tmp_path):
    spectrum = read_spectrum("w180_cu0.5")
    write_spectrum(tmp_path / "again.csv", spectrum, "two\nlines")
    again = read_spectrum(str(tmp_path / "again.csv"))
    np.testing.assert_allclose(again.fluence, spectrum.fluence, rtol=1e-8)
    np.testing.assert_array_equal(again.energy_keV, spectrum.energy_keV)


def test_spectra_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"one of w180_al1\.0, w180_cu0\.5, w180_cu1\.0, got 'w90'"):
        read_spectrum("w90")
    with pytest.raises(ValueError, match="expected a CSV file, found none"):
        read_spectrum(str(tmp_path / "none.csv"))
    (tmp_path / "words.csv").write_text("energy_keV,fluence\nten,one\n")
    with pytest.raises(ValueError, match=r"words\.csv: expected rows of energy_keV, fluence"):
        read_spectrum(str(tmp_path / "words.csv"))
    (tmp_path / "negative.csv").write_text("energy_keV,fluence\n10,1\n20,-0.5\n")
    with pytest.raises(ValueError, match="expected energies above 0 keV"):
        read_spectrum(str(tmp_path / "negative.csv"))


def test_without_spekpy_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "spekpy", None)
    with pytest.raises(ImportError, match=r"pip install pdvc-bench\[spectra\]"):
        make_spectrum(180, {"Cu": 0.5})


def test_the_shipped_spectrum_can_be_made_again():
    pytest.importorskip("spekpy", reason="the extra `spectra` is not installed")
    spectrum, shipped = make_spectrum(180, {"Be": 0.5, "Cu": 0.5}), read_spectrum("w180_cu0.5")
    np.testing.assert_allclose(spectrum.fluence, shipped.fluence, rtol=1e-3, atol=1e-9)
