"""Method 6: local volume correlation by spam, a program by others, on the same volumes.

spam (Stamati et al., Journal of Open Source Software 5, 2020; https://www.spam-project.dev) comes under the GPL. It is
never imported: its programs spam-reg and spam-ldic are run, as a user of spam would, with their defaults:

1. the reference scan and each interrupted scan are reconstructed at scale 1, on one grid, and written as TIFF;
2. spam-reg finds the affine motion of the whole sample, from four times coarser down to every voxel;
3. spam-ldic starts from it and correlates windows of 21 x 21 x 21 voxels by themselves, each by an affine motion;
   windows that are more air than sample are left out.

What comes back are displacements U of nodes X of the reference volume. The section amplitudes are the least-squares
fit of u(X + U) = U over the nodes that converged and lie within the used height. The fit averages many
nodes, so that its errors are smaller than those of spam's single nodes.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from pdvc.experiment import Experiment
from pdvc.history import Steps, time_basis
from pdvc.measurement import MeasuredMotion, Measurement, Provenance, Stage, unfitted
from pdvc.options import MeasureOptions
from pdvc.preparation import Care, scan_volume
from pdvc.prior import solved
from pdvc.progress import silent
from pdvc.protocol import versions
from pdvc.radiographs import IDENTITY
from pdvc.sections import SectionBasis
from pdvc.setup import Setup, outlined, set_up
from pdvc.verdict import Stop
from pdvc.volume import Grid, Volume
from validation.methods.registry import Method, MethodError

Floats = NDArray[np.float64]

PROGRAMS = ("spam-reg", "spam-ldic")
HALF_WINDOW_VOXEL = 10
"""Half a window of spam-ldic, its default."""
SPACING_VOXEL = 10
"""Distance of nodes, spam's default; half the distance of sections where that is less, so that each has nodes."""
CONVERGED = 2
"""What spam writes as returnStatus of a node that converged."""
AIR_SHARE = 0.25
"""Air put beside the volumes, of their width: spam-reg loses a sample that moves into the border of its image."""
LEAST_MISFIT_VOXEL = 1e-4
LEAST_NODES = 3.0
"""A section with fewer nodes, weighted by its hat, is unobserved."""


@dataclass(frozen=True, kw_only=True)
class Nodes:
    """The nodes that spam-ldic correlated and that converged."""

    point_mm: Floats
    """X (node, 3), mm, in the reference state."""
    displacement_voxel: Floats
    """U (node, 3), voxels."""
    tried: int
    """Nodes that were correlated, converged or not."""


def check() -> None:
    """Raise MethodError where the programs of spam are not found."""
    for name in PROGRAMS:
        program(name)


def program(name: str) -> Path:
    """Return where a program of spam is: beside this Python, or on the PATH."""
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.is_file() else shutil.which(name)
    if found is None:
        raise MethodError(
            f"method 'spam': expected the program {name}, found none: pip install 'pdvc-bench[spam]', or put the "
            "programs of another environment with spam on the PATH"
        )
    return Path(found)


