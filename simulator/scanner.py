"""Carry out a scenario: write an experiment folder and the truth beside it.

Files are written in this order: the scenario, the true displacements and geometry, flats, darks, reference scan, test,
interrupted scans, and last `experiment.toml`, which declares the folder complete. Every image has its own random
generator, seeded by (seed, stack, number): counts depend neither on the number of workers nor on interruptions,
and a run that was interrupted goes on where it stopped.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.experiment import (
    DARKS,
    DESCRIPTION,
    FLATS,
    REFERENCE,
    TEST,
    AcquisitionEntry,
    Description,
    GeometryEntry,
    InterruptedEntry,
    StackEntry,
    StackWriter,
    interrupted_stack,
    write_description,
)
from pdvc.lock import FULL_DISK, held
from pdvc.progress import Progress, silent
from simulator.clean import clean_stack
from simulator.detector import DetectorMaps, expose_dark, expose_flat
from simulator.images import Clear, maps_of, prepare
from simulator.scenario import Course, Scenario, course_of
from simulator.side_by_side import in_order
from simulator.stacks import Image, Stack, clear_images, conditions_of, exposed, image_count, late_images, stacks_of
from simulator.streams import stream
from simulator.true_geometry import GEOMETRY, true_geometry, write_geometry
from simulator.truth import DISPLACEMENT, SCENARIO, read_scenario, sample_truth, write_scenario, write_truth

Floats = NDArray[np.float64]


class SimulationError(ValueError):
    """A scenario that cannot be carried out in a folder: why, and what to do."""


def simulate(
    scenario: Scenario,
    folder: Path,
    *,
    progress: Progress = silent,
    workers: int | None = None,
    clean: Path | None = None,
) -> None:
    """Carry out a scenario and write its experiment folder, or go on with it where it was interrupted.

    `workers` radiographs are computed side by side, by default as many as there are processors. `clean` is a folder
    in which noise-free radiographs are kept, and found again by other scenarios that differ in nothing but noise
    (`simulator.clean`); counts do not depend on it.
    Raises SimulationError where the folder holds something else, InUseError where another process is at work in it,
    and OSError where it cannot be written; a full disk is answered with the room that is needed.
    """
    check_folder(scenario, folder)
    whole = DESCRIPTION, DISPLACEMENT, GEOMETRY, FLATS, DARKS, *_stacks(scenario)
    if all((folder / name).is_file() for name in whole):
        return
    with held(folder), _full_disk_explained(scenario, folder):
        (folder / DESCRIPTION).unlink(missing_ok=True)
        write_scenario(folder, scenario)
        _write_all(scenario, folder, progress, workers or os.cpu_count() or 1, clean)


@contextmanager
def _full_disk_explained(scenario: Scenario, folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in FULL_DISK:
            raise
        reason = f"disk full: {scenario.name} needs {_size_mb(scenario):.0f} MB"
        raise OSError(error.errno, reason, str(folder)) from None


def check_folder(scenario: Scenario, folder: Path) -> None:
    """Refuse a folder that holds something else than a run of this scenario."""
    if (folder / SCENARIO).is_file():
        found = read_scenario(folder)
        if found != scenario:
            key = first_difference(found.model_dump(), scenario.model_dump())
            raise SimulationError(
                f"{folder}: holds a run of another scenario ({found.name}; {key} differs): "
                "choose another folder, or delete this one"
            )
        return
    for name in (DESCRIPTION, REFERENCE, TEST, FLATS, DARKS):
        if (folder / name).exists():
            raise SimulationError(
                f"{folder}: holds {name} of an experiment that was not simulated: choose another folder"
            )


def first_difference(one: dict[str, Any], other: dict[str, Any]) -> str:
    """Return the path of the first key whose values differ in two nested records."""
    for key, value in one.items():
        if value != other[key]:
            return f"{key}.{first_difference(value, other[key])}" if isinstance(value, dict) else key
    return ""


def _write_all(scenario: Scenario, folder: Path, progress: Progress, workers: int, clean: Path | None) -> None:
    progress("sample", 0, 1)
    course = course_of(scenario)
    write_truth(folder, sample_truth(scenario, course))
    write_geometry(folder, true_geometry(scenario, course))
    detector, maps = scenario.detector, maps_of(scenario)
    clear_of = _clear_stacks(scenario, course, progress, workers, clean)
    progress("sample", 1, 1)
    conditions = conditions_of(scenario, 0.0, scenario.acquisition.reference_view_s)
    without_sample: tuple[tuple[str, str, int, Callable[[int], Image]], ...] = (
        (
            *("flats", FLATS, detector.flats),
            lambda k: expose_flat(detector, maps, stream(scenario, "flats", k), conditions),
        ),
        (
            *("darks", DARKS, detector.darks),
            lambda k: expose_dark(detector, maps, stream(scenario, "darks", k), conditions),
        ),
    )
    for task, name, count, make in without_sample:
        _write_stack(scenario, folder / name, task, count, make, progress, workers)
    for stack, name in zip(stacks_of(scenario), _stacks(scenario), strict=True):
        make = partial(_noisy, scenario, maps, late_images(scenario, stack, clear_of), stack)
        _write_stack(scenario, folder / name, str(stack), image_count(scenario, stack), make, progress, workers)
    write_description(folder, describe(scenario, course))


def _clear_stacks(
    scenario: Scenario, course: Course, progress: Progress, workers: int, clean: Path | None
) -> Callable[[Stack], Callable[[int], Clear]]:
    """Return the function that gives for each stack its images without noise, by their numbers."""
    if clean is None:
        return partial(clear_images, prepare(scenario, course))
    folder = clean
    return lambda stack: clean_stack(scenario, stack, folder, progress=progress, workers=workers).__getitem__


def _noisy(scenario: Scenario, maps: DetectorMaps, clear: Callable[[int], Clear], stack: Stack, index: int) -> Image:
    return exposed(scenario, maps, clear(index), stack, index)


def _write_stack(
    scenario: Scenario,
    path: Path,
    task: str,
    count: int,
    make: Callable[[int], Image],
    progress: Progress,
    workers: int,
) -> None:
    with StackWriter(path, (count, scenario.geometry.rows, scenario.geometry.columns)) as writer:
        progress(task, writer.done, count)
        for index, image in in_order(make, range(writer.done, count), workers):
            writer.write(index, image)
            progress(task, writer.done, count)


def _stacks(scenario: Scenario) -> tuple[str, ...]:
    """Return the files of the stacks that a scenario makes with the sample in the beam."""
    return REFERENCE, TEST, *(interrupted_stack(n) for n in range(len(scenario.interrupted.steps)))


def describe(scenario: Scenario, course: Course) -> Description:
    """Return what the laboratory would write down: recorded geometry, angles, times and measured forces."""
    rng = stream(scenario, "force")
    views, noise = scenario.acquisition.reference_views, scenario.acquisition.force_noise_N
    at_rest = scenario.loading.plateau_N + noise * rng.standard_normal(views)
    force = course.history.force_N + noise * rng.standard_normal(len(course.test_time_s))
    return Description(
        title=scenario.title,
        material=scenario.material,
        geometry=GeometryEntry(**scenario.geometry.model_dump()),
        acquisition=AcquisitionEntry(
            frames=scenario.detector.frames,
            photons_per_count=scenario.detector.photons_per_count,
            readout_noise_counts=scenario.detector.readout_noise_counts,
        ),
        reference=_stack_entry(course.reference_angle_rad, course.reference_time_s, at_rest),
        test=_stack_entry(course.test_angle_rad, course.test_time_s, force),
        interrupted=tuple(_interrupted_entry(scenario, course, n) for n in range(len(course.interrupted_time_s))),
    )


def _interrupted_entry(scenario: Scenario, course: Course, scan: int) -> InterruptedEntry:
    step, time_s = scenario.interrupted.steps[scan], course.interrupted_time_s[scan]
    noise = stream(scenario, "interrupted force", step).standard_normal(len(time_s))
    force = course.history.force_N[step] + scenario.acquisition.force_noise_N * noise
    stack = _stack_entry(course.interrupted_angle_rad, time_s, force)
    return InterruptedEntry(step=step, **stack.model_dump())


def _stack_entry(angle_rad: Floats, time_s: Floats, force_N: Floats) -> StackEntry:
    return StackEntry(
        angle_deg=tuple(np.rad2deg(angle_rad).round(10).tolist()),
        time_s=tuple(time_s.round(6).tolist()),
        force_N=tuple(force_N.tolist()),
    )


def _size_mb(scenario: Scenario) -> float:
    plan, detector = scenario.acquisition, scenario.detector
    held = scenario.interrupted
    images = plan.reference_views + plan.test_steps + detector.flats + detector.darks
    images += len(held.steps) * (held.views or plan.reference_views)
    return images * scenario.geometry.rows * scenario.geometry.columns * 2e-6 + 10
