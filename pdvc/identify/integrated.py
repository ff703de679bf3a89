"""Integrated identification: a law's parameters from the radiographs themselves, in one likelihood with the force.

One pass over the radiographs at amplitudes a_0 gives B(t), c(t) and the covariance V(t) of c from all noise, as for
`pdvc.smoother`. The motion is that of the law, and what else moves the sample:

    a(t) = m(theta_0, F) + J (theta - theta_0) + J_F(t) (F_true - F) + Phi x(t) + trend

- theta: logarithms of the law's parameters, area, Poisson's ratios; J by the chain rule through the beam;
- F_true - F ~ N(0, s_F^2), drawn at each step: eliminated, it adds B J_F J_F^T B^T s_F^2 to V(t);
- x(t): the process of `pdvc.state_space`: the sample's rigid motion, bending, torsion, and whatever of stretch and
  contraction the law does not tell. Its deviations are of the largest marginal likelihood, as those of a measurement:
  where the law is right, they leave next to nothing beside it, and where it is wrong they say so;
- the model's errors of each radiograph are apparent motions, as ever;
- what re-projection leaves, e, is subtracted, and known to a share, which is one unknown b ~ N(0, 1) of all steps: it
  adds b w(t) to c(t) (`pdvc.noise.Propagated.systematic`), as if the sample moved by b B^-1 w.

J and B^-1 w are further columns of the process's trend, so that theta is found with all else at once, and its
covariance holds what else there may be. Noise that steps have in common, and errors of the image model over many
steps, add to it by the same sums as to a measured motion (`pdvc.smoother.known_of`). The marginal likelihood of the
whole is the law's evidence (Laplace's, in theta).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.banded import Blocks
from pdvc.coherent import excess
from pdvc.equations import Equations, joined
from pdvc.identify.carried import shift_of
from pdvc.identify.model import Model
from pdvc.identify.two_step import LawEstimate
from pdvc.noise import Propagated
from pdvc.process import ROUNDS, Process, Seen, Smoothed
from pdvc.projection import BlockVectors
from pdvc.smoother import COHERENT_DEGREE, Fitted, known_of, seen, slow_effects, slow_functions
from pdvc.solution import Problem
from pdvc.state_space import Deviations, StateSpace
from pdvc.threads import one_thread

Floats = NDArray[np.float64]

FORCE, SYSTEMATIC = "force", "systematic"
"""Sources of what is uncertain: noise of the recorded force, and the share of e."""
UNSEEN = 1e-10
"""Of B's mean, is added to B: an unknown that no radiograph sees does not move."""
MOST_STEPS = 12
"""Steps of theta, at most, for the equations of one pass."""
SETTLED = 0.03
"""Share of its standard deviation that theta changes by when it has settled."""
FAR = 3.0
"""Standard deviations beyond which a change is shortened unless the posterior grows."""
HALVINGS = 6
SLOW_DRAWS = 256
"""Draws of noise that tell what it makes of slow errors."""
LONGEST_STEP = 0.7
"""Change of an unknown in one step, at most: of a logarithm, or in prior deviations."""


@dataclass(frozen=True, kw_only=True)
class Radiographs:
    """What the radiographs tell near a motion."""

    problem: Problem
    """Of the last stage of a measurement, at scale 1."""
    spaces: tuple[StateSpace, StateSpace]
    """States of few and of all modes."""
    amplitude: Floats
    """a_0 (step, unknown), voxels."""
    equations: Equations
    noise: Propagated
    slow: Floats
    """Smooth functions (function, step) in which noise common to steps is followed."""


@dataclass(frozen=True, kw_only=True)
class Identified:
    """What radiographs and force say of a law."""

    estimate: LawEstimate
    deviations: Deviations
    """Of the process beside the law."""
    amplitude: Floats
    """The motion found, of the law and of what else there is (step, unknown), voxels."""
    of_law: Floats
    """What the law makes of it (step, unknown), voxels."""
    force_N: Floats
    """Forces (step,) as force gauge and radiographs tell them together, N."""
    log_evidence: float
    """Up to a constant that all laws have in common."""
    by_source: dict[str, Floats]
    """What each source adds to the covariance of the unknowns (unknown, unknown)."""
    share: tuple[float, float]
    """b, by how much e is wrong, and its standard deviation: both over the deviation that was believed before."""


