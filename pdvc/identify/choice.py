"""How often the choice among laws would be right in a test like this one: made-up radiographs of each law.

Of each law, the parameters that explain the test best; of its motion, with whatever else moved the sample, and of the
noise of this test's images and forces,

    c(t) = B(t) (a_law(t) - a_0(t)) + h(t) + b w(t)          h ~ N(0, V), b ~ N(0, 1), F ~ N(F_true, s_F^2)

(a parametric bootstrap). So the laws are as hard to tell apart as they may be: each is the nearest of its kind to the
same test. Then everything is done as in an identification under the law that was asked for: deviations of the process
beside that law, and the evidence of all laws for these. Noise that steps have in common, and errors of the image model
but for the share of e, are not made up.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.identify.integrated import Identified, Radiographs, likeliest, refitted
from pdvc.identify.opening import Ready, nearest, of_kind
from pdvc.identify.result import STRONG
from pdvc.progress import Progress, silent
from pdvc.smoother import seen

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What was chosen of made-up tests."""

    kinds: tuple[str, ...]
    """Laws; the first one is the one that is asked for."""
    log_evidence: Floats
    """Of each law, for each true law and draw (true law, draw, law)."""

    def chosen(self) -> NDArray[np.intp]:
        """Return how often each law was chosen for each true one (true law, law)."""
        best = self.log_evidence.argmax(axis=2)
        return np.stack([np.bincount(row, minlength=len(self.kinds)) for row in best])

    def error_rate(self) -> float:
        """Return how often another law than the true one had the largest evidence."""
        chosen = self.chosen()
        return float(1 - np.trace(chosen) / chosen.sum())

    def doubted(self) -> Floats:
        """Return how often the law asked for would have been doubted, for each true law (true law,)."""
        more = self.log_evidence.max(axis=2) - self.log_evidence[:, :, 0]
        return np.asarray((more > STRONG).mean(axis=1))


def choices(
    opened: Ready,
    radiographs: Radiographs,
    found: Identified,
    others: tuple[str, ...],
    draws: int,
    *,
    progress: Progress = silent,
) -> Choices:
    """Return the choices of made-up tests, some draws of each law: the one asked for, which was found, and others."""
    asked = opened.model
    kinds = (str(asked.law.kind), *(kind for kind in others if kind != asked.law.kind))
    models = [asked, *(of_kind(opened, kind) for kind in kinds[1:])]
    vectors = [found.estimate.vector]
    for model in models[1:]:
        start = nearest(opened, model, opened.amplitude, found.force_N)
        vectors.append(likeliest(model, opened.force_N, start, radiographs, found.deviations)[0])
    rest, evidence = found.amplitude - found.of_law, np.empty((len(kinds), draws, len(kinds)))
    for k, (model, vector) in enumerate(zip(models, vectors, strict=True)):
        motion = model.amplitude(vector, found.force_N)
        starts = [vector if other is model else nearest(opened, other, motion, found.force_N) for other in models]
        made = _made_up(rest + motion, found.force_N, asked.force_noise_N, radiographs, np.random.default_rng(k))
        for n in range(draws):
            seen_now, force_N = next(made)
            deviations = refitted(asked, force_N, starts[0], seen_now, found.deviations)
            for j, (other, start) in enumerate(zip(models, starts, strict=True)):
                evidence[k, n, j] = likeliest(other, force_N, start, seen_now, deviations)[1]
            progress("made-up tests", k * draws + n + 1, len(kinds) * draws)
    return Choices(kinds=kinds, log_evidence=evidence)


def _made_up(
    amplitude: Floats, force_N: Floats, noise_N: float, radiographs: Radiographs, rng: np.random.Generator
) -> Iterator[tuple[Radiographs, Floats]]:
    """Yield radiographs of amplitudes (step, unknown), voxels, and the forces recorded with them (step,), N."""
    equations, noise = radiographs.equations, radiographs.noise
    _, white = seen(equations, np.asarray(sum(noise.own.values())), radiographs.amplitude)
    told = np.einsum("tnm,tm->tn", equations.matrix, amplitude - radiographs.amplitude)
    visible = np.einsum("tnn->tn", equations.matrix) > 0
    while True:
        own = np.linalg.solve(white, rng.standard_normal(amplitude.shape)[..., None])[..., 0]
        vector = told + np.where(visible, own, 0.0) + rng.standard_normal() * noise.systematic
        recorded = force_N + noise_N * rng.standard_normal(len(force_N))
        yield replace(radiographs, equations=replace(equations, vector=vector)), recorded
