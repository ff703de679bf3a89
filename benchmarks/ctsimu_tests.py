"""Tests of simulators that CTSimU's toolbox evaluates, on this simulator: python -m benchmarks.ctsimu_tests.

CTSimU (BAM and others; PyPI `ctsimu`, Apache-2.0) qualifies simulators of radiographs. Those of its tests that need
neither its meshes nor its spectra are carried out here, with its own scenarios and line profiles;
`nominal` is what its scenarios ask for, or its Monte Carlo reference:

- 2D-FB-1, noise: signal over noise of a free beam;
- 2D-WE-1, focal spot: standard deviation of the line spread of an edge turned by 3 degrees, pixels;
- 2D-SW-2, iron wedge at 200 kV behind 2 mm of copper: scattered over primary radiation, for each step; of ours with
the
  ratio that `laboratory` takes, from the reference's own primary radiation.

Needs `pip install ctsimu==1.7.0`; some seconds.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
from importlib.resources import files
from typing import Any

import numpy as np
from ctsimu.image import Image
from scipy.optimize import curve_fit

from benchmarks.rows import Row, keep, show
from pdvc.geometry import ConeBeam
from simulator.detector import Detector, detector_maps, expose_flat, pixel_means
from simulator.focal_spot import FWHM, FocalSpot
from simulator.scenario import load_scenario

EVALUATION = files("ctsimu") / "evaluation"
TURN = math.radians(3)
SUBPIXELS = 4


def described(name: str) -> Any:
    """Return a scenario that comes with CTSimU's toolbox."""
    return json.loads((EVALUATION / "scenarios" / f"{name}.json").read_text(encoding="utf-8"))


def noise(name: str) -> Row:
    """Return signal over noise of a free beam: photons are those that give it, the mean of one frame."""
    detector = described(name)["detector"]
    wanted, top = detector["noise"]["snr_at_imax"]["value"], detector["gray_value"]["imax"]["value"]
    ours = Detector(
        photons_per_pixel=float(wanted**2),
        counts_full=float(top),
        dark_counts=0.0,
        readout_noise_counts=0.0,
        gain_spread=0.0,
        bad_pixel_fraction=0.0,
        beam_falloff=0.0,
        frames=1,
    )
    size = detector["rows"]["value"], detector["columns"]["value"]
    maps = detector_maps(ours, int(size[0]), int(size[1]), np.random.default_rng(0))
    image = Image()
    image.px = expose_flat(ours, maps, np.random.default_rng(1)).astype(float)
    return row("2D-FB-1", "signal over noise", wanted, image.mean() / image.stdDev())


def spot(name: str) -> Row:
    """Return the width of an edge's line spread behind a Gaussian spot; nominal: by squares with that of a point."""
    scene = described(name)
    sigma_mm = scene["source"]["spot"]["sigma"]["u"]["value"] / 1000
    pixel_mm, place = scene["detector"]["pixel_pitch"]["u"]["value"], scene["geometry"]
    scanner = ConeBeam(
        source_axis_mm=place["stage"]["center"]["x"]["value"],
        source_detector_mm=place["detector"]["center"]["x"]["value"],
        pixel_mm=pixel_mm,
        rows=int(scene["detector"]["rows"]["value"]),
        columns=int(scene["detector"]["columns"]["value"]),
    )
    blur_px = FocalSpot(size_mm=sigma_mm * FWHM).blur_px(scanner)
    found, sharp = (spread_px(edge(scanner, each)) for each in (blur_px, 0.0))
    nominal = math.hypot(sigma_mm * (scanner.magnification - 1) / pixel_mm, sharp)
    return row("2D-WE-1", f"line spread of a spot of {sigma_mm * 1000:.0f} um, px", nominal, found)


def edge(scanner: ConeBeam, blur_px: float) -> np.ndarray:
    """Return the image (row, column) of a half space, whose edge through the middle is turned by 3 degrees."""
    x, y = ((np.arange(n * SUBPIXELS) + 0.5) / SUBPIXELS - n / 2 for n in (scanner.columns, scanner.rows))
    free = x * math.cos(TURN) + y[:, None] * math.sin(TURN) > 0
    return 60000.0 * pixel_means(free.astype(np.float32), SUBPIXELS, blur_px)


def spread_px(picture: np.ndarray) -> float:
    """Return the deviation of the Gaussian fitted to the derivative of CTSimU's line profile, pixels."""
    rows, columns = picture.shape
    image = Image()
    image.px, image.width, image.height = picture, columns, rows
    half = 20.05
    along, down = half * math.cos(TURN), half * math.sin(TURN)
    with contextlib.redirect_stdout(io.StringIO()):
        profile, place, _ = image.lineProfile(
            x0=columns / 2 - along,
            y0=rows / 2 - down,
            x1=columns / 2 + along,
            y1=rows / 2 + down,
            width=20,
            resolution=0.2,
        )
    # without noise there is nothing to smooth, which CTSimU does before it differentiates
    spread = np.gradient(profile)
    start = 0.0, 2.0, spread.max()
    fit, _ = curve_fit(lambda x, m, s, a: a * np.exp(-(((x - m) / s) ** 2) / 2), place - half, spread, start)
    return float(abs(fit[1]))


def scatter() -> list[Row]:
    """Return scattered over primary radiation behind each step of the wedge."""
    text = (EVALUATION / "data" / "2D-SW-2_scenario04_Fe_CuFilter_200kV-poly_Ideal.txt").read_text(encoding="utf-8")
    table = np.loadtxt(io.StringIO(text), delimiter="\t")
    # means of ROSI and McRay; the last row is the free beam
    total, primary = (table[:, a] + table[:, b] for a, b in ((1, 4), (9, 12)))
    law = load_scenario("laboratory").scanner.scatter
    rows = []
    for step in range(len(table) - 2):
        transmission = np.full((3, 3), primary[step] / primary[-1], dtype=np.float32)
        ours = float(law.on(transmission, 1.0)[1, 1] / transmission[1, 1] - 1)
        rows.append(row("2D-SW-2", f"scatter, step {step + 1}", total[step] / primary[step] - 1, ours))
    return rows


def row(test: str, what: str, nominal: float, ours: float) -> Row:
    """Return a row of the table."""
    return {"test": test, "what": what, "nominal": f"{nominal:.4g}", "ours": f"{ours:.4g}"}


def main() -> None:
    """Carry out, print and keep a table."""
    rows = [noise(f"2D-FB-1_Detektor{n}_SNR{snr}_2021-05-25v06r00dp") for n, snr in ((1, 100), (2, 250))]
    rows += [spot(f"2D-WE-1_Spot{n}_2021-10-13v02r04dp") for n in (1, 2)]
    rows += scatter()
    for each in rows:
        show(each)
    keep(rows, "ctsimu_tests")


if __name__ == "__main__":
    main()
