"""Laws, and beams of them: closed forms, laws that every law obeys, and the simulator's own beam at convergence."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from pdvc.identify.beam import Profile, bridgman_factor, elongation_mm, force_at_stroke, strains, unloaded
from pdvc.identify.laws import Law, Linear, Ludwik, MultiVoce, RambergOsgood, Swift, Voce, law_named, plastic_at
from pdvc.settings import SettingsError
from simulator.loading import Loading, load_history
from simulator.specimen import Specimen, area_mm2
from tests.laws import law

LAWS = (Ludwik(), Voce(), RambergOsgood(), Swift(), Linear(), MultiVoce())
CLOSED = {
    "ludwik": lambda w, s: (max(s - w.yield_MPa, 0) / w.hardening_MPa) ** (1 / w.exponent),
    "voce": lambda w, s: -np.log1p(-max(s - w.yield_MPa, 0) / w.saturation_MPa) / w.rate,
    "ramberg-osgood": lambda w, s: 0.002 * (s / w.proof_MPa) ** (1 / w.exponent),
    "swift": lambda w, s: max((s / w.hardening_MPa) ** (1 / w.exponent) - w.prestrain, 0),
    "linear": lambda w, s: max(s - w.yield_MPa, 0) / w.modulus_MPa,
}
BAR = Profile(height_mm=np.linspace(-3, 3, 61), area_mm2=np.full(61, 1.2))
HEIGHT_MM = np.linspace(-6.5, 6.5, 1041)
DOG_BONE = Profile(height_mm=HEIGHT_MM, area_mm2=area_mm2(Specimen(thinned="both"), HEIGHT_MM))
OF_SCENARIO = Ludwik(young_MPa=168e3, yield_MPa=300.0, hardening_MPa=579.5, exponent=0.2211)


@pytest.mark.parametrize("one", LAWS[:-1], ids=lambda one: one.kind)
@pytest.mark.parametrize("stress", [120.0, 301.0, 380.0, 560.0])
def test_the_plastic_strain_of_a_stress_is_that_of_the_closed_form(one, stress):
    expected = CLOSED[one.kind](one, stress)
    # beyond these a law is not asked: `LEAST_PLASTIC` and `MOST_PLASTIC`
    assert plastic_at(one, stress) == pytest.approx(expected if 1e-12 < expected < 1 else 0.0, rel=1e-9, abs=1e-12)


@given(which=st.sampled_from(LAWS), share=st.floats(1e-6, 0.1))
@law()
def test_flow_stress_and_plastic_strain_undo_each_other(which, share):
    assert plastic_at(which, which.flow_MPa(np.array([share]))) == pytest.approx(share, rel=1e-6)


@given(which=st.sampled_from(LAWS), plastic=st.floats(1e-4, 0.1))
@law()
def test_slopes_are_those_of_the_flow_stress(which, plastic):
    p, h = np.array([plastic]), 1e-3 * plastic
    expected = (which.flow_MPa(p + h) - which.flow_MPa(p - h)) / (2 * h)
    np.testing.assert_allclose(which.slope_MPa(p), expected, rtol=1e-4)
    for name, value in which.values().items():
        more, less = (which.with_values({name: value * (1 + sign * 1e-3)}).flow_MPa(p) for sign in (1, -1))
        np.testing.assert_allclose(which.partial_MPa(name, p), (more - less) / 2e-3, rtol=1e-3, atol=1e-6)


def test_a_law_that_cannot_carry_a_stress_says_so_by_the_largest_strain_it_knows():
    assert plastic_at(Voce(), 700.0) == pytest.approx(1.0)


def test_a_law_of_ones_own_takes_ten_lines():
    class Square(Law):
        """s_y + K sqrt(p)."""

        kind: str = "square-root-of-the-tests"
        """a square root"""
        yield_MPa: float = 200.0
        """s_y, MPa"""
        hardening_MPa: float = 1000.0
        """K, MPa"""

        def flow_MPa(self, plastic):
            return self.yield_MPa + self.hardening_MPa * np.sqrt(plastic)

    assert plastic_at(law_named("square-root-of-the-tests"), 400.0) == pytest.approx(0.04)


def test_a_law_that_nobody_offers_is_answered_with_those_that_are():
    with pytest.raises(SettingsError, match=r"expected one of .*ludwik.*, got 'hooke'"):
        law_named("hooke")


@given(stress=st.floats(50, 2000))
@law()
def test_a_law_starts_where_it_carries_the_test(stress):
    for one in LAWS:
        assert plastic_at(one.started_for(stress), stress) < 0.1
        assert one.started_for(stress).young_MPa == one.young_MPa


@given(force=st.floats(10, 600))
@law()
def test_a_uniform_bar_strains_by_its_law(force):
    found = strains(OF_SCENARIO, BAR, np.array([force]))
    plastic = CLOSED["ludwik"](OF_SCENARIO, force / 1.2)
    np.testing.assert_allclose(found.total, force / 1.2 / 168e3 + plastic, rtol=1e-8, atol=1e-12)
    assert elongation_mm(found.total, BAR)[0] == pytest.approx(6 * found.total[0, 0])


def test_what_is_unloaded_keeps_its_plastic_strain_and_goes_back_by_young():
    force = np.array([100.0, 500.0, 600.0, 300.0, 450.0, 600.0, 610.0])
    found = strains(OF_SCENARIO, BAR, force)
    np.testing.assert_array_equal(found.flows[:, 0], [True, True, True, False, False, True, True])
    np.testing.assert_allclose(found.plastic[3:5, 0], found.plastic[2, 0], rtol=1e-12)
    np.testing.assert_allclose(found.total[2, 0] - found.total[3, 0], 300 / 1.2 / 168e3, rtol=1e-9)
    assert found.plastic[6, 0] > found.plastic[2, 0]


def test_noise_of_the_force_is_no_unloading():
    assert not unloaded(np.array([100.0, 104.0, 101.0]), 1.0).any()
    assert unloaded(np.array([100.0, 110.0, 101.0]), 1.0)[2]


def test_the_beam_is_the_simulators_at_convergence():
    """Two codes that share nothing, for the paper's test without its neck: strains, and forces at a stroke."""
    loading = Loading(necking_strain=0.0)
    other = load_history(loading, 2.0 * np.arange(127), HEIGHT_MM, DOG_BONE.area_mm2)
    found = strains(OF_SCENARIO, DOG_BONE, np.append(250.0, other.force_N)).total
    np.testing.assert_allclose(found[1:] - found[0], other.strain, atol=2e-9)
    stroke = 0.002 * np.maximum(2.0 * np.arange(127) - 100.0, 0.0)
    force = force_at_stroke(
        OF_SCENARIO, DOG_BONE, stroke, start_N=250.0, compliance_mm_per_N=loading.compliance_mm_per_N
    )
    np.testing.assert_allclose(force, other.force_N, atol=1e-5)


