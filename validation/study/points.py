"""Points of a sampled design: for each combination a share, 0 to 1, of every factor's range.

- ``latin-hypercube``: as many points as samples; each range, cut into as many parts, is met once in each part;
- ``morris``: as many trajectories as samples, of k + 1 points for k factors, on a grid of `LEVELS` levels. From each
  point to the next one factor alone moves, by 2/3 of its range (M. D. Morris, Technometrics 33 (1991) 161-174);
- ``sobol``: k + 2 points for each sample. A first point a, then for each factor j the point a with the j-th coordinate
  of another one, b, then b; a and b from a scrambled Sobol sequence (A. Saltelli et al., Comput. Phys. Commun. 181
  (2010) 259-270).

The last two are SALib's; `validation.study.sensitivity` makes indices of what is found there.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pdvc_bench import check_extra

Floats = NDArray[np.float64]

SampledDesign = Literal["latin-hypercube", "morris", "sobol"]
SAMPLED: tuple[str, ...] = ("latin-hypercube", "morris", "sobol")
"""Designs of which a study says how many samples it takes."""
ANALYSED: tuple[str, ...] = ("morris", "sobol")
"""Those whose points hang together in blocks, from which indices are made."""
LEVELS = 4
"""Of the grid on which a Morris trajectory goes: 0, 1/3, 2/3 and 1 of the range."""


def block_length(design: str, factors: int) -> int:
    """Return how many points of a design hang together: those that one sample costs."""
    return {"morris": factors + 1, "sobol": factors + 2}.get(design, 1)


def unit_points(design: SampledDesign, factors: int, samples: int, seed: int) -> Floats:
    """Return the points (combination, factor) of a design; raises ImportError where SALib is needed and missing."""
    if design == "latin-hypercube":
        from scipy.stats.qmc import LatinHypercube

        return np.asarray(LatinHypercube(factors, rng=np.random.default_rng(seed)).random(samples))
    check_extra("sensitivity", "SALib")
    rng = np.random.default_rng(seed)
    if design == "morris":
        from SALib.sample import morris

        return np.asarray(morris.sample(unit_problem(factors), samples, num_levels=LEVELS, seed=rng))
    from SALib.sample import sobol

    return np.asarray(sobol.sample(unit_problem(factors), samples, calc_second_order=False, seed=rng))


def unit_problem(factors: int) -> dict[str, Any]:
    """Return SALib's description of so many factors that go from 0 to 1."""
    return {"num_vars": factors, "names": [f"x{j}" for j in range(factors)], "bounds": [[0.0, 1.0]] * factors}
