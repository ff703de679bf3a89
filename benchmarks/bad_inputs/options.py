"""Bad options: what a file given to --options can ask for."""

from __future__ import annotations

from benchmarks.bad_inputs.record import BadInput, described

RIGID_MOTIONS = '"translation_x", "translation_y", "translation_z", "rotation_x", "rotation_y", "rotation_z"'


def functions(**kinds: str) -> str:
    """Return tables of time functions, each the entries of one kind."""
    return "".join(f'[[time]]\nkind = "{kind}"\n{entries}\n' for kind, entries in kinds.items())


CASES = (
    BadInput(
        name="ramp-after-the-test",
        options=functions(force="", angle="", polynomial="", ramp="start = 500"),
        wrong="The ramp starts at step 500, of a test of 127.",
    ),
    BadInput(
        name="ramp-before-the-test",
        options=functions(force="", angle="", polynomial="", ramp="start = -500"),
        wrong="The ramp starts at step -500.",
    ),
    BadInput(
        name="ramp-too-late",
        options=functions(force="", angle="", polynomial="", ramp="start = 100\npowers = [0, 1, 2, 3]"),
        wrong="The ramp starts at step 100, where loading started at 50.",
    ),
    BadInput(
        name="no-time-functions",
        due="error",
        options="time = []\n",
        wrong="No time function is asked for.",
    ),
    BadInput(
        name="constant-alone",
        options=functions(polynomial="degree = 0"),
        wrong="The only time function is a constant, but the sample moves during the test.",
    ),
    BadInput(
        name="degree-40",
        options=functions(polynomial="degree = 40"),
        wrong="The time functions are a polynomial of degree 40.",
    ),
    BadInput(
        name="harmonics-beyond-the-steps",
        options=functions(polynomial="", fourier="harmonics = 100"),
        wrong="A hundred harmonics are asked for, of a test of 127 steps.",
    ),
    BadInput(
        name="motion-twice",
        due="error",
        options=f'section_motions = [{RIGID_MOTIONS}, "translation_x"]\n',
        wrong="A motion is listed twice.",
    ),
    BadInput(
        name="motion-unknown",
        due="error",
        options=f'section_motions = [{RIGID_MOTIONS}, "shear"]\n',
        wrong="A motion is asked for that nobody knows.",
    ),
    BadInput(name="no-motions", due="error", options="section_motions = []\n", wrong="A section may not move at all."),
    BadInput(
        name="rotation-alone",
        options='section_motions = ["rotation_z"]\n',
        wrong="Sections may turn about the axis and do nothing else.",
    ),
    BadInput(name="sections-200", options="sections = 200\n", wrong="200 sections, over 95 used rows."),
    BadInput(name="sections-1", due="error", options="sections = 1\n", wrong="One section."),
    BadInput(name="sections-one-a-row", options="sections = 100\n", wrong="100 sections, over 95 used rows."),
    BadInput(
        name="beam-hardening-wild",
        options="beam_hardening = [1.0, -5.0, 20.0]\n",
        wrong="The beam-hardening polynomial is not one: it falls, and then explodes.",
    ),
    BadInput(
        name="beam-hardening-zero",
        options="beam_hardening = [0.0, 0.0, 0.0]\n",
        wrong="The beam-hardening polynomial is zero.",
    ),
    BadInput(
        name="beam-hardening-negative",
        options="beam_hardening = [-1.0, 0.0, 0.0]\n",
        wrong="The beam-hardening polynomial has the wrong sign: the sample is a hole.",
    ),
    BadInput(name="prior-tiny", options="prior_voxel = 0.01\n", wrong="The prior holds every motion to 0.01 voxel."),
    BadInput(name="prior-zero", due="error", options="prior_voxel = 0.0\n", wrong="The prior is zero."),
    BadInput(name="prior-nan", due="error", options="prior_voxel = nan\n", wrong="The prior is nan."),
    BadInput(
        name="nothing-discarded",
        options="discard_rows = 0\ndiscard_columns = 0\n",
        wrong="No rows are discarded: rays leave the volume through its cut ends.",
    ),
    BadInput(
        name="few-rows-discarded",
        options="discard_rows = 3\n",
        wrong="Too few rows are discarded: rays leave the volume through its cut ends.",
    ),
    BadInput(
        name="everything-discarded",
        due="error",
        options="discard_rows = 60\n",
        wrong="More rows are discarded than there are.",
    ),
    BadInput(
        name="three-rows-left",
        options="discard_rows = 58\n",
        wrong="Three rows are left.",
    ),
    BadInput(
        name="sample-discarded",
        options="discard_columns = 24\n",
        wrong="So many columns are discarded that the edges of the sample are out of the window.",
    ),
    BadInput(
        name="one-pass",
        options='[[rigid]]\nscale = 2\nsolver = { kind = "pgd", most_modes = 1 }\n'
        '[[deformation]]\nscale = 1\nsolver = { kind = "pgd", most_modes = 1 }\n',
        wrong="Each stage may find one mode, in one pass: it ends before the motion is followed.",
    ),
    BadInput(
        name="gain-never-enough",
        options='[[rigid]]\nscale = 2\nsolver = { kind = "pgd", least_gain = 0.9 }\n'
        '[[deformation]]\nscale = 1\nsolver = { kind = "pgd", least_gain = 0.9 }\n',
        wrong="A mode has to lower the residual to a tenth to be kept.",
    ),
    BadInput(
        name="scale-too-coarse",
        options='[[rigid]]\nscale = 16\nsolver = { kind = "pgd", most_modes = 8 }\n[[deformation]]\nscale = 1\n',
        wrong="The rigid stage sees the sample in one or two columns of pixels, and its motion is lost.",
    ),
    BadInput(
        name="last-stage-coarse",
        due="error",
        options="[[deformation]]\nscale = 2\n",
        wrong="The last stage is at scale 2.",
    ),
    BadInput(name="smoothing-much", due="error", options="smooth_px = 50.0\n", wrong="A filter of 50 pixels."),
    BadInput(
        name="weighting-without-noise",
        due="error",
        change=described(lambda values: values.pop("acquisition")),
        options='weighting = "noise"\n',
        wrong="Pixels are to be weighted by their noise, which is not known.",
    ),
    BadInput(name="option-unknown", due="error", options="section = 15\n", wrong="An option is misspelt."),
    BadInput(name="option-of-text", due="error", options='sections = "15"\n', wrong="A number is given as text."),
    BadInput(name="options-no-toml", due="error", options="sections: 15\n", wrong="The options are written as YAML."),
    BadInput(
        name="protocol-misspelt",
        due="error",
        arguments=("--options", "papr"),
        wrong="The protocol's name is misspelt.",
    ),
    BadInput(
        name="solver-unknown",
        due="error",
        options='[[deformation]]\nscale = 1\nsolver = { kind = "newton" }\n',
        wrong="A solver is asked for that nobody knows.",
    ),
)
"""Options and arguments that a measurement cannot do well with."""
