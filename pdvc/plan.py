"""Plan a test before it is made: what can be expected of it, from the sensitivities of its reference scan alone.

No load step is needed: at rest, a step at angle theta shows what the reference scan shows there. Its matrix B(theta)
says what the step tells about the sections, and Q(theta) = S^T W V_g W S what its noise does. A test has

    H = sum_t sigma(t) sigma(t)^T (x) B(theta_t)
    V = [ sum_t sigma(t) sigma(t)^T (x) Q(theta_t) + sum_ab s_a s_b^T (x) Q(a, b) + sum_p v_phi z z^T / m ] / k

with k the frames averaged and m the flats, each over those of the reference scan; s_a the sum of sigma over the steps
at an angle a, and Q(a, b) = S_a^T W V_g W S_b over the pairs of angles whose nearest reference view is the same: its
noise is as large as the steps' and returns with each turn; v_phi(p) the relative variance of the mean flat and z(p)
its effect (`pdvc.noise`). The flats' noise cancels where a pixel is compared with itself, so that z depends on how far
the sample moves: the mean motion that is expected at each step is taken, to whole pixels. What is expected are the
deviations of `pdvc.uncertainty`, which hold noise and prior, not what the model cannot follow.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import Knowledge, beam_frame
from pdvc.digest import digest
from pdvc.equations import STEPS_AT_ONCE, Images, joined, linearise
from pdvc.experiment import Experiment, Series
from pdvc.geometry import nearest_angles
from pdvc.history import time_basis
from pdvc.noise import BELIEF, StepNoise
from pdvc.options import MeasureOptions
from pdvc.pattern import left_of_flats
from pdvc.preparation import prepare, stated_noise
from pdvc.progress import Progress, silent
from pdvc.projection import Sensitivities, sensitivities
from pdvc.radiographs import noise_overlap, smoothed
from pdvc.rays import ray_vectors
from pdvc.sections import SectionBasis
from pdvc.sensitivity_sums import Pile, Spread, adjoint, product
from pdvc.setup import set_up
from pdvc.uncertainty import sandwich

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PlannedTest:
    """A test that has not been made: what would be recorded with its radiographs, and how the sample would move."""

    angle_rad: Floats
    """(step,)"""
    time_s: Floats
    """(step,)"""
    force_N: Floats
    """(step,)"""
    moved_mm: Floats
    """Mean motion of the sample (step, 3) in the sample's frame; zero where nothing is known of it."""
    share: float = 1.0
    """Steps over those that the options count in: time functions that count steps are stretched by it."""
    sections: int | None = None
    """Sections; None: those of the options."""
    frames: float = 1.0
    """Frames averaged into each radiograph, over those of the reference scan."""
    flats: float = 1.0
    """Number of flats over that of the reference scan."""

    def recorded(self) -> Series:
        """Return what would be recorded, without counts."""
        return Series(
            counts=np.zeros((len(self.angle_rad), 1, 1), dtype=np.uint16),
            angle_rad=self.angle_rad,
            time_s=self.time_s,
            force_N=self.force_N,
        )


@dataclass(frozen=True, kw_only=True)
class WeakMotion:
    """A motion that the radiographs hardly show: an independent direction of what stays uncertain."""

    deviation_voxel: tuple[float, float, float]
    """rms over steps and points, for one standard deviation: across the beam, vertical, along the beam."""
    prior_share: float
    """Its variance over that of the prior: 1 where the radiographs say nothing."""
    motions: tuple[str, ...]
    """Section motions that make most of it, the largest first."""


