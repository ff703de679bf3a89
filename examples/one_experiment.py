"""Simulate a small experiment, measure it from its counts alone, and compare with the truth.

    python examples/one_experiment.py out/one

Writes the experiment folder and the measurement, in some seconds, once the kernels are compiled. Then, for a page:

    pdvc-bench report out/one/motion.nc --truth out/one/experiment -o out/one
"""

import sys
from pathlib import Path

from pdvc.experiment import read_experiment
from pdvc.measurement_file import write_measurement
from pdvc.protocol import measure
from simulator.scanner import simulate
from simulator.truth import read_truth
from validation.scoring.scores import score
from validation.testing.small_cases import small_options, small_scenario

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/one")

# a scenario describes everything: sample, scanner, noise, loading; load_scenario("quick") is a larger one
scenario = small_scenario({"detector.photons_per_pixel": 4000.0})
simulate(scenario, folder / "experiment")

# from here on as with radiographs of a laboratory: the measurement does not look at the truth
experiment = read_experiment(folder / "experiment")
measured = measure(experiment, small_options(scenario))
write_measurement(measured, folder / "motion.nc")

# displacement, in voxels, of what is 1 mm above mid-height on the axis at the last step
last = len(experiment.test) - 1
x, y, z = measured.motion.displacement(last, [[0.0, 0.0, 1.0]])[0]
print(f"last step, z = 1 mm: {x:.2f}, {y:.2f}, {z:.2f} voxels of {measured.recording.voxel_mm * 1e3:.0f} um")

scores = score(measured, read_truth(folder / "experiment"))
print(
    f"error across the beam {scores.error_voxel.across_beam:.3f}, vertical {scores.error_voxel.vertical:.3f} voxel rms"
)
assert scores.error_voxel.across_beam < 0.1
