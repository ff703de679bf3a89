"""Options of a measurement: every choice of the protocol, with the paper's as defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from pdvc.history import PAPER, TimeFunctions
from pdvc.sections import RIGID, SectionBasis
from pdvc.settings import Settings


class StageOptions(Settings):
    """One stage: at which scale, by which solver, how far."""

    scale: Annotated[int, Field(ge=1, le=16)] = 1
    """pixels binned into one"""
    solver: Literal["pgd", "gauss-newton"] = "pgd"
    """pgd: greedy modes, as in the paper; gauss-newton: all unknowns at once"""
    most: Annotated[int, Field(ge=1)] = 4
    """largest number of modes (pgd) or passes (gauss-newton)"""
    passes_per_mode: Annotated[int, Field(ge=1)] = 1
    """pgd: linearisations about each mode, while they help; one in the paper"""
    least_gain: Annotated[float, Field(ge=0, lt=1)] = 1e-3
    """pgd stops at a mode that lowers the rms residual by less than this share"""
    least_change_voxel: Annotated[float, Field(gt=0)] = 2e-3
    """gauss-newton stops at a change of displacement below this, voxel rms"""


class MeasureOptions(Settings):
    """Everything that a measurement depends on besides its experiment."""

    discard_rows: Annotated[int, Field(ge=0)] | None = None
    """rows left out at the top and at the bottom, px; default: 100 of 954, as in the paper"""
    discard_columns: Annotated[int, Field(ge=0)] | None = None
    """columns left out on the left and on the right, px; default: 60 of 432, as in the paper"""
    sections: Annotated[int, Field(ge=2)] = 15
    """sections, equally spaced over the used height"""
    section_motions: tuple[str, ...] = RIGID
    """motions of a section: six rigid ones, and contraction"""
    time: tuple[TimeFunctions, ...] = PAPER
    """time functions, Table 1 by default"""
    rigid: StageOptions = StageOptions(scale=2, most=8)
    """the sample as one rigid body"""
    deformation: StageOptions = StageOptions(scale=1, most=4)
    """every section by itself"""
    beam_hardening: Literal["fit", "none"] | tuple[float, float, float] = "fit"
    """third-order polynomial: fitted from the reference views, none, or c1, c2, c3 of attenuation"""
    subtract_systematic: bool = True
    """subtract what re-projecting the volume leaves of the reference views, registered"""
    weighting: Literal["uniform", "noise"] = "uniform"
    """all pixels alike, as in the paper, or by the inverse of their noise"""
    prior_voxel: Annotated[float, Field(gt=0)] = 30.0
    """standard deviation of every amplitude before the data, voxels (rms over the steps)"""

    @field_validator("section_motions")
    @classmethod
    def _known_motions(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        SectionBasis(height_mm=[0.0], radius_mm=1.0, motions=names)  # type: ignore[arg-type]  # raises if unknown
        return names
