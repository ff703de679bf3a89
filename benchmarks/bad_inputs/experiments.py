"""The good experiments that bad inputs start from, and experiments that were carried out wrongly."""

from __future__ import annotations

from pydantic import BaseModel

from benchmarks.bad_inputs.record import BadInput
from simulator.scenario import Scenario, load_scenario

SMALL = load_scenario("small")
PIXEL_MM = SMALL.geometry.pixel_mm


def varied(part: str, scenario: Scenario = SMALL, **entries: object) -> Scenario:
    """Return a scenario with other entries in one of its parts."""
    found: BaseModel = getattr(scenario, part)
    return scenario.model_copy(update={part: found.model_copy(update=entries)})


def set_back(**backlash: tuple[float, float, float]) -> Scenario:
    """Return the scenario in which the sample was set back otherwise between the reference scan and the test."""
    return varied("motion", backlash=SMALL.motion.backlash.model_copy(update=backlash))


# square, and turned so that its flat faces lie along the beam at every quarter turn, when radiographs are made
SQUARE = varied(
    "specimen", width_mm=1.2, thickness_mm=1.2, thinned="x", fillet_radius_mm=1000.0, turned_deg=0.0, length_mm=13.0
)

EXPERIMENTS: dict[str, Scenario] = {
    "small": SMALL,
    "quick": load_scenario("quick"),
    "in-space": load_scenario("in-space"),
    "rigid": load_scenario("rigid"),
    "small, draw 1": SMALL.model_copy(update={"repetition": 1}),
    "small, draw 2": SMALL.model_copy(update={"repetition": 2}),
    "small, another sample": SMALL.model_copy(update={"seed": 1}),
    "small, three flats": varied("detector", flats=3),
    "small, four flats": varied("detector", flats=4),
    "small, few photons": varied("detector", photons_per_pixel=5.0),
    "small, fewer photons": varied("detector", photons_per_pixel=1000.0),
    "small, detector moved across": varied("misalignment", column_shift_mm=5 * PIXEL_MM),
    "small, detector moved down": varied("misalignment", row_shift_mm=20 * PIXEL_MM),
    "small, detector recorded across": varied("geometry", column_shift_mm=2 * PIXEL_MM),
    "small, axis leans": varied("misalignment", lean_deg=5.0),
    "small, detector rolled": varied("misalignment", roll_deg=10.0),
    "small, axis nearer": varied("misalignment", source_axis_mm=-10.0),
    "small, stage stands": varied("acquisition", steps_per_turn=1_000_000),
    "small, flat faces": SQUARE,
    "small, flat faces at each quarter": varied("acquisition", SQUARE, steps_per_turn=4),
    "small, no stroke": varied("loading", stroke_mm_per_s=0.0),
    "small, moved far": set_back(before_mm=(0.9, -0.6, 1.5)),
    "small, set back turned": set_back(before_deg=(0.0, 0.0, 60.0)),
}
"""Scenarios by name: what is simulated, once each."""

CASES = (
    BadInput(
        name="detector-moved-across",
        experiment="small, detector moved across",
        wrong="The detector stood 5 columns beside where the geometry has it, in all stacks.",
    ),
    BadInput(
        name="detector-moved-down",
        experiment="small, detector moved down",
        wrong="The detector stood 20 rows below where the geometry has it, in all stacks.",
    ),
    BadInput(
        name="axis-leans",
        experiment="small, axis leans",
        wrong="The axis of rotation leaned by 5 degrees.",
    ),
    BadInput(
        name="detector-rolled",
        experiment="small, detector rolled",
        wrong="The detector was turned in its plane by 10 degrees, and nobody wrote it down.",
    ),
    BadInput(
        name="axis-nearer",
        due="unknowable",
        experiment="small, axis nearer",
        wrong="The axis stood 10 mm, of 29, nearer to the source than recorded: a larger sample shows the same.",
    ),
    BadInput(
        name="stage-stands",
        experiment="small, stage stands",
        wrong="The stage did not turn during the test: along the beam nothing is known.",
    ),
    BadInput(
        name="flat-faces-at-each-quarter",
        experiment="small, flat faces at each quarter",
        wrong="A square bar was seen along its flat faces in every radiograph of the test, a quarter turn apart.",
    ),
    BadInput(
        name="flat-faces-at-some-angles",
        due="good",
        experiment="small, flat faces",
        wrong="Little: a square bar with flat faces along the beam at a few angles is measured as well as any.",
    ),
    BadInput(
        name="few-photons",
        experiment="small, few photons",
        wrong="The exposure was a thousand times too short: 5 photons a pixel and frame.",
    ),
    BadInput(
        name="motion-beyond-capture",
        experiment="small, moved far",
        wrong="The sample was taken out after the reference scan, and set back 1.8 mm, 21 voxels, elsewhere.",
    ),
    BadInput(
        name="set-back-turned",
        experiment="small, set back turned",
        wrong="The sample was taken out after the reference scan, and set back turned by 60 degrees.",
    ),
)
"""Experiments that were carried out wrongly: nothing is changed in their folders."""

CONTROLS = (
    BadInput(name="good-small", due="good", wrong="Nothing: `small` as it is."),
    BadInput(name="good-draw-1", due="good", experiment="small, draw 1", wrong="Nothing: another draw of the noise."),
    BadInput(name="good-draw-2", due="good", experiment="small, draw 2", wrong="Nothing: a third draw of the noise."),
    BadInput(
        name="good-another-sample", due="good", experiment="small, another sample", wrong="Nothing: another sample."
    ),
    BadInput(
        name="good-fewer-photons",
        due="good",
        experiment="small, fewer photons",
        wrong="Nothing: an eighth of the photons.",
    ),
    BadInput(
        name="good-detector-beside-axis",
        due="good",
        experiment="small, detector recorded across",
        wrong="Nothing: the detector stands 2 columns aside, and `column_shift_mm` says so.",
    ),
    BadInput(
        name="good-no-stroke",
        due="good",
        experiment="small, no stroke",
        wrong="Nothing: a test at constant force, to learn the noise floor.",
    ),
    BadInput(name="good-quick", due="good", experiment="quick", wrong="Nothing: `quick` as it is."),
    BadInput(
        name="in-space",
        experiment="in-space",
        wrong="Hardly any noise: what interpolation leaves is more, and the standard deviations hold noise alone.",
    ),
    BadInput(name="good-rigid", due="good", experiment="rigid", wrong="Nothing: `rigid` as it is."),
    BadInput(
        name="good-paper-protocol",
        due="good",
        arguments=("--options", "paper"),
        wrong="Nothing: the paper's protocol is asked for.",
    ),
)
"""Experiments without a fault."""
