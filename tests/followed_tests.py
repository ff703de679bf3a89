"""Records of tests that were followed, in closed form, to show them without measuring anything."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from pdvc.record import AlarmLine, Line, LostLine, MeasurementLine, PlanLine, Record, StepLine
from validation.view.pictures import Pictures
from validation.view.places import Places

TITLE = "Tension <b>in situ</b> & more"
STEPS = 12
HEIGHT_MM = tuple(np.linspace(-2, 2, 9).tolist())
PLAN = PlanLine(title=TITLE, steps=STEPS, height_mm=HEIGHT_MM, voxel_mm=0.01)
ALARM = AlarmLine(
    step=5, alarm="crack", value=9.1, limit=6.0, reason="9.1 <i>deviations</i>", place_mm=(float("nan"), 0.1, 1.3)
)
LOST = LostLine(step=6, file="00006.tif", reason="00006.tif: expected 4 x 3 px")
OVER = MeasurementLine(file="motion.nc", seconds=3.0)


def step(t: int, unix_s: float = 1e9) -> StepLine:
    """Return the line of a step: a mean strain of t / 10 %, twice that at mid-height, steps a second apart."""
    middle = (np.array(HEIGHT_MM)[1:] + np.array(HEIGHT_MM)[:-1]) / 2
    return StepLine(
        step=t,
        file=f"{t:05d}.tif",
        angle_deg=7.2 * t,
        time_s=2.0 * t,
        force_N=250.0 + 10 * t,
        displacement_voxel=((0.1, 0.2, 0.3),) * len(HEIGHT_MM),
        displacement_std=((0.01, 0.01, 0.1),) * len(HEIGHT_MM),
        strain=tuple((t / 1000 * 2 * np.exp(-(middle**2))).tolist()),
        strain_std=(2e-4,) * len(middle),
        mean_strain=t / 1000,
        mean_strain_std=1e-4,
        chi2_reduced=1.02,
        passes=5,
        seconds=0.38,
        unix_s=unix_s + t,
    )


def written(folder: Path, *lines: Line) -> Places:
    """Return the places of a test whose record holds these lines, and pictures of no step."""
    places = Places(file=folder / "motion.nc")
    add(places, *lines)
    return places


def add(places: Places, *lines: Line) -> None:
    """Add lines to a record."""
    record = Record(places.record)
    for line in lines:
        record.add(line)
    record.close()


def seen(t: int, size: tuple[int, int] = (40, 30)) -> tuple[SimpleNamespace, SimpleNamespace]:
    """Return a radiograph, and what became of it, as far as pictures ask."""
    counts = np.full(size, 40000, dtype=np.uint16)
    counts[:, size[1] // 3 : 2 * size[1] // 3] = 10000
    residual = np.zeros((size[0] - 10, size[1] - 10), dtype=np.float32)
    residual[5, 5:9] = 7, -7, 2.5, np.nan
    return SimpleNamespace(step=t, file=f"{t:05d}.tif", counts=counts), SimpleNamespace(residual=residual)


def pictured(places: Places, radiographs: Path, *steps: int, told: tuple[Line, ...] = ()) -> list[str]:
    """Leave pictures of steps, as live does; return what was warned of."""
    warned: list[str] = []
    pictures = Pictures(places.pictures, radiographs, warned.append)
    for line in told:
        pictures.tell(line)
    for t in steps:
        radiographs.mkdir(exist_ok=True)
        (radiographs / f"{t:05d}.tif").write_bytes(b"")
        pictures.see(*seen(t))
    return warned


def latest(places: Places) -> dict:
    """Return what is told of the newest pictures."""
    return json.loads((places.pictures / "latest.json").read_text())
