"""Options of a measurement: every choice of the protocol, in two built-in sets, `default` and `paper`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import Field, field_validator

from pdvc.experiment import Experiment
from pdvc.gauss_newton import GaussNewton
from pdvc.geometry import ConeBeam
from pdvc.history import PAPER, Ramp, TimeFunction, settled
from pdvc.late_light import LatePart
from pdvc.pgd import Pgd
from pdvc.sections import CONTRACTION, RIGID, SectionPattern, motions_named, names_of, offered_motions
from pdvc.settings import Settings, load_plugins
from pdvc.smoother import Smoother
from pdvc.solution import Solver


def motions_of(names: tuple[str, ...]) -> tuple[SectionPattern, ...]:
    """Return section motions by their names, also those that installed packages offer; raises ValueError else."""
    try:
        return motions_named(names)
    except ValueError:
        load_plugins()
        return motions_named(names)


COARSE_ROWS = 100
"""Rows that the coarse scale leaves at least."""

MOST_SECTIONS = 29
USUAL_ROWS = 11
"""Rows of the detector for each section, at least, unless a number of sections is asked for."""

Scale = Annotated[int, Field(ge=1, le=16)]


class StageOptions(Settings):
    """One stage of the protocol: at which scale, and by which solver."""

    scale: Scale | Literal["coarse", "middle"] = 1
    """pixels binned into one; coarse: the largest power of two that leaves about a hundred rows; middle: half of it"""
    solver: Solver = Pgd()
    """pgd, gauss-newton or smoother, each with its own limits"""

    def at(self, geometry: ConeBeam) -> ResolvedStage:
        """Return the stage with its scale as a number, for a detector."""
        if isinstance(self.scale, int):
            return ResolvedStage(scale=self.scale, solver=self.solver)
        coarse = coarse_scale(geometry)
        return ResolvedStage(scale=coarse if self.scale == "coarse" else max(coarse // 2, 2), solver=self.solver)


class ResolvedStage(StageOptions):
    """A stage of one experiment's protocol."""

    scale: Scale = 1
    """pixels binned into one"""


def coarse_scale(geometry: ConeBeam) -> int:
    """Return the largest power of two, up to 16, that leaves about a hundred rows."""
    return max(scale for scale in (1, 2, 4, 8, 16) if scale == 1 or geometry.rows >= COARSE_ROWS * scale)