def correlate_by_spam(experiment: Experiment) -> Measurement:
    """Correlate the interrupted scans with the reference scan by spam, and fit our sections to what it finds.

    Raises ValueError, in one line, where there is no scan, and MethodError where spam is not installed.
    """
    check()
    if not experiment.interrupted:
        raise ValueError("interrupted scans: expected at least one, found none: spam compares full scans")
    started = time.perf_counter()
    setup = set_up(experiment, MeasureOptions())
    basis = setup.sections
    reference, volumes = _volumes(setup)
    correlating = time.perf_counter()
    spacing_mm = float(np.diff(basis.height_mm).min())
    spacing = min(SPACING_VOXEL, max(int(spacing_mm / reference.grid.voxel_mm / 2), 1))
    steps, told = [], []
    amplitude = np.full((len(experiment.test), *basis.shape), np.nan)
    observed = np.zeros(basis.shape[0], dtype=bool)
    with tempfile.TemporaryDirectory(prefix="spam-") as folder:
        for scan, volume in zip(experiment.interrupted, volumes, strict=True):
            nodes = correlated(reference, volume, Path(folder), spacing)
            if nodes is None:
                told.append(f"step {scan.step}: spam-reg did not converge")
                continue
            found, seen, rms = fitted(basis, nodes, setup.geometry.voxel_mm, setup.options.prior_voxel)
            told.append(
                f"step {scan.step}: {len(nodes.point_mm)} of {nodes.tried} nodes converged; the sections fit "
                f"them to {rms:.2g} voxel rms"
            )
            amplitude[scan.step] = found
            observed |= seen
            steps.append(scan.step)
    if not steps:
        raise ValueError(f"spam: expected at least one scan that can be correlated, found none: {'; '.join(told)}")
    amplitude[:, ~observed] = np.nan
    size = basis.shape[0] * basis.shape[1]
    stage = Stage(
        name="deformation",
        scale=1,
        solver="spam-ldic",
        unknowns=len(steps) * size,
        temporal=np.empty((0, len(amplitude))),
        spatial=np.empty((0, *basis.shape)),
        rms=np.empty(0),
        stop=Stop.UNFINISHED if any("did not converge" in each for each in told) else Stop.CONVERGED,
        stop_reason="; ".join(told),
    )
    return Measurement(
        recording=setup.recording(),
        motion=MeasuredMotion(
            basis=basis,
            time_functions=time_basis((Steps(),), experiment.test)[steps],
            amplitude=amplitude,
            # spam tells no uncertainty
            covariance=np.full((len(steps), size, size), np.nan),
            amplitude_std=np.full_like(amplitude, np.nan),
            data_share=np.full_like(amplitude, np.nan),
            observed=observed,
        ),
        fit=unfitted((stage,), len(amplitude)),
        provenance=Provenance(
            seconds={"reconstruct": correlating - started, "measure": time.perf_counter() - correlating},
            options=setup.options.template(),
            versions=f"{versions()}, spam {_version()}",
        ),
    )


SPAM = Method(
    name="spam",
    measure=correlate_by_spam,
    assumes="Assume windows of 21 voxels that each deform affinely, and a sample that stands still at some steps for "
    "as long as a full scan takes, without creep. Our sections are fitted to the nodes of spam's local correlation "
    "afterwards.",
    looks_at="volumes",
    check=check,
)


def _volumes(setup: Setup) -> tuple[Volume, list[Volume]]:
    """Return the volumes of the reference and the interrupted scans, those that `classical-dvc` has."""
    experiment, geometry, calibration = setup.experiment, setup.geometry, setup.calibration
    plain, polynomial = calibration.with_polynomial(IDENTITY), calibration.polynomial
    hull = setup.outline.hull
    reference = scan_volume(experiment.reference, geometry, calibration, hull, 1, Care(), _made, silent)
    volumes = []
    for scan in experiment.interrupted:
        hull = outlined(scan.series, geometry, plain, polynomial, _made, silent).hull
        volumes.append(scan_volume(scan.series, geometry, calibration, hull, 1, Care(), _made, silent))
    return reference, volumes


def _made(make):  # type: ignore[no-untyped-def]
    """Keep nothing: intermediate results are for those who measure often."""
    return make()


def correlated(reference: Volume, deformed: Volume, folder: Path, spacing_voxel: int) -> Nodes | None:
    """Run spam on two volumes; None where it does not find the sample again.

    Raises ValueError where a program of spam fails.
    """
    grid = with_air(union(reference.grid, deformed.grid))
    # grey levels of about one, so that the threshold of air is half of that
    level = float(np.median(reference.values[reference.values > 0.5 * np.quantile(reference.values, 0.999)]))
    for name, volume in (("reference", reference), ("deformed", deformed)):
        tifffile.imwrite(folder / f"{name}.tif", placed(volume, grid) / np.float32(level))
    images = ("reference.tif", "deformed.tif")
    _run("spam-reg", [*images, "-bb", "4", "-be", "1", "-od", ".", "-pre", "whole"], folder)
    whole = folder / "whole-registration.tsv"
    if not whole.is_file() or not len(_read(whole, grid).point_mm):
        return None
    air = ["-glt", "0.5"]
    windows = ["-hws", str(HALF_WINDOW_VOXEL), "-ns", str(spacing_voxel)]
    _run("spam-ldic", [*images, "-pf", whole.name, *windows, *air, "-np", "1", "-od", ".", "-pre", "local"], folder)
    return _read(folder / "local-ldic.tsv", grid)


def union(one: Grid, other: Grid) -> Grid:
    """Return the smallest grid that holds two of the same lattice."""
    first = np.minimum(one.origin_mm, other.origin_mm)
    ends = [np.array(each.origin_mm) + each.voxel_mm * (np.array(each.shape[::-1]) - 1) for each in (one, other)]
    nx, ny, nz = (int(count) for count in np.rint((np.maximum(*ends) - first) / one.voxel_mm) + 1)
    x, y, z = (float(value) for value in first)
    return Grid(shape=(nz, ny, nx), voxel_mm=one.voxel_mm, origin_mm=(x, y, z))


