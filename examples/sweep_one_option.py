"""Measure one experiment again and again, with another number of sections each time.

    python examples/sweep_one_option.py

More sections see the strain at closer quarters, but each of them is known from fewer pixels. For many options, noise
draws and intervals, see my_study.py.
"""

from dataclasses import replace

import numpy as np

from pdvc.protocol import measure
from validation.scoring.scores import score
from validation.testing.small_cases import SmallExperiment, small_scenario

small = SmallExperiment(small_scenario({"seed": 1}))

# simulated once, in memory; options are records: what is changed in them is a new one
deviation = {}
print("sections  unknowns  error across  vertical  strain error  std of u_z, expected")
for sections in (3, 5, 8):
    measured = measure(small.experiment, small.options.model_copy(update={"sections": sections}))
    scores = score(measured, small.truth)
    vertical = measured.motion.amplitude_std[..., measured.motion.basis.names.index("translation_z")]
    deviation[sections] = np.sqrt(np.mean(vertical**2))
    print(
        f"{sections:8d}  {measured.fit.unknowns:8d}  {scores.error_voxel.across_beam:12.3f}  "
        f"{scores.error_voxel.vertical:8.3f}  {scores.strain_rms:12.4f}  {deviation[sections]:20.3f}"
    )
assert deviation[3] < deviation[8]

# so is an experiment: here every second view of the reference scan is left out
views = small.experiment.reference
fewer = replace(
    views,
    counts=views.counts[::2],
    angle_rad=views.angle_rad[::2],
    time_s=views.time_s[::2],
    force_N=views.force_N[::2],
)
measured = measure(replace(small.experiment, reference=fewer), small.options)
print(f"with {len(fewer)} reference views instead of {len(views)}:")
print(f"error across the beam {score(measured, small.truth).error_voxel.across_beam:.3f} voxel rms")
