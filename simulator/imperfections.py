"""The table `[scanner]` of a scenario: what a real scanner does and a perfect one does not; all of it off by default.

`[misalignment]` tells where the scanner stands; `docs/scanner.md` tells of each part its unit, a typical size and its
source.
"""

from __future__ import annotations

from pdvc.settings import Settings
from simulator.focal_spot import FocalSpot
from simulator.lag import Lag
from simulator.open_beam import OpenBeam
from simulator.panel import Panel
from simulator.scatter import Scatter
from simulator.stage import RotationStage


class Imperfections(Settings):
    """What a real scanner does beside making images."""

    stage: RotationStage = RotationStage()
    """the rotation stage"""
    focal_spot: FocalSpot = FocalSpot()
    """size and drift of the focal spot"""
    open_beam: OpenBeam = OpenBeam()
    """changes of the open beam"""
    scatter: Scatter = Scatter()
    """scattered radiation"""
    panel: Panel = Panel()
    """faults of the flat panel"""
    lag: Lag = Lag()
    """light that comes late"""
