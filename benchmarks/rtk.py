"""RTK's Joseph projector and FDK on the CPU, fed with this project's geometry and volumes.

RTK turns the scanner about its y axis: at gantry angle phi the source is at sid (sin phi, 0, cos phi), detector
rows run along (cos phi, 0, -sin phi), columns along +y, all right-handed. With

    (X, Y, Z) of RTK = (y, z, x) of pdvc.geometry,      phi = pi - theta,

source and detector columns of both coincide, and RTK's detector rows run upwards, hence a flip.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.geometry import ConeBeam
from pdvc.volume import Grid

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

MISSING = "RTK is not installed: its rows are left out (pip install '.[bench]', 1.75 GB, brings it)"


def available() -> bool:
    """Tell whether RTK is installed."""
    try:
        version("itk-rtk")
    except PackageNotFoundError:
        return False
    return True


def set_threads(count: int) -> None:
    """Let filters made from now on use this many threads."""
    import itk

    itk.MultiThreaderBase.SetGlobalMaximumNumberOfThreads(count)
    itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(count)


class Joseph:
    """RTK's Joseph forward projection of a volume, ready to be run and timed again and again."""

    def __init__(self, values: Image, grid: Grid, geometry: ConeBeam, angle_rad: Floats, threads: int) -> None:
        import itk
        from itk import RTK as rtk

        kind = itk.Image[itk.F, 3]
        self._filter = rtk.JosephForwardProjectionImageFilter[kind, kind].New()
        self._blank = _empty((geometry.columns, geometry.rows, len(angle_rad)), *_detector(geometry))
        self._filter.SetInput(self._blank.GetOutput())
        self._filter.SetInput(1, _volume(values, grid))
        self._filter.SetGeometry(_geometry(geometry, angle_rad))
        self._filter.SetNumberOfWorkUnits(threads)

    def run(self) -> None:
        """Project."""
        self._blank.Modified()
        self._filter.Modified()
        self._filter.UpdateLargestPossibleRegion()

    def result(self) -> Image:
        """Return the projections (angle, row, column)."""
        import itk

        return np.asarray(itk.array_from_image(self._filter.GetOutput())[:, ::-1])


def fdk(views: Image, geometry: ConeBeam, angle_rad: Floats, grid: Grid) -> tuple[Any, Any]:
    """Return what runs RTK's FDK on views (view, row, column), and what returns the volume (z, y, x)."""
    import itk
    from itk import RTK as rtk

    kind = itk.Image[itk.F, 3]
    filter_ = rtk.FDKConeBeamReconstructionFilter[kind].New()
    size = (grid.shape[1], grid.shape[0], grid.shape[2])
    blank = _empty(size, [grid.voxel_mm] * 3, _corner(grid))
    filter_.SetInput(0, blank.GetOutput())
    filter_.SetInput(1, _stack(views, geometry))
    filter_.SetGeometry(_geometry(geometry, angle_rad))

    def run() -> None:
        blank.Modified()
        filter_.Modified()
        filter_.UpdateLargestPossibleRegion()

    def result() -> Image:
        return np.asarray(itk.array_view_from_image(filter_.GetOutput())).transpose(1, 2, 0)

    return run, result


def _geometry(geometry: ConeBeam, angle_rad: Floats) -> Any:
    from itk import RTK as rtk

    if geometry.roll_rad:
        raise ValueError("RTK: a detector turned in its plane is not passed on")
    result = rtk.ThreeDCircularProjectionGeometry.New()
    for angle in angle_rad:
        result.AddProjection(
            geometry.source_axis_mm,
            geometry.source_detector_mm,
            180.0 - float(np.rad2deg(angle)),
            geometry.column_shift_mm,
            -geometry.row_shift_mm,
        )
    return result


def _stack(views: Image, geometry: ConeBeam) -> Any:
    """Return radiographs as an ITK image (angle, v, u), v upwards."""
    import itk

    image = itk.image_from_array(np.ascontiguousarray(views[:, ::-1], dtype=np.float32))
    spacing, origin = _detector(geometry)
    image.SetSpacing(spacing)
    image.SetOrigin(origin)
    return image


def _detector(geometry: ConeBeam) -> tuple[list[float], list[float]]:
    """Return spacing and origin of a stack of radiographs."""
    pixel = geometry.pixel_mm
    return [pixel, pixel, 1.0], [-pixel * (geometry.columns - 1) / 2, -pixel * (geometry.rows - 1) / 2, 0.0]


def _corner(grid: Grid) -> list[float]:
    x, y, z = grid.origin_mm
    return [y, z, x]


def _empty(size: tuple[int, int, int], spacing: list[float], origin: list[float]) -> Any:
    """Return a source of zeros: RTK's filters work in place and would use up a plain image.

    ITK does not keep a source alive through its output: the caller has to.
    """
    import itk
    from itk import RTK as rtk

    source = rtk.ConstantImageSource[itk.Image[itk.F, 3]].New()
    source.SetSize(list(size))
    source.SetSpacing(spacing)
    source.SetOrigin(origin)
    source.SetConstant(0.0)
    return source


def _volume(values: Image, grid: Grid) -> Any:
    """Return a volume as an ITK image (Z, Y, X) = (x, z, y)."""
    import itk

    image = itk.image_from_array(np.ascontiguousarray(values.transpose(2, 0, 1)))
    image.SetSpacing([grid.voxel_mm] * 3)
    image.SetOrigin(_corner(grid))
    return image