class _OfUnknowns(Process):
    """A process of which the last columns of the trend are asked for, in place of amplitudes: one step of them."""

    def __init__(self, process: Process, scale: Floats) -> None:
        """Take over a process; `scale` (unknown,) makes unknowns of the trend's numbers."""
        self.__dict__.update(vars(process))
        self._scale = scale

    def deviation(self, smoothed: Smoothed) -> Floats:
        """Return the posterior standard deviations (unknown,)."""
        variance = np.diag(smoothed.trend_covariance)[-len(self._scale) :]
        if not (variance > 0).all():
            raise np.linalg.LinAlgError("unknowns that nothing limits")
        return np.asarray(np.sqrt(variance) * self._scale)

    def covariance(self, smoothed: Smoothed, inverse: Blocks) -> Floats:
        """Return the posterior covariance (1, unknown, unknown)."""
        count = len(self._scale)
        return np.asarray(smoothed.trend_covariance[-count:, -count:] * np.outer(self._scale, self._scale))[None]

    def response(self, smoothed: Smoothed, deviations: Deviations, noise: Floats) -> Floats:
        """Return what errors of the data do to the unknowns (1, unknown, draw)."""
        found = self.trend_response(smoothed, deviations, noise)
        return np.asarray(found[-len(self._scale) :] * self._scale[:, None])[None]


def integrated(
    model: Model,
    force_N: Floats,
    start: Floats,
    radiographs: Radiographs,
    deviations: Deviations | None = None,
    rounds: int | None = None,
) -> Identified:
    """Return the unknowns of the largest posterior, from a start (unknown,), for the equations of one pass.

    The process's deviations are sought in `rounds`, as of a measurement; where some are given, from these, and unless
    told otherwise in none. Raises ValueError where no motion is likely under the law.
    """
    asked = (0 if deviations else ROUNDS) if rounds is None else rounds
    known = deviations or radiographs.spaces[0].first_guess()
    try:
        with one_thread():
            settled = _settled(model, force_N, start, radiographs, known, asked)
            return _summed(model, settled, radiographs)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"law: expected one under which some motion explains the radiographs, got {model.law.kind}: {error}"
        ) from None


def expected_covariance(model: Model, force_N: Floats, radiographs: Radiographs, deviations: Deviations) -> Floats:
    """Return the covariance of the unknowns (unknown, unknown) of a test whose law is that of the prior's mean."""
    with one_thread():
        about = _About.at(model, model.unknowns.mean, force_N, force_N, radiographs)
        process = Process(radiographs.spaces[1].with_trend(about.columns), about.seen)
        smoothed = process.smoothed(deviations)
        return np.asarray(_OfUnknowns(process, about.scale).covariance(smoothed, smoothed.factor.inverted())[0])


def free_motion(radiographs: Radiographs, deviations: Deviations | None = None) -> tuple[Floats, Floats, Deviations]:
    """Return the motion (step, unknown), voxels, without a law, its covariances, and the process's deviations.

    One step of the smoother: its deviations are sought where none are given. Of the covariance only what noise of each
    step and the process make.
    """
    few, every = radiographs.spaces
    with one_thread():
        own = np.asarray(sum(radiographs.noise.own.values()))
        data, _ = seen(radiographs.equations, own, radiographs.amplitude)
        known = deviations or Process(few, data).fitted(few.first_guess())
        process = Process(every, data)
        smoothed = process.smoothed(known)
        return process.amplitude(smoothed), process.covariance(smoothed, smoothed.factor.inverted()), known


def log_evidence(
    model: Model, force_N: Floats, start: Floats, radiographs: Radiographs, deviations: Deviations
) -> float:
    """Return the logarithm of a law's evidence, up to a constant, for deviations of the process found before."""
    return likeliest(model, force_N, start, radiographs, deviations)[1]


