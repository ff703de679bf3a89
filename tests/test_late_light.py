"""Light that comes late, taken out of the images that show it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.late_light import LatePart, image_time_s, without_late_light
from pdvc.protocol import measure
from simulator.lag import Lag, Late
from validation.testing.small_cases import SmallExperiment, small_scenario

MANY = settings(max_examples=40, deadline=None)
SHAPE = (4, 3)
DARK = np.full(SHAPE, 300, dtype=np.float32)
BEAM = np.linspace(30_000, 50_000, 12).reshape(SHAPE).astype(np.float32)
SHARE, TIME = st.floats(1e-4, 0.2), st.floats(0.1, 1000)


def counted(light):
    return np.rint(DARK + BEAM * light).clip(0, 65535).astype(np.uint16)


@MANY
@given(quick=SHARE, slow=SHARE, times=st.tuples(TIME, TIME), image_s=st.floats(0.2, 20), seed=st.integers(0, 1000))
def test_what_a_panel_with_lag_shows_gives_back_the_light(quick, slow, times, image_s, seed):
    """The simulator's panel, which shares no code with this, adds the light; only rounding is left."""
    light = np.random.default_rng(seed).uniform(0.1, 1, size=(9, *SHAPE)).astype(np.float32)
    lag = Lag(share=quick, time_s=times[0], afterglow_share=slow, afterglow_time_s=times[1])
    before = np.full(SHAPE, 0.7, dtype=np.float32)
    seen = Late(lambda n: light[n], lambda: before, lag.parts(image_s))
    counts = np.stack([counted(seen(n)) for n in range(9)])
    parts = [LatePart(share=share, time_s=time) for share, time in zip((quick, slow), times, strict=True)]
    found, last = without_late_light(counts, DARK, BEAM, parts, image_s, before)
    assert found.astype(float) == pytest.approx(DARK + BEAM * light, abs=2.5)
    assert last == pytest.approx(light[-1], abs=1e-4)


def test_after_the_beam_was_cut_off_nothing_is_left():
    """A share p of the beam, gone with the time tau: images of tau see p (1 - 1/e), and each 1/e of the one before."""
    p, left = 0.05, np.exp(-1.0)
    counts = np.stack([counted(np.full(SHAPE, p * (1 - left) * left**n, dtype=np.float32)) for n in range(5)])
    found, _ = without_late_light(
        counts, DARK, BEAM, [LatePart(share=p, time_s=7.0)], 7.0, np.ones(SHAPE, dtype=np.float32)
    )
    assert found.astype(float) == pytest.approx(np.broadcast_to(DARK, found.shape), abs=2)


def test_what_cannot_be_is_said_in_a_line():
    image = np.zeros((1, *SHAPE), dtype=np.uint16)
    part = LatePart(share=0.6, time_s=1e6)
    with pytest.raises(ValueError, match="lag: expected shares that leave some of the light"):
        without_late_light(image, DARK, BEAM, [part, part], 1.0, np.ones(SHAPE, dtype=np.float32))
    with pytest.raises(ValueError, match=r"found steps of 0\.0 s"):
        image_time_s(np.zeros(5), "test")


def test_afterglow_moves_no_sample_once_it_is_taken_out():
    glow = {"scanner.lag.afterglow_share": 0.01, "scanner.lag.afterglow_time_s": 300.0}
    clean, glowing = SmallExperiment(small_scenario()), SmallExperiment(small_scenario(glow))
    options = clean.options.model_copy(update={"lag": (LatePart(share=0.01, time_s=300.0),)})
    away = {
        name: np.abs(measure(glowing.experiment, each).motion.amplitude - clean.measurement.motion.amplitude).mean()
        for name, each in (("as it is", clean.options), ("taken out", options))
    }
    assert away["taken out"] < 0.02
    assert away["as it is"] > 10 * away["taken out"]
