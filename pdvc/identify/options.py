"""What an identification is asked for."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from pdvc.identify.laws import Law, Ludwik
from pdvc.settings import Settings


class IdentifyOptions(Settings):
    """What is identified, and what is known beforehand."""

    law: Law = Ludwik()
    """the law, with values to start from: ludwik, voce, ramberg-osgood, swift, linear, multi-voce"""
    compare: tuple[str, ...] = ()
    """kinds of laws whose evidence is compared with that of the law"""
    until: Annotated[int, Field(ge=4)] | None = None
    """number of steps that are used, from the first; default: all"""
    neck: bool = True
    """whether a neck may form in the last steps, which the law does not tell"""
    outline_voxel: Annotated[float, Field(gt=0)] = 0.04
    """standard deviation of the sample's outline in the volume, voxels: with it, all areas may be off together"""
    area_mm2: Annotated[float, Field(gt=0)] | None = None
    """area of the smallest section, mm2, where it was measured otherwise; default: from the volume"""
    area_deviation: Annotated[float, Field(gt=0, le=0.5)] = 0.002
    """relative standard deviation of area_mm2"""
    force_noise_N: Annotated[float, Field(gt=0)] | None = None
    """standard deviation of a recorded force, N; default: from the record's second differences"""
    stroke_mm_per_s: Annotated[float, Field(gt=0)] | None = None
    """rate of the crosshead while the sample is loaded, mm/s; default: it was not told"""
    bridgman: bool = False
    """whether the stress of a notch or neck at rest is corrected by Bridgman's factor"""
