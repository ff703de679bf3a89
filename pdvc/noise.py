"""What the noise of radiographs, reference views and flats does to the equations' right-hand side.

The residual of a step holds three noises. With n_g that of its radiograph, n_f that of the reference view at its
angle, moved with the sample as e is (`pdvc.systematic`; R_t interpolates), and phi that of the mean flat, over it,

    n_rho(t) = -n_g(t) - s_t phi + R_t [n_f + s_f phi]           s = dg / dq, the slope of grey levels

n_g is drawn anew at each step. n_f is shared by all steps that look along the same view, a turn apart, and phi by
all images. The noise of h = sum_t sigma(t) (x) S(t)^T W rho(t) has therefore the covariance

    V = sum_t sigma sigma^T (x) S^T W V_g W S                                     radiographs
      + sum_v sum_tt' a_tv a_t'v sigma(t) sigma(t')^T (x) Y_t^T V_v Y_t'          reference views,  Y_t = R_t^T W S(t)
      + sum_p v_phi(p) z(p) z(p)^T                                                flats
      + b^2 w w^T,          w = sum_t sigma(t) (x) S(t)^T W R_t e                 e itself
    z(p) = sum_t sigma(t) (x) [s_f(p) Y_t(p) - s_t(p) W S(t, p)]

Filtering the radiographs first (`radiographs.smoothed`) puts G S for S here, where S meets noise: G S is taken as the
sensitivity of the volume filtered once more, which is exact in a parallel beam.

e is believed to a share b: what was left of the paths through the sample at rest is subtracted from others.
a_tv is the share of view v at step t: e is a mean over the views around the step's direction. The noise of the
reference volume itself moves with the sample: re-projected and subtracted again it cancels, and that of the reference
views takes its place. Where e is not subtracted, the re-projected volume holds at most the same noise, so that V is
then an upper bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from pdvc.equations import Images, joined
from pdvc.progress import Progress, silent
from pdvc.projection import Sensitivities, sensitivities
from pdvc.radiographs import noise_overlap, smoothed
from pdvc.sections import SectionBasis
from pdvc.sensitivity_sums import Pile, Rows, Spread, adjoint, product, summed
from pdvc.systematic import Sight, Systematic, taps
from pdvc.volume import Volume

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

SOURCES = ("radiographs", "views", "flats")
"""Where noise comes from."""
BELIEF = 0.08
"""Share of e that it may be wrong by, alike everywhere: what re-projection leaves of paths a little other than those
of the reference scan is known no better."""


@dataclass(frozen=True, kw_only=True)
class ImageNoise:
    """The noise of one image, in grey levels."""

    variance: Image
    """Its own, of photons and readout (row, column)."""
    slope: Image
    """dg / dq: grey levels for a relative error of the open beam (row, column)."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """The noise of all images of one scale; images are asked for one at a time."""

    step: Callable[[int], ImageNoise]
    """Of a step's radiograph, over the window."""
    view: Callable[[int], ImageNoise]
    """Of a reference view, over the whole detector."""
    flat: Image
    """Variance of the mean flat, relative to it (row, column), over the whole detector."""
    smooth_px: float = 0.0
    """The filter that all images went through after this noise, px."""


def known_from_residual(rms: float, window: tuple[int, int], detector: tuple[int, ...], smooth_px: float) -> Noise:
    """Return what to believe where the detector's noise is unknown: the residual is noise, of views and steps alike.

    Interpolating leaves a share of a view's variance, on average over places between pixels and between views; the
    filter leaves what `noise_overlap` tells.
    """
    weights = taps(np.linspace(0, 1, 101), np.zeros(101, dtype=np.int64))
    along_an_axis = float((weights**2).sum(axis=0).mean())
    # 1 / sqrt(pi) is left by a mean over views half as wide as their spacing
    left = along_an_axis**2 / np.sqrt(np.pi)
    variance = rms**2 / noise_overlap(smooth_px)[0] ** 2 / (1 + left)

    def uniform(shape: tuple[int, ...]) -> ImageNoise:
        return ImageNoise(variance=np.full(shape, variance, np.float32), slope=np.zeros(shape, np.float32))

    return Noise(
        step=lambda t: uniform(window),
        view=lambda v: uniform(detector),
        flat=np.zeros(detector, dtype=np.float32),
        smooth_px=smooth_px,
    )


@dataclass(frozen=True, kw_only=True)
class Propagated:
    """The covariance V of h."""

    parts: Mapping[str, Floats]
    """By source, `SOURCES` and ``systematic``, that of e: (function * unknown, function * unknown), or (function,
    unknown, unknown) where functions share no step."""
    own: Mapping[str, Floats]
    """The same of each step's c alone, by `SOURCES` (step, unknown, unknown)."""
    systematic: Floats
    """What one standard deviation of the subtracted systematic residual does to c (step, unknown), at all steps alike;
    zero where none is subtracted."""

    @property
    def covariance(self) -> Floats:
        """Return V, of all sources together."""
        return np.asarray(sum(self.parts.values()))