class Planner:
    """A reference scan, and what steps at rest would tell.

    Of the experiment its test is not looked at. Raises ValueError where its description does not tell the noise.
    """

    def __init__(self, experiment: Experiment, options: MeasureOptions, *, progress: Progress = silent) -> None:
        self._progress = progress
        self._time = options.time
        self._setup = set_up(replace(experiment, test=experiment.reference), options, progress=progress)
        self._reference_rad = experiment.reference.angle_rad
        prepared = prepare(self._setup, 1, progress)
        noise, _ = stated_noise(self._setup, prepared.systematic)
        self._noise = noise
        self._images = prepared.images
        self._systematic = prepared.systematic
        left = noise_overlap(noise.smooth_px)[0] ** 2
        steps = [noise.step(t) for t in range(len(self._reference_rad))]
        self._variance = left * float(np.mean([step.variance.mean() for step in steps]))
        flat = noise.flat[prepared.systematic.window]
        self._of_flats = left * float(np.mean([(step.slope**2 * flat).mean() for step in steps]))
        self._worked_out: dict[str, tuple[Floats, Floats, Floats, Floats]] = {}

    @property
    def heights_mm(self) -> tuple[float, float]:
        """Return the heights of the lowest and the highest section, mm."""
        low, high = self._setup.sections.height_mm[[0, -1]].tolist()
        return low, high

    def points_mm(self, levels: int = 31) -> Floats:
        """Return points of the sample (point, 3), mm: at each level one on the axis, and four around it."""
        radius = 0.7 * self._setup.sections.radius_mm
        around = radius * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        return np.array([[x, y, z] for z in np.linspace(*self.heights_mm, levels) for x, y in around])

    @property
    def prior_voxel(self) -> float:
        """Return the prior's standard deviation of every amplitude, voxels."""
        return self._setup.options.prior_voxel

    def expected(self, test: PlannedTest) -> Knowledge:
        """Return how well the motion of a test would be known."""
        basis = self._setup.with_sections(self._setup.options.sections if test.sections is None else test.sections)
        functions = time_basis(tuple(part.stretched(test.share) for part in self._time), test.recorded())
        matrix, noise, flats, believed = self._sums(basis, functions, test)
        if self._setup.options.remove_pattern:
            of_flats, own = np.array(self._of_flats / test.flats), np.array(2 * self._variance)
            flats = flats * left_of_flats(of_flats, own, len(test.angle_rad))
        noise = (noise + flats / test.flats) / test.frames + believed
        # the solvers count residuals, which the prior's ridge follows
        gamma2 = self._variance / test.frames
        ridge = np.full(len(noise), gamma2 / self.prior_voxel**2)
        return Knowledge(
            basis=basis,
            time_functions=functions,
            angle_rad=test.angle_rad,
            voxel_mm=self._setup.geometry.voxel_mm,
            covariance=sandwich(matrix, noise, ridge, gamma2),
        )

    def _sums(
        self, basis: SectionBasis, functions: Floats, test: PlannedTest
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return H, and V of all images but the flats, of the flats, and of what re-projection leaves.

        With the reference scan's frames and flats.
        """
        key = digest(basis, functions, test.angle_rad, test.moved_mm)
        if key not in self._worked_out:
            self._worked_out[key] = self._worked(basis, functions, test)
        return self._worked_out[key]

    def _worked(
        self, basis: SectionBasis, functions: Floats, test: PlannedTest
    ) -> tuple[Floats, Floats, Floats, Floats]:
        angle_rad = test.angle_rad
        # steps a turn apart see the same
        _, first, turn = np.unique(np.round(angle_rad % (2 * np.pi), 9), return_index=True, return_inverse=True)
        views = nearest_angles(angle_rad[first], self._reference_rad)
        images = self._at(angle_rad[first], views)
        still = np.zeros((len(first), *basis.shape))
        task = f"sensitivities at {len(first)} angles, {basis.shape[0]} sections"
        matrix = linearise(images, basis, still, progress=self._progress, task=task).matrix
        was = self._places(test)
        pile, noise = Pile(functions), np.empty_like(matrix)
        believed = np.zeros(matrix.shape[:2])
        # all steps at one angle have the noise of its view in common, and so have angles with the same view
        shared = np.stack([functions[:, turn == k].sum(axis=1) for k in range(len(first))], axis=1)
        alike: dict[int, list[tuple[int, Sensitivities]]] = defaultdict(list)
        unseen, between = Counter(views.tolist()), np.zeros((len(functions), matrix.shape[1]) * 2)
        for k, field in enumerate(self._fields(images, basis)):
            view = int(views[k])
            step = self._noise.step(view)
            left = self._systematic.left(view)[self._systematic.window]
            believed[k] = BELIEF * adjoint(field, left, matrix.shape[1])
            noise[k] = product(field, field, step.variance, matrix.shape[1])
            for other, seen in alike[view]:
                joint = product(field, seen, step.variance, matrix.shape[1])
                both = np.einsum("f,nm,g->fngm", shared[:, k], joint, shared[:, other])
                between += both + both.transpose(2, 3, 0, 1)
            unseen[view] -= 1
            if unseen[view]:
                alike[view].append((k, field))
            else:
                del alike[view]
            for t in np.flatnonzero(turn == k):
                spread = self._spread(field, was[t])
                seen_by_flats = StepNoise(image=step, view=self._noise.view(view), spread=spread)
                pile.add(int(t), spread.bands, seen_by_flats.shared)
        of_steps, of_views = joined(noise[turn], functions), joined(noise, shared)
        covariance = of_steps + of_views + between.reshape(of_views.shape)
        flats = pile.covariance(self._noise.flat, matrix.shape[1])
        common = (functions @ believed[turn]).ravel()
        return joined(matrix[turn], functions), covariance, flats, np.outer(common, common)

    def _spread(self, field: Sensitivities, first_pixel: tuple[int, int]) -> Spread:
        """Return W S where it is, and moved by whole pixels."""
        systematic = self._systematic
        places = np.ones((*systematic.shape, 3))
        places[..., :2] = np.indices(systematic.shape).transpose(1, 2, 0) + np.array(first_pixel)
        return Spread(weighted=field, places=places, corner=systematic.corner, shape=systematic.detector)

    def _places(self, test: PlannedTest) -> list[tuple[int, int]]:
        """Return where the window's first pixel was before each step moved the sample, as a mean, whole pixels."""
        geometry, window = self._setup.geometry, self._setup.window
        turned = test.moved_mm[:, None] @ beam_frame(test.angle_rad).transpose(0, 2, 1)
        across, up = (turned[:, 0, k] / geometry.voxel_mm for k in range(2))
        row, column = self._systematic.corner
        rows, columns = window[1] - window[0], window[3] - window[2]
        top = np.clip(np.round(row + up), 0, geometry.rows - rows).astype(int)
        left = np.clip(np.round(column - across), 0, geometry.columns - columns).astype(int)
        return list(zip(top.tolist(), left.tolist(), strict=True))

    def _at(self, angle_rad: Floats, views: NDArray[np.intp]) -> Images:
        """Return what would be seen at angles: the reference views next to them."""
        images = self._images
        return replace(
            images,
            rays=ray_vectors(self._setup.geometry.cropped(*self._setup.window), angle_rad).stacked(),
            grey=images.grey[views],
            weight=images.weight if len(images.weight) == 1 else images.weight[views],
            systematic=None,
        )

    def _fields(self, images: Images, basis: SectionBasis) -> Iterator[Sensitivities]:
        """Yield W S of each image; where S meets noise it is filtered once more."""
        volume = replace(images.volume, values=smoothed(images.volume.values, self._setup.options.smooth_px))
        shape = (images.grey.shape[1], images.grey.shape[2])
        for start in range(0, len(images.rays), STEPS_AT_ONCE):
            rays = images.rays[start : start + STEPS_AT_ONCE]
            still = np.zeros((len(rays), *basis.shape))
            found = sensitivities(volume, rays, shape, basis, still, voxel_mm=images.voxel_mm)
            for k, field in enumerate(found):
                weight = images.weight[(start + k) % len(images.weight)]
                yield replace(field, values=field.values * weight[:, None])


def weakest(known: Knowledge, point_mm: Floats, prior_voxel: float, count: int) -> tuple[WeakMotion, ...]:
    """Return the principal directions of what stays uncertain, the largest first, as they move points (point, 3)."""
    values, vectors = np.linalg.eigh(known.covariance)
    shapes = known.basis.shapes(point_mm).reshape(len(point_mm), 3, -1)
    turn = beam_frame(known.angle_rad)
    result = []
    for value, vector in zip(values[::-1][:count], vectors.T[::-1], strict=False):
        mode = vector.reshape(len(known.time_functions), -1)
        moved = np.einsum("pan,tn->tpa", shapes, known.time_functions.T @ mode)
        turned = np.einsum("tba,tpa->tpb", turn, moved)
        rms = np.sqrt(value * (turned**2).mean(axis=(0, 1)))
        share = (mode.reshape(-1, *known.basis.shape) ** 2).sum(axis=(0, 1))
        order = np.argsort(share)[::-1]
        named = tuple(known.basis.names[k] for k in order if share[k] > 0.15)
        across, vertical, along = (float(each) for each in rms)
        result.append(
            WeakMotion(
                deviation_voxel=(across, vertical, along),
                prior_share=float(min(value / prior_voxel**2, 1.0)),
                motions=named,
            )
        )
    return tuple(result)