def with_air(grid: Grid) -> Grid:
    """Return the grid with voxels of air added on the four sides, not at the ends, where the sample goes on."""
    nz, ny, nx = grid.shape
    x, y, z = grid.origin_mm
    more_y, more_x = math.ceil(AIR_SHARE * ny), math.ceil(AIR_SHARE * nx)
    return Grid(
        shape=(nz, ny + 2 * more_y, nx + 2 * more_x),
        voxel_mm=grid.voxel_mm,
        origin_mm=(x - more_x * grid.voxel_mm, y - more_y * grid.voxel_mm, z),
    )


def placed(volume: Volume, grid: Grid) -> NDArray[np.float32]:
    """Return the values (z, y, x) on a larger grid of the same lattice, zero where the volume has none."""
    offset = np.rint((np.array(volume.grid.origin_mm) - grid.origin_mm) / grid.voxel_mm).astype(int)[::-1]
    result = np.zeros(grid.shape, dtype=np.float32)
    result[tuple(slice(at, at + n) for at, n in zip(offset, volume.grid.shape, strict=True))] = volume.values
    return result


def _run(name: str, arguments: Sequence[str], folder: Path) -> None:
    """Run a program of spam in a folder, on one thread."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    done = subprocess.run(
        [program(name), *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        last = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()][-1:]
        raise ValueError(f"{name}: expected it to end well, it ended with {done.returncode}: {' '.join(last)}")


def _read(path: Path, grid: Grid) -> Nodes:
    """Read the nodes of a table that spam wrote: positions and displacements in voxels, in the order z, y, x."""
    try:
        table = np.atleast_1d(np.genfromtxt(path, names=True, delimiter="\t"))
        place = np.stack([table[f"{axis}pos"] for axis in "XYZ"], axis=-1)
        moved = np.stack([table[f"{axis}disp"] for axis in "XYZ"], axis=-1)
        status = table["returnStatus"]
    except (OSError, ValueError) as error:
        raise ValueError(f"{path.name}: expected a table of nodes by spam, cannot read it: {error}") from None
    good = (status == CONVERGED) & np.isfinite(moved).all(axis=1)
    return Nodes(
        point_mm=np.asarray(grid.origin_mm) + grid.voxel_mm * place[good],
        displacement_voxel=moved[good],
        # below: windows of air, or at the border, that were not correlated
        tried=int((status >= 0).sum()),
    )


def fitted(
    basis: SectionBasis, nodes: Nodes, voxel_mm: float, prior_voxel: float
) -> tuple[Floats, NDArray[np.bool_], float]:
    """Return the section amplitudes that fit nodes, voxels, which sections nodes tell of, and the rms misfit, voxels.

    u is a function of the current position, so that it is asked to be U at X + U. The prior, the standard deviation
    of every amplitude in voxels, holds what the nodes do not determine; it is weighed against their misfit.
    """
    current = nodes.point_mm + voxel_mm * nodes.displacement_voxel
    inside = (current[:, 2] >= basis.height_mm[0]) & (current[:, 2] <= basis.height_mm[-1])
    current, wanted = current[inside], nodes.displacement_voxel[inside].ravel()
    if not len(current):
        return np.zeros(basis.shape), np.zeros(basis.shape[0], dtype=bool), 0.0
    shapes = basis.shapes(current).reshape(len(wanted), -1)
    free, *_ = np.linalg.lstsq(shapes, wanted)
    misfit = float(np.sqrt(((shapes @ free - wanted) ** 2).mean()))
    ridge = (max(misfit, LEAST_MISFIT_VOXEL) / prior_voxel) ** 2 * np.eye(shapes.shape[1])
    amplitude = solved(shapes.T @ shapes + ridge, shapes.T @ wanted)
    observed = basis.weights(current[:, 2]).sum(axis=0) >= LEAST_NODES
    return amplitude.reshape(basis.shape), observed, misfit


def _version() -> str:
    """Return the version of spam, from the environment that its programs belong to."""
    python = program(PROGRAMS[0]).resolve().with_name("python")
    code = "from importlib.metadata import version; print(version('spam'))"
    try:
        told = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False).stdout.strip()
    except OSError:  # its programs stand apart from their Python
        told = ""
    return told or "of unknown version"