def propagate(
    images: Images,
    systematic: Systematic,
    basis: SectionBasis,
    amplitude: Floats,
    time_functions: Floats,
    noise: Noise,
    *,
    progress: Progress = silent,
) -> Propagated:
    """Return the covariance of h at amplitudes (step, section, motion), voxels.

    `systematic` tells which views each step looks along, whether it is subtracted or not. Costs a pass over all
    radiographs, and about as much again.
    """
    images = replace(images, volume=meeting_noise(images.volume, noise.smooth_px))
    apart = separate(time_functions)
    unknowns = basis.shape[0] * basis.shape[1]
    own = {name: np.empty((len(amplitude), unknowns, unknowns)) for name in SOURCES}
    pairs: dict[tuple[int, int], Floats] = {}
    believed = np.zeros((len(amplitude), unknowns))
    pile = None if apart else Pile(time_functions)
    sight = systematic.looked_along(slice(None), images.rays, basis, amplitude, images.voxel_mm)
    held: dict[int, Spread] = {}

    def add_step(step: int, weighted: Sensitivities, left: Image | None) -> StepNoise:
        """Add what the step's own noise does; return what its views' noise and the flats' meet."""
        places = systematic.places(step, images.rays[step], basis, amplitude[step], images.voxel_mm)
        found = StepNoise.of(noise, step, sight.of_step(step), weighted, places, systematic.corner)
        for name, covariance in found.own(noise.flat, unknowns).items():
            own[name][step] = covariance
        if left is not None:
            believed[step] = BELIEF * adjoint(weighted, left, unknowns)
        return found

    def joint_of(pair: tuple[int, int, Mapping[int, float]]) -> Floats:
        """Return what the noise of the views does that two steps both look along."""
        step, other, shares = pair
        variance = np.sum([share * noise.view(view).variance for view, share in shares.items()], axis=0)
        one, two, result = held[step], held[other], np.zeros((unknowns, unknowns))
        for band in one.bands:
            one.moved(band).add_product(two.moved(band, "other"), variance[one.rows(band)], result)
        return result

    company = _company(sight, apart)
    order = list(company)
    # rays are walked by all threads at once; what follows is one thread's work for each step. No more steps at a time
    # than threads: the sensitivities of each are kept
    at_once = numba.get_num_threads()
    with ThreadPoolExecutor(at_once) as pool:
        for done in range(0, len(order), at_once):
            steps = order[done : done + at_once]
            fields = weighted_sensitivities(images, basis, amplitude, steps)
            left = [registered_left(images, basis, amplitude, t) for t in steps]
            for t, found in zip(steps, pool.map(add_step, steps, fields, left), strict=True):
                held[t] = found.spread
                if pile is not None:
                    pile.add(t, found.spread.bands, found.shared, pool)
            together = [(t, other, shares) for t in steps for other, shares in company[t].items()]
            # in this order, whichever is ready first: sums over pairs are to have the same bits
            for (t, other, _), joint in zip(together, pool.map(joint_of, together), strict=True):
                pairs[t, other] = joint
            later = {other for t in order[done + len(steps) :] for other in company[t]}
            held = {step: field for step, field in held.items() if step in later}
            progress("uncertainty", done + len(steps), len(amplitude))
    parts = {
        "radiographs": _joined(own["radiographs"], {}, time_functions),
        "views": _joined(own["views"], pairs, time_functions),
        "flats": _joined(own["flats"], {}, time_functions) if pile is None else pile.covariance(noise.flat, unknowns),
    }
    common = time_functions @ believed
    parts["systematic"] = common[:, :, None] * common[:, None] if apart else np.outer(common.ravel(), common.ravel())
    return Propagated(parts=parts, own=own, systematic=believed)