def test_the_elongation_is_the_integral_of_the_closed_form():
    force, specimen = 700.0, Specimen(thinned="both")

    def strain(z):
        stress = force / float(area_mm2(specimen, z))
        return stress / 168e3 + CLOSED["ludwik"](OF_SCENARIO, stress)

    expected = 2 * quad(strain, 0, 6.5, epsabs=1e-12, limit=200)[0]
    found = elongation_mm(strains(OF_SCENARIO, DOG_BONE, np.array([force])).total, DOG_BONE)[0]
    assert found == pytest.approx(expected, rel=1e-5)


def test_the_tangent_is_that_of_the_strain():
    force, small = np.array([650.0]), 1e-3
    found = strains(OF_SCENARIO, DOG_BONE, force)
    more, less = (strains(OF_SCENARIO, DOG_BONE, force + sign * small).total for sign in (1, -1))
    tangent = (1 / 168e3 + found.plastic_per_MPa) / DOG_BONE.area_mm2
    np.testing.assert_allclose(tangent, (more - less) / (2 * small), rtol=1e-4, atol=1e-12)


def test_a_stroke_that_no_force_follows_is_refused():
    weak = Voce(saturation_MPa=1e-3, yield_MPa=100.0)
    with pytest.raises(ValueError, match=r"stroke: expected one that beam and machine can follow"):
        force_at_stroke(weak, BAR, np.array([0.0, 100.0]), start_N=50.0, compliance_mm_per_N=0.0)


def test_bridgmans_factor_is_his_table():
    # Bridgman, Studies in Large Plastic Flow and Fracture (1952): a/R = 1/3, 1/2, 1, 2, 3, 4
    table = [0.927, 0.897, 0.823, 0.722, 0.656, 0.606]
    np.testing.assert_allclose(bridgman_factor(np.array([1 / 3, 1 / 2, 1, 2, 3, 4])), table, atol=1.5e-3)
    assert bridgman_factor(np.zeros(1)) == 1.0


def test_bridgmans_correction_lowers_the_strain_of_a_neck_and_of_no_bar():
    force = np.array([700.0])
    assert (
        strains(OF_SCENARIO, DOG_BONE, force, bridgman=True).total.max()
        < strains(OF_SCENARIO, DOG_BONE, force).total.max()
    )
    np.testing.assert_array_equal(
        strains(OF_SCENARIO, BAR, force, bridgman=True).total, strains(OF_SCENARIO, BAR, force).total
    )


def test_the_python_of_the_docs_runs():
    text = (Path(__file__).parent.parent / "docs" / "identification.md").read_text(encoding="utf-8")
    names: dict[str, object] = {"__name__": "docs"}
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec(compile(block, "identification.md", "exec", dont_inherit=True), names)
    assert callable(names["law_of"])
    assert plastic_at(law_named("square-root"), 400.0) == pytest.approx(0.04)
