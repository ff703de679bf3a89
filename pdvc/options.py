"""Options of a measurement: every choice of the protocol, in two built-in sets, `default` and `paper`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import Field, field_validator

from pdvc.geometry import ConeBeam
from pdvc.history import PAPER, Ramp, TimeFunctions
from pdvc.sections import CONTRACTION, RIGID, SectionBasis
from pdvc.settings import Settings


class StageOptions(Settings):
    """One stage: at which scale, by which solver, how far."""

    scale: Annotated[int, Field(ge=1, le=16)] | Literal["coarse"] = 1
    """pixels binned into one; coarse: the largest power of two that leaves about a hundred rows"""
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


COARSE_ROWS = 100
"""Rows that the coarse scale leaves at least."""
COARSE_TO_FINE_RIGID = (
    StageOptions(scale="coarse", most=3, passes_per_mode=6),
    StageOptions(scale=2, most=5, passes_per_mode=3),
)
COARSE_TO_FINE = (
    StageOptions(scale=2, most=4, passes_per_mode=8),
    StageOptions(scale=1, solver="gauss-newton", most=4),
)


class MeasureOptions(Settings):
    """Everything that a measurement depends on besides its experiment.

    The defaults go beyond the paper where it pays: sections may contract, and large motion is followed from coarse
    to fine. `paper_options` are the paper's.
    """

    discard_rows: Annotated[int, Field(ge=0)] | None = None
    """rows left out at the top and at the bottom, px; default: 100 of 954, or more where rays need it"""
    discard_columns: Annotated[int, Field(ge=0)] | None = None
    """columns left out on the left and on the right, px; default: 60 of 432, or less for a wide sample"""
    sections: Annotated[int, Field(ge=2)] = 15
    """sections, equally spaced over the used height"""
    section_motions: tuple[str, ...] = (*RIGID, CONTRACTION)
    """motions of a section: six rigid ones, and contraction"""
    time: tuple[TimeFunctions, ...] = (*PAPER[:3], Ramp(powers=(0, 1, 2, 3)))
    """time functions: Table 1, and a jump and a cube at the start of loading"""
    rigid: tuple[StageOptions, ...] = COARSE_TO_FINE_RIGID
    """the sample as one rigid body; one stage or several, from coarse to fine"""
    deformation: tuple[StageOptions, ...] = COARSE_TO_FINE
    """every section by itself; one stage or several, the last at scale 1"""
    beam_hardening: Literal["fit", "none"] | tuple[float, float, float] = "fit"
    """third-order polynomial: fitted from the reference views, none, or c1, c2, c3 of attenuation"""
    smooth_px: Annotated[float, Field(ge=0, le=5)] = 0.7
    """standard deviation of the Gaussian that all radiographs are filtered with first, px; 0: none"""
    subtract_systematic: bool = True
    """subtract what re-projecting the volume leaves of the reference views, registered"""
    weighting: Literal["uniform", "noise"] = "uniform"
    """all pixels alike, as in the paper, or by the inverse of their noise"""
    prior_voxel: Annotated[float, Field(gt=0)] = 30.0
    """standard deviation of every amplitude before the data, voxels (rms over the steps)"""

    @field_validator("rigid")
    @classmethod
    def _at_least_one(cls, stages: tuple[StageOptions, ...]) -> tuple[StageOptions, ...]:
        if not stages:
            raise ValueError("at least one stage")
        return stages

    @field_validator("deformation")
    @classmethod
    def _down_to_scale_one(cls, stages: tuple[StageOptions, ...]) -> tuple[StageOptions, ...]:
        if not stages or stages[-1].scale != 1:
            raise ValueError("at least one stage, the last at scale 1")
        return stages

    @field_validator("section_motions")
    @classmethod
    def _known_motions(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        SectionBasis(height_mm=[0.0], radius_mm=1.0, motions=names)  # type: ignore[arg-type]  # raises if unknown
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"every motion once, {', '.join(twice)} stands there twice")
        return names


def coarse_scale(geometry: ConeBeam) -> int:
    """Return the largest power of two, up to 16, that leaves about a hundred rows."""
    return max(scale for scale in (1, 2, 4, 8, 16) if scale == 1 or geometry.rows >= COARSE_ROWS * scale)


def resolved(options: MeasureOptions, geometry: ConeBeam) -> MeasureOptions:
    """Return the options with everything filled in that depends on the detector alone: the coarse scale.

    Raises ValueError where nothing of the radiographs would be left.
    """
    rows, columns = options.discard_rows or 0, options.discard_columns or 0
    if 2 * rows >= geometry.rows or 2 * columns >= geometry.columns:
        raise ValueError(
            f"discard_rows, discard_columns: expected to leave some of {geometry.rows} x {geometry.columns} px, "
            f"got {rows} and {columns} px on each side"
        )
    coarse = coarse_scale(geometry)
    stages = {
        name: tuple(
            stage.model_copy(update={"scale": coarse}) if stage.scale == "coarse" else stage
            for stage in getattr(options, name)
        )
        for name in ("rigid", "deformation")
    }
    return options.model_copy(update=stages)


def paper_options() -> MeasureOptions:
    """Return the paper's protocol: Table 1, six motions a section, eight modes at scale 2, four at scale 1."""
    return MeasureOptions(
        section_motions=RIGID,
        time=PAPER,
        smooth_px=0.0,
        rigid=(StageOptions(scale=2, most=8),),
        deformation=(StageOptions(scale=1, most=4),),
    )


PROTOCOLS: dict[str, Callable[[], MeasureOptions]] = {"default": MeasureOptions, "paper": paper_options}
"""Built-in options by name."""
