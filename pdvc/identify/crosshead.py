"""A law from force and crosshead alone, as a laboratory without images has it.

    stroke(t) = C (F - F_0) + int (e(F) - e(F_0)) dZ + s_0

over the heights that the reconstructed volume shows; what the grips and the rest of the sample give is left to the
machine's compliance C. Young's modulus and C are nearly one unknown here, which their covariance tells. Noise is that
of the force, times what a newton moves the crosshead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pdvc.identify.beam import elongation_mm
from pdvc.identify.model import Model
from pdvc.identify.two_step import MOST_EVALUATIONS, LawEstimate

Floats = NDArray[np.float64]

COMPLIANCE_MM_PER_N = 1e-4
"""Median of the prior of C."""
COMPLIANCE_DEVIATION = 2.0
"""Standard deviation of its logarithm."""
SLACK_MM = 0.02
"""Prior standard deviation of s_0."""
_STEP_N = 0.05


def from_crosshead(model: Model, force_N: Floats, stroke_mm: Floats, loaded: int, start: Floats) -> LawEstimate:
    """Return the unknowns, with log C and s_0 after them, from forces and strokes (step,), a start (unknown,).

    Only steps from `loaded` on count.
    """
    unknowns, profile = model.unknowns, model.profile
    mean = np.concatenate([unknowns.mean, [np.log(COMPLIANCE_MM_PER_N), 0.0]])
    deviation = np.concatenate([unknowns.deviation, [COMPLIANCE_DEVIATION, SLACK_MM]])

    def taken(vector: Floats, force: Floats) -> Floats:
        elastic, plastic = model.strains(vector[:-2], force)
        machine = np.exp(vector[-2]) * (force - model.reference_N) + vector[-1]
        return np.asarray(machine + elongation_mm(elastic + plastic, profile))

    def left(x: Floats) -> Floats:
        vector = mean + x * deviation
        missed = stroke_mm - taken(vector, force_N)
        return np.concatenate([(missed / noise)[loaded:], x])

    found = np.concatenate([(start - unknowns.mean) / unknowns.deviation, [0.0, 0.0]])
    for _ in range(2):
        vector = mean + found * deviation
        by_force = (taken(vector, force_N + _STEP_N) - taken(vector, force_N - _STEP_N)) / (2 * _STEP_N)
        noise = np.maximum(by_force * model.force_noise_N, 1e-6)
        solved = least_squares(left, found, x_scale="jac", max_nfev=MOST_EVALUATIONS)
        found = solved.x
    covariance = np.linalg.inv(solved.jac.T @ solved.jac) * np.outer(deviation, deviation)
    away = solved.fun[: len(force_N) - loaded]
    return LawEstimate(vector=mean + found * deviation, covariance=covariance, misfit=float(np.sqrt(np.mean(away**2))))