@dataclass(frozen=True, kw_only=True)
class StepNoise:
    """What the noise of one step's images meets."""

    image: ImageNoise
    """Of the radiograph, over the window."""
    view: ImageNoise
    """Of the mean of the reference views that it looks along, over the whole detector."""
    spread: Spread
    """W S in the window, and Y = R^T W S over the whole detector."""

    @classmethod
    def of(
        cls,
        noise: Noise,
        step: int,
        shares: Mapping[int, float],
        weighted: Sensitivities,
        places: Floats,
        corner: tuple[int, int],
    ) -> StepNoise:
        """Tell what the noise of a step meets; `shares` of its views, `places` of `Systematic.places`."""
        shape = (noise.flat.shape[0], noise.flat.shape[1])
        spread = Spread(weighted=weighted, places=places, corner=corner, shape=shape)
        return cls(image=noise.step(step), view=mean_of_views(noise, shares), spread=spread)

    def shared(self, band: int, moved: Rows | None = None) -> Rows:
        """Return s_f Y - s_t W S, which an error of the flats meets, in a band of rows of the detector."""
        moved = self.spread.moved(band) if moved is None else moved
        return self.spread.shared(band, moved, self.view.slope, self.image.slope)

    def own(self, flat: Image, unknowns: int) -> dict[str, Floats]:
        """Return V of the step alone, by `SOURCES`, for a variance of the mean flat (row, column)."""
        weighted = self.spread.weighted
        of_radiograph = product(weighted, weighted, self.image.variance, unknowns)
        return {"radiographs": of_radiograph, **self.of_scan(flat, unknowns)}

    def of_scan(self, flat: Image, unknowns: int, pool: Executor | None = None) -> dict[str, Floats]:
        """Return V of the step alone that comes of the reference scan, views and flats.

        With a pool, halves of the detector side by side, to other last digits.
        """

        def add(band: int, found: Floats) -> None:
            rows, moved = self.spread.rows(band), self.spread.moved(band)
            moved.add_product(moved, self.view.variance[rows], found[0])
            shared = self.shared(band, moved)
            shared.add_product(shared, flat[rows], found[1])

        views, flats = summed(self.spread.bands, unknowns, add, 2, pool)
        return {"views": views, "flats": flats}


def meeting_noise(volume: Volume, smooth_px: float) -> Volume:
    """Return the volume filtered once more, as the sensitivities are that noise meets."""
    return replace(volume, values=smoothed(volume.values, smooth_px))


def separate(time_functions: Floats) -> bool:
    """Return whether each step has a function of its own, so that nothing joins the steps."""
    filled = time_functions != 0
    return bool((filled.sum(axis=0) <= 1).all() and (filled.sum(axis=1) <= 1).all())


def _company(sight: Sight, apart: bool) -> dict[int, dict[int, dict[int, float]]]:
    """Return the steps in the order of their views: each with the steps before it that share views with it.

    For each view that both see, the product of their shares. Where the functions are apart, no company counts.
    """
    shares = {t: sight.of_step(t) for t in range(len(sight.views))}
    order = sorted(shares, key=lambda t: (min(shares[t]), t))
    found: dict[int, dict[int, dict[int, float]]] = {}
    users: dict[int, list[int]] = {}
    for t in order:
        found[t] = {}
        for view, share in shares[t].items():
            for other in users.setdefault(view, []):
                if not apart:
                    found[t].setdefault(other, {})[view] = share * shares[other][view]
            users[view].append(t)
    return found


def mean_of_views(noise: Noise, shares: Mapping[int, float]) -> ImageNoise:
    """Return the noise of a mean over views, by their shares."""
    found = [(np.float32(share), noise.view(view)) for view, share in shares.items()]
    return ImageNoise(
        variance=np.sum([share**2 * each.variance for share, each in found], axis=0),
        slope=np.sum([share * each.slope for share, each in found], axis=0),
    )


def weighted_sensitivities(
    images: Images, basis: SectionBasis, amplitude: Floats, steps: Sequence[int]
) -> list[Sensitivities]:
    """Return the sensitivities of steps, each pixel's times its weight."""
    shape = (images.grey.shape[1], images.grey.shape[2])
    rays, there = images.rays[steps], amplitude[steps]
    fields = sensitivities(images.volume, rays, shape, basis, there, voxel_mm=images.voxel_mm)
    for t, field in zip(steps, fields, strict=True):
        field.values[:] *= images.weight[t % len(images.weight)][:, None]
    return fields


def registered_left(images: Images, basis: SectionBasis, amplitude: Floats, step: int) -> Image | None:
    """Return e of a step, if it is subtracted."""
    if images.systematic is None:
        return None
    one = slice(step, step + 1)
    return np.asarray(images.systematic.registered(one, images.rays[one], basis, amplitude[one], images.voxel_mm)[0])


def _joined(own: Floats, pairs: Mapping[tuple[int, int], Floats], time_functions: Floats) -> Floats:
    """Return the sum over steps, and over pairs of them, of sigma(t) sigma(t')^T (x) their block.

    Pairs hold one of (t, t') and (t', t), whose block is the transpose.
    """
    if separate(time_functions):
        blocks = np.zeros((len(time_functions), *own.shape[1:]))
        for f, t in zip(*np.nonzero(time_functions), strict=True):
            blocks[f] = time_functions[f, t] ** 2 * own[t]
        return blocks
    total = joined(own, time_functions)
    if pairs:
        t, other = np.array(list(pairs)).T
        apart = joined(np.stack(list(pairs.values())), time_functions[:, t], time_functions[:, other])
        total += apart + apart.T
    return total