COARSE_TO_FINE_RIGID = (
    StageOptions(scale="coarse", solver=GaussNewton(most_passes=6)),
    StageOptions(scale=2, solver=GaussNewton(most_passes=4)),
)
COARSE_TO_FINE = (
    StageOptions(scale="middle", solver=GaussNewton(most_passes=6)),
    StageOptions(scale=2, solver=GaussNewton(most_passes=4)),
    StageOptions(scale=1, solver=Smoother()),
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
    sections: Annotated[int, Field(ge=2)] | None = None
    """sections, equally spaced over the used height; default: 29, or fewer, for 11 rows of the detector each"""
    section_motions: tuple[str, ...] = names_of((*RIGID, CONTRACTION))
    """motions of a section: six rigid ones, and contraction"""
    time: tuple[TimeFunction, ...] = (*PAPER[:3], Ramp(powers=(0, 1, 2, 3)))
    """time functions: Table 1, and a jump and a cube at the start of loading"""
    rigid: tuple[StageOptions, ...] = COARSE_TO_FINE_RIGID
    """the sample as one rigid body; one stage or several, from coarse to fine"""
    deformation: tuple[StageOptions, ...] = COARSE_TO_FINE
    """every section by itself; one stage or several, the last at scale 1"""
    beam_hardening: Literal["fit", "none"] | tuple[float, float, float] = "fit"
    """third-order polynomial: fitted from the reference views, none, or c1, c2, c3 of attenuation"""
    smooth_px: Annotated[float, Field(ge=0, le=5)] = 0.7
    """standard deviation of the Gaussian that all radiographs are filtered with first, px; 0: none"""
    sharpen: bool = True
    """sharpen the reference views, for the volume only, by what interpolation blurs"""
    subtract_systematic: bool = True
    """subtract what re-projecting the volume leaves of the reference views, registered"""
    remove_pattern: bool = True
    """take from all images the detector's fixed pattern, where the flats' noise is known; before the last stage"""
    weighting: Literal["uniform", "noise"] = "uniform"
    """all pixels alike, as in the paper, or by the inverse of their noise"""
    brightness: Literal["flats", "air"] = "flats"
    """beam of each radiograph: that of the flats, or told by the air beside the sample, where any is seen"""
    lag: tuple[LatePart, ...] = ()
    """light that the panel gives back late, as measured on it, to be taken out: shares, each with its time"""
    self_calibration: Literal["none", "geometry", "motion"] = "none"
    """correct the geometry by the reference scan itself: not, axis and roll, or these and motion of its views"""
    outliers_over: Annotated[float, Field(ge=4, le=1e6)] | Literal["none"] = "none"
    """residual over what is usual, from which a pixel is left out of a step; then the last stage is solved again"""
    prior_voxel: Annotated[float, Field(gt=0)] = 30.0
    """standard deviation of every amplitude before the data, voxels (rms over the steps)"""

    def sections_for(self, rows: int) -> int:
        """Return the number of sections for a detector of so many rows."""
        if self.sections is not None:
            return self.sections
        return max(min(MOST_SECTIONS, rows // USUAL_ROWS), 2)

    @property
    def motions(self) -> tuple[SectionPattern, ...]:
        """Return what the names of the section motions stand for; it counts where a result is kept."""
        return motions_of(self.section_motions)

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
        try:
            motions_of(names)
        except ValueError:
            wrong = ", ".join(repr(name) for name in names if name not in offered_motions())
            said = f", {wrong} is none of them" if wrong else ""
            raise ValueError(f"some of {', '.join(offered_motions())}{said}") from None
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"every motion once, {', '.join(twice)} stands there twice")
        return names


class ResolvedOptions(MeasureOptions):
    """Options of one experiment: nothing is left to its detector or its data any more."""

    discard_rows: Annotated[int, Field(ge=0)]
    """rows left out at the top and at the bottom, px"""
    discard_columns: Annotated[int, Field(ge=0)]
    """columns left out on the left and on the right, px"""
    sections: Annotated[int, Field(ge=2)]
    """sections, equally spaced over the used height"""
    rigid: tuple[ResolvedStage, ...]
    """the sample as one rigid body; one stage or several, from coarse to fine"""
    deformation: tuple[ResolvedStage, ...]
    """every section by itself; one stage or several, the last at scale 1"""

    @property
    def scales(self) -> tuple[int, ...]:
        """Return the scales of all stages, coarsest first."""
        return tuple(sorted({stage.scale for stage in (*self.rigid, *self.deformation)}, reverse=True))


def resolved(
    options: MeasureOptions, experiment: Experiment, discard_rows: int, discard_columns: int
) -> ResolvedOptions:
    """Return the options of an experiment, with what they leave open filled in: stages, onsets, and the window."""
    found = {
        "discard_rows": discard_rows,
        "discard_columns": discard_columns,
        "sections": options.sections_for(experiment.geometry.rows),
        "time": settled(options.time, experiment.test),
        "rigid": tuple(stage.at(experiment.geometry) for stage in options.rigid),
        "deformation": tuple(stage.at(experiment.geometry) for stage in options.deformation),
    }
    return ResolvedOptions(**{**dict(options), **found})


def check_discarded(options: MeasureOptions, geometry: ConeBeam) -> None:
    """Raise ValueError where nothing of the radiographs would be left."""
    rows = 0 if options.discard_rows is None else options.discard_rows
    columns = 0 if options.discard_columns is None else options.discard_columns
    if 2 * rows >= geometry.rows or 2 * columns >= geometry.columns:
        raise ValueError(
            f"discard_rows, discard_columns: expected to leave some of {geometry.rows} x {geometry.columns} px, "
            f"got {rows} and {columns} px on each side"
        )


def paper_options() -> MeasureOptions:
    """Return the paper's protocol: Table 1, six motions a section, eight modes at scale 2, four at scale 1."""
    return MeasureOptions(
        sections=15,
        section_motions=names_of(RIGID),
        time=PAPER,
        smooth_px=0.0,
        sharpen=False,
        remove_pattern=False,
        rigid=(StageOptions(scale=2, solver=Pgd(most_modes=8)),),
        deformation=(StageOptions(scale=1, solver=Pgd(most_modes=4)),),
    )


DEFAULT = MeasureOptions()
PROTOCOLS: dict[str, Callable[[], MeasureOptions]] = {"default": MeasureOptions, "paper": paper_options}
"""Built-in options by name."""
