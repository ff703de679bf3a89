"""Noise-free radiographs kept by content, so that scenarios that differ in nothing but noise share them.

A stack is kept as ``reference-KEY.npy``, ``test-KEY.npy`` or ``interrupted-KEY.npy``, float32 (image, row, column):
the share of the open beam that each pixel sees, as `simulator.detector.seen` returns it. KEY is a digest of exactly
those parts of a scenario that the stack depends on, and of this software: not of photons, frames, readout,
gain, flats or repetition. Each stack has a key of its own, so that what changes the test alone, as its motion does,
leaves the reference scan.
"""

from __future__ import annotations

import os
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.digest import digest, software
from pdvc.progress import Progress, silent
from simulator.images import prepare
from simulator.scenario import Scenario, course_of
from simulator.side_by_side import in_order
from simulator.stacks import Stack, clear_images, clock_s, image_count
from simulator.xray import read_spectrum

_EVERY_IMAGE = ("subpixels", "exposure_samples", "exposure_share", "start_deg")
_TEST = ("test_steps", "steps_per_turn", "step_s")
_OPENING = ("first_step", "opening_steps")
"""Of a crack, when it opens: the reference scan depends on where it will be, which nodules keep clear of."""


def clean_file(scenario: Scenario, stack: Stack) -> str:
    """Return the name of the file in which a noise-free stack is kept."""
    return f"{stack.kind}-{digest(_depends_on(scenario, stack))}.npy"


def clean_stack(
    scenario: Scenario, stack: Stack, folder: Path, *, progress: Progress = silent, workers: int | None = None
) -> NDArray[np.float32]:
    """Return a noise-free stack (image, row, column), share of the open beam, as a read-only memory map.

    It is computed, `workers` images side by side, and kept where the folder does not hold it.
    """
    path = folder / clean_file(scenario, stack)
    kept = _kept(path)
    if kept is None:
        folder.mkdir(parents=True, exist_ok=True)
        # another process may be at the same stack: each writes its own file, and either may name it
        partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
        try:
            _compute(scenario, stack, partial, progress, workers or os.cpu_count() or 1)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        kept = _kept(path)
    assert kept is not None, f"{path} was written"
    return kept


def _kept(path: Path) -> NDArray[np.float32] | None:
    """Return a stack that is kept; None where it is not, or is damaged."""
    try:
        kept: NDArray[np.float32] = np.load(path, mmap_mode="r")
    except (OSError, ValueError, EOFError):
        return None
    return kept


def _compute(scenario: Scenario, stack: Stack, path: Path, progress: Progress, workers: int) -> None:
    count = image_count(scenario, stack)
    shape = count, scenario.geometry.rows, scenario.geometry.columns
    make = clear_images(prepare(scenario, course_of(scenario)), stack)
    task = f"{stack} without noise"
    progress(task, 0, count)
    # written, not mapped: a memory map ends the process where the disk is full
    with path.open("wb") as file:
        kind = np.lib.format.dtype_to_descr(np.dtype(np.float32))
        np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
        for index, image in in_order(make, range(count), workers):
            file.write(np.ascontiguousarray(image, dtype=np.float32).tobytes())
            progress(task, index + 1, count)


def _depends_on(scenario: Scenario, stack: Stack) -> dict[str, Any]:
    parts, plan = {"seed", "specimen", "graphite", "geometry", "misalignment", "xray"}, set(_EVERY_IMAGE)
    drifts = any(scenario.scanner.focal_spot.drift_mm)
    opening = set(_OPENING)
    if stack.kind != "reference":
        # motion refers to the height that the discarded rows leave
        parts |= {"discarded_rows", "loading", "motion"}
        plan |= set(_TEST)
        opening.clear()
    spectrum = read_spectrum(scenario.xray.spectrum)
    return {
        "software": software("simulator"),
        "stack": [stack.kind, stack.step, image_count(scenario, stack)],
        # the name may be that of a file, whose content may change
        "spectrum": [spectrum.energy_keV.tolist(), spectrum.fluence.tolist()],
        "blur_px": [scenario.detector.blur_px, scenario.scanner.panel.scintillator_blur_px],
        **scenario.model_dump(mode="json", include=parts),
        # faults of the panel, lag and the open beam come with the noise
        "scanner": scenario.scanner.model_dump(mode="json", include={"stage", "focal_spot", "scatter"}),
        "time_s": [clock_s(scenario, stack, index) for index in range(image_count(scenario, stack)) if drifts],
        "crack": scenario.crack.model_dump(mode="json", exclude=opening),
        "acquisition": scenario.acquisition.model_dump(mode="json", include=plan),
    }