def likeliest(
    model: Model, force_N: Floats, start: Floats, radiographs: Radiographs, deviations: Deviations
) -> tuple[Floats, float]:
    """Return the unknowns (unknown,) of the largest posterior for given deviations, and the log of the law's evidence.

    Where no motion is likely under the law, those to start from, and minus infinity.
    """
    with one_thread():
        try:
            settled = _settled(model, force_N, start, radiographs, deviations, 0)
        except np.linalg.LinAlgError:
            return start, -np.inf
        return settled.vector, _log_evidence(settled, radiographs.spaces[1])


def refitted(
    model: Model, force_N: Floats, start: Floats, radiographs: Radiographs, deviations: Deviations
) -> Deviations:
    """Return the deviations of the process beside a law, sought once more."""
    with one_thread():
        return _settled(model, force_N, start, radiographs, deviations, 1).deviations


def _settled(
    model: Model,
    force_N: Floats,
    start: Floats,
    radiographs: Radiographs,
    known: Deviations,
    rounds: int,
) -> _Settled:
    """Go from a start to the unknowns of the largest posterior; deviations are sought in some rounds.

    They are sought with few modes, which cannot follow the law's columns: about the unknowns so far, then, and not
    about the prior's mean.
    """
    few, space = radiographs.spaces
    vector, lying, share = start, force_N, 0.0
    for _ in range(MOST_STEPS):
        about = _About.at(model, vector, lying, force_N, radiographs)
        if rounds:
            near = Process(few.with_trend(about.columns), about.near(vector - model.unknowns.mean, share))
            # half of the rounds at first, and one each time that the unknowns have moved
            now = max(rounds // 2, 1)
            known, rounds = near.fitted(known, now), rounds - now
        process = Process(space.with_trend(about.every_column), about.seen)
        smoothed = process.smoothed(known)
        scaled = _OfUnknowns(process, about.scale)
        found = model.unknowns.mean + smoothed.trend[-len(start) :] * about.scale
        deviation = scaled.deviation(smoothed)
        limit = np.minimum(LONGEST_STEP, LONGEST_STEP * model.unknowns.deviation)
        step = min(1.0, float(np.min(limit / np.maximum(np.abs(found - vector), 1e-300))))
        change = found - vector
        if np.abs(change / deviation).max() > FAR:
            step = _shortened(model, vector, change, step, lying, force_N, radiographs, known)
        vector = vector + step * change
        lying, share = about.force(process, smoothed, known), float(smoothed.trend[-len(start) - 1])
        if step == 1.0 and np.abs(change / deviation).max() < SETTLED and not rounds:
            break
    return _Settled(
        vector=vector, force_N=lying, about=about, process=scaled, motion=process, smoothed=smoothed, deviations=known
    )


def _shortened(
    model: Model,
    vector: Floats,
    change: Floats,
    share: float,
    lying: Floats,
    force_N: Floats,
    radiographs: Radiographs,
    known: Deviations,
) -> float:
    """Return the share of a change, halved as often as it takes, at which the posterior is no smaller than before."""

    def log_posterior(trial: Floats) -> float:
        about = _About.at(model, trial, lying, force_N, radiographs)
        moved = about.columns @ ((trial - model.unknowns.mean) / about.scale)
        left = about.seen.data - np.einsum("tnm,tm->tn", about.seen.design, moved)
        space = radiographs.spaces[1].with_trend(about.believed)
        likely = Process(space, replace(about.seen, data=left)).smoothed(known).log_likelihood
        away = (trial - model.unknowns.mean) / model.unknowns.deviation
        return float(likely + np.linalg.slogdet(about.white)[1].sum() - away @ away / 2)

    before = log_posterior(vector)
    for _ in range(HALVINGS):
        if log_posterior(vector + share * change) >= before:
            break
        share /= 2
    return share


@dataclass(frozen=True, kw_only=True)
class _Settled:
    """Where the steps ended, and what is known there."""

    vector: Floats
    force_N: Floats
    about: _About
    process: _OfUnknowns
    motion: Process
    smoothed: Smoothed
    deviations: Deviations


@dataclass(frozen=True, kw_only=True)
class _About:
    """The equations about unknowns and forces."""

    offset: Floats
    """What the law makes of the prior's mean, linear from here (step, unknown), voxels."""
    columns: Floats
    """J, each column times its prior deviation over that of the process's trend (step, unknown, column)."""
    believed: Floats
    """B^-1 w over the deviation of the trend (step, unknown, 1)."""
    scale: Floats
    """What makes unknowns of the trend's numbers (column,)."""
    by_force: Floats
    """L^-1 B J_F s_F^2 (step, unknown), N: how data tell the forces."""
    force_N: Floats
    """As recorded."""
    seen: Seen
    white: Floats
    own: dict[str, Floats]
    """V(t) by source, the force among them."""

    @classmethod
    def at(cls, model: Model, vector: Floats, lying: Floats, force_N: Floats, radiographs: Radiographs) -> _About:
        unknowns, equations = model.unknowns, radiographs.equations
        linear = model.linear(vector, lying)
        slopes, by_force = linear.slopes, linear.by_force
        offset = linear.amplitude + slopes @ (unknowns.mean - vector) + by_force * (force_N - lying)[:, None]
        pulled = np.einsum("tnm,tm->tn", equations.matrix, by_force) * model.force_noise_N
        own = {**radiographs.noise.own, FORCE: pulled[:, :, None] * pulled[:, None]}
        data, white = seen(equations, np.asarray(sum(own.values())), radiographs.amplitude)
        moved = np.einsum("tnm,tm->tn", data.design, offset)
        scale = unknowns.deviation / radiographs.spaces[1].prior_voxel
        return cls(
            offset=offset,
            columns=slopes * scale,
            believed=_as_motion(equations.matrix, radiographs.noise.systematic) / radiographs.spaces[1].prior_voxel,
            scale=scale,
            by_force=np.einsum("tnm,tm->tn", white, pulled) * model.force_noise_N,
            force_N=force_N,
            seen=replace(data, data=data.data - moved),
            white=white,
            own=own,
        )

    @property
    def every_column(self) -> Floats:
        """Return all columns, that of e first."""
        return np.concatenate([self.believed, self.columns], axis=2)

    def near(self, away: Floats, share: float) -> Seen:
        """Return the data less what unknowns (unknown,), away from the mean of their prior, and a share of e make."""
        moved = self.columns @ (away / self.scale) + share * self.believed[..., 0]
        return replace(self.seen, data=self.seen.data - np.einsum("tnm,tm->tn", self.seen.design, moved))

    def force(self, process: Process, smoothed: Smoothed, deviations: Deviations) -> Floats:
        """Return the forces (step,) that are likeliest under all data, N."""
        left = self.seen.data - np.einsum("tnm,tm->tn", self.seen.design, process.amplitude(smoothed))
        return np.asarray(self.force_N + np.einsum("tn,tn->t", self.by_force, left) / deviations.misfit)


def _as_motion(matrix: Floats, vector: Floats) -> Floats:
    """Return B^-1 w (step, unknown, 1) of B (step, unknown, unknown) and w (step, unknown)."""
    unknown = np.arange(matrix.shape[1])
    whole = matrix.copy()
    whole[:, unknown, unknown] += UNSEEN * np.einsum("tnn->t", matrix)[:, None] / len(unknown)
    return np.asarray(np.linalg.solve(whole, vector[..., None]))


def _summed(model: Model, settled: _Settled, radiographs: Radiographs) -> Identified:
    """Return what was found, with the covariance from all sources."""
    about, smoothed, blocks = settled.about, settled.smoothed, radiographs.equations.blocks
    steps, count_of_law = len(settled.force_N), model.unknowns.of_law
    fit = Fitted(process=settled.process, deviations=settled.deviations, smoothed=smoothed, white=about.white)
    of_force = joined(about.own[FORCE], radiographs.slow)
    noise = replace(
        radiographs.noise,
        own=about.own,
        parts={**radiographs.noise.parts, FORCE: of_force},
        # an unknown of the process
        systematic=np.zeros_like(radiographs.noise.systematic),
    )
    known = known_of(fit, noise, radiographs.slow, radiographs.equations.matrix)
    parts = {name: part[0] * steps for name, part in known.by_source.items()}
    covariance = known.covariance[0] * steps
    e = len(smoothed.trend) - len(about.scale) - 1
    with_e = smoothed.trend_covariance[-len(about.scale) :, e] * about.scale
    parts[SYSTEMATIC] = np.outer(with_e, with_e) / smoothed.trend_covariance[e, e]
    parts["process"] = parts["process"] - parts[SYSTEMATIC]
    share = np.array([smoothed.trend[e], np.sqrt(smoothed.trend_covariance[e, e])]) / radiographs.spaces[1].prior_voxel
    if blocks and steps > COHERENT_DEGREE + 2:
        finer = slow_functions(radiographs.problem, COHERENT_DEGREE)
        parts["image model"] = _of_image_model(fit, finer, blocks, count_of_law)
        covariance = covariance + parts["image model"]
    moved = settled.motion.amplitude(smoothed)
    left = about.seen.data - np.einsum("tnm,tm->tn", about.seen.design, moved)
    return Identified(
        estimate=LawEstimate(vector=settled.vector, covariance=covariance, misfit=float(np.sqrt(np.mean(left**2)))),
        deviations=settled.deviations,
        amplitude=about.offset + moved,
        of_law=model.amplitude(settled.vector, settled.force_N),
        force_N=settled.force_N,
        log_evidence=_log_evidence(settled, radiographs.spaces[1]),
        by_source=parts,
        share=(float(share[0]), float(share[1])),
    )


def _of_image_model(fit: Fitted, slow: Floats, blocks: tuple[BlockVectors, ...], of_law: int) -> Floats:
    """Return the covariance of the unknowns (unknown, unknown) from slow errors of the image model beyond noise.

    By how much blocks of the residual make more of it than noise does is one number for all unknowns, of the law's
    parameters together in the metric of their noise: of each by itself, some ten blocks would tell it.
    """
    covariance, moved = slow_effects(fit, slow, blocks, SLOW_DRAWS)
    white = np.linalg.inv(np.linalg.cholesky(covariance[0, :of_law, :of_law]))
    squares = np.concatenate([(white @ each[0, :of_law]) ** 2 for each in moved], axis=1)
    more = excess(squares, np.ones(of_law), (of_law, 1))
    return np.asarray(covariance[0] * (more - 1))


def _log_evidence(settled: _Settled, space: StateSpace) -> float:
    """Return the logarithm of the marginal likelihood with what differs from law to law.

    The volume of the prior of the unknowns, and that of the noise, which the force's is a part of.
    """
    about, wide = settled.about, space.prior_voxel
    white = np.linalg.slogdet(about.white)[1].sum()
    return float(settled.smoothed.log_likelihood + white - len(about.scale) * np.log(wide))


def radiographs_at(
    problem: Problem, spaces: tuple[StateSpace, StateSpace], amplitude: Floats, noise: Propagated | None = None
) -> Radiographs:
    """Walk the radiographs once at amplitudes (step, unknown), voxels, with their noise, unless that is given."""
    shaped = amplitude.reshape(len(amplitude), *problem.basis.shape)
    equations, slow = problem.linearise(shaped), slow_functions(problem)
    if problem.noise_at is None:
        raise ValueError("identification: expected radiographs of scale 1, whose noise is known")
    return Radiographs(
        problem=problem,
        spaces=spaces,
        amplitude=amplitude,
        equations=equations,
        noise=noise or problem.noise_at(shaped, equations, slow),
        slow=slow,
    )


def carried_by(model: Model, amplitude: Floats, shape: tuple[int, int]) -> Model:
    """Return the model for sections that have moved by amplitudes (step, unknown), voxels."""
    carrier = model.carrier
    shift = shift_of(carrier.basis, amplitude.reshape(-1, *shape), carrier.voxel_mm)
    return model.moved_along(replace(carrier, shift_mm=shift))
