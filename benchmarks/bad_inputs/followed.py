"""What goes wrong with prepare, live, play, page and watch: before a test, and while it runs."""

from __future__ import annotations

import numpy as np
import tifffile

from benchmarks.bad_inputs.beside import (
    PORT,
    arriving,
    folder_named,
    half,
    one_tiff,
    port_in_use,
    record,
    work_in_use,
    written,
)
from benchmarks.bad_inputs.record import BadInput, described, in_turn, recorded, removed
from pdvc.experiment import DESCRIPTION, FLATS, REFERENCE
from pdvc.record import MeasurementLine, PlanLine

PLAN = PlanLine(title="another test", steps=127, height_mm=(-4.0, 0.0, 4.0), voxel_mm=0.0856)
OVER = MeasurementLine(file="motion.nc", seconds=3.0)
NO_SMOOTHER = '[[deformation]]\nscale = 1\nsolver = { kind = "gauss-newton" }\n'

PREPARE = ("experiment", "--work", "ready")
# without radiographs it ends soon: what is wrong with one is told before
LIVE = ("experiment", "--radiographs", "arriving", "--work", "ready", "-o", "motion.nc", "--idle", "0.5")
PLAY = ("experiment", "--to", "arriving", "--pace", "0")
SHOWN = ("motion.nc",)

BEFORE = (
    BadInput(
        name="prepare-without-reference",
        due="error",
        command="prepare",
        arguments=PREPARE,
        change=removed(REFERENCE),
        wrong="The reference scan is not done yet.",
    ),
    BadInput(
        name="prepare-without-flats",
        due="error",
        command="prepare",
        arguments=PREPARE,
        change=removed(FLATS),
        wrong="There are no flats yet.",
    ),
    BadInput(
        name="prepare-nowhere",
        due="error",
        command="prepare",
        arguments=("experimnet", "--work", "ready"),
        wrong="The folder's name is misspelt.",
    ),
    BadInput(
        name="prepare-without-plan",
        due="error",
        command="prepare",
        arguments=PREPARE,
        change=described(lambda values: values.pop("test")),
        wrong="Nothing is planned: `experiment.toml` has no `[test]`.",
    ),
    BadInput(
        name="prepare-plan-shorter",
        due="error",
        command="prepare",
        arguments=PREPARE,
        change=described(lambda values: values["test"].update(angle_deg=values["test"]["angle_deg"][:-1])),
        wrong="The plan has an angle less than times and forces.",
    ),
    BadInput(
        name="prepare-plan-nan",
        due="error",
        command="prepare",
        arguments=PREPARE,
        change=recorded("test", "angle_deg", lambda angle: np.where(np.arange(len(angle)) == 3, np.nan, angle)),
        wrong="An angle of the plan is nan.",
    ),
    BadInput(
        name="prepare-noise-unknown",
        due="error",
        command="prepare",
        arguments=PREPARE,
        change=described(lambda values: values["acquisition"].pop("photons_per_count")),
        wrong="`photons_per_count` is not told: how far a radiograph is to be believed is not known.",
    ),
    BadInput(
        name="prepare-no-smoother",
        due="error",
        command="prepare",
        arguments=PREPARE,
        options=NO_SMOOTHER,
        wrong="The options' last stage needs all radiographs at once.",
    ),
    BadInput(
        name="prepare-protocol-of-the-paper",
        due="error",
        command="prepare",
        arguments=(*PREPARE, "--options", "paper"),
        wrong="The protocol of the paper is asked for, which cannot follow a test.",
    ),
    BadInput(
        name="prepare-into-a-file",
        due="error",
        command="prepare",
        arguments=("experiment", "--work", f"experiment/{DESCRIPTION}"),
        wrong="`--work` names a file.",
    ),
)
"""Before a test: prepare."""

WHILE = (
    BadInput(
        name="live-no-radiographs-folder",
        due="error",
        command="live",
        arguments=LIVE,
        wrong="The folder of the radiographs does not exist.",
    ),
    BadInput(
        name="live-radiographs-file",
        due="error",
        command="live",
        arguments=LIVE,
        change=written("arriving"),
        wrong="The folder of the radiographs is a file.",
    ),
    BadInput(
        name="live-table-header",
        due="error",
        command="live",
        arguments=LIVE,
        change=arriving(first="step;file;angle_deg;time_s;force_N"),
        wrong="The table was written with semicolons.",
    ),
    BadInput(
        name="live-table-no-header",
        due="error",
        command="live",
        arguments=LIVE,
        change=arriving(first="0,00000.tif,0,0,250"),
        wrong="The table begins without the names of its columns.",
    ),
    BadInput(
        name="live-line-short",
        due="told",
        command="live",
        arguments=LIVE,
        change=arriving("0,0.tif,0,0"),
        wrong="A line of the table has no force.",
    ),
    BadInput(
        name="live-step-twice",
        due="told",
        command="live",
        arguments=LIVE,
        change=arriving("1,00000.tif,7.2,2,250", good=2),
        wrong="Two lines of the table have the same step.",
    ),
    BadInput(
        name="live-step-beyond",
        due="told",
        command="live",
        arguments=LIVE,
        change=arriving("127,0.tif,0,0,250"),
        wrong="A line of the table has a step beyond the plan.",
    ),
    BadInput(
        name="live-angle-nan",
        due="told",
        command="live",
        arguments=LIVE,
        change=arriving("0,0.tif,nan,0,250"),
        wrong="The stage told no angle: nan.",
    ),
    BadInput(
        name="live-decimal-comma",
        due="told",
        command="live",
        arguments=LIVE,
        change=arriving("0,0.tif,7,2,0,250"),
        wrong="The angle is written with a decimal comma.",
    ),
    BadInput(
        name="live-file-elsewhere",
        due="told",
        command="live",
        arguments=LIVE,
        change=arriving("0,../0.tif,0,0,250"),
        wrong="The TIFF lies in another folder.",
    ),
    BadInput(
        name="live-tiff-binned",
        due="told",
        command="live",
        arguments=LIVE,
        change=one_tiff(lambda path, counts: tifffile.imwrite(path, counts[::2, ::2])),
        wrong="A radiograph was binned by two.",
    ),
    BadInput(
        name="live-tiff-float",
        due="told",
        command="live",
        arguments=LIVE,
        change=one_tiff(lambda path, counts: tifffile.imwrite(path, counts.astype(np.float32))),
        wrong="A radiograph is of 32-bit floats.",
    ),
    BadInput(
        name="live-tiff-truncated",
        due="told",
        command="live",
        arguments=LIVE,
        change=one_tiff(half),
        wrong="The transfer of a radiograph broke off after half of it, and the scanner stopped.",
    ),
    BadInput(
        name="live-tiff-black",
        due="told",
        command="live",
        arguments=LIVE,
        change=one_tiff(lambda path, counts: tifffile.imwrite(path, np.zeros_like(counts))),
        wrong="The shutter was closed: a radiograph is black.",
    ),
    BadInput(
        name="live-no-smoother",
        due="error",
        command="live",
        arguments=LIVE,
        change=arriving(),
        options=NO_SMOOTHER,
        wrong="The options' last stage needs all radiographs at once.",
    ),
    BadInput(
        name="live-noise-unknown",
        due="error",
        command="live",
        arguments=LIVE,
        change=in_turn(arriving(), described(lambda values: values["acquisition"].pop("photons_per_count"))),
        wrong="`photons_per_count` is not told: how far a radiograph is to be believed is not known.",
    ),
    BadInput(
        name="live-record-of-another-test",
        due="error",
        command="live",
        arguments=LIVE,
        change=in_turn(arriving(), record(PLAN)),
        wrong="The file is that of another test, which is not over.",
    ),
    BadInput(
        name="live-record-complete",
        due="error",
        command="live",
        arguments=LIVE,
        change=in_turn(arriving(), record(PLAN, OVER)),
        wrong="The file is that of a test which is over.",
    ),
    BadInput(
        name="live-record-nonsense",
        due="error",
        command="live",
        arguments=LIVE,
        change=in_turn(arriving(), record(b"To do: change the grips.\n")),
        wrong="The record is a file of another kind.",
    ),
    BadInput(
        name="live-into-a-folder",
        due="error",
        command="live",
        arguments=LIVE,
        change=in_turn(arriving(), folder_named("motion.nc")),
        wrong="The file to write is a folder.",
    ),
    BadInput(
        name="live-work-in-use",
        due="error",
        code=1,
        command="live",
        arguments=LIVE,
        change=arriving(),
        meanwhile=work_in_use,
        wrong="prepare is still at work.",
    ),
    BadInput(
        name="live-idle-negative",
        due="error",
        command="live",
        arguments=(*LIVE[:-1], "-1"),
        change=arriving(),
        wrong="`--idle` is negative.",
    ),
    BadInput(
        name="live-no-out",
        due="error",
        command="live",
        arguments=LIVE[:5],
        change=arriving(),
        wrong="No file is named.",
    ),
    BadInput(
        name="play-from-beyond",
        due="error",
        command="play",
        arguments=(*PLAY, "--from", "127"),
        wrong="`--from` is beyond the test.",
    ),
    BadInput(
        name="play-into-a-table",
        due="error",
        command="play",
        arguments=PLAY,
        change=arriving("0,0.tif,0,0,250"),
        wrong="The folder has radiographs of an earlier test.",
    ),
    BadInput(
        name="play-into-a-file",
        due="error",
        command="play",
        arguments=PLAY,
        change=written("arriving"),
        wrong="The folder is a file.",
    ),
    BadInput(
        name="play-pace-negative",
        due="error",
        command="play",
        arguments=(*PLAY[:-1], "-2"),
        wrong="The pace is negative.",
    ),
    BadInput(
        name="play-nowhere",
        due="error",
        command="play",
        arguments=("experimnet", *PLAY[1:]),
        wrong="The folder's name is misspelt.",
    ),
    *(
        BadInput(
            name=f"{command}-{name}", due="error", command=command, arguments=arguments, change=change, wrong=wrong
        )
        for command in ("page", "watch")
        for name, arguments, change, wrong in (
            ("no-record", SHOWN, written("other.nc"), "Nothing was followed into this file."),
            ("a-folder", ("experiment",), record(PLAN), "The experiment's folder is named, not the file."),
            ("record-empty", SHOWN, record(), "The record is of 0 bytes."),
            ("record-nonsense", SHOWN, record(b"To do: change the grips.\n"), "The record is a file of another kind."),
            ("record-random", SHOWN, record(bytes(range(256)) * 2 + b"\n"), "The record holds random bytes."),
            ("record-without-plan", SHOWN, record(OVER), "The first line of the record was deleted."),
            (
                "plan-of-another-kind",
                SHOWN,
                record(b'{"what": "plan", "title": "test", "steps": 9, "height_mm": 4.0, "voxel_mm": 0.1}\n'),
                "The plan in the record was written by another program.",
            ),
        )
    ),
    BadInput(
        name="watch-line-nonsense",
        due="error",
        command="watch",
        arguments=SHOWN,
        change=record(PLAN, b"To do: change the grips.\n"),
        wrong="Something else was written into the record.",
    ),
    BadInput(
        name="page-port-70000",
        due="error",
        command="page",
        arguments=(*SHOWN, "--port", "70000"),
        change=record(PLAN),
        wrong="There is no such port.",
    ),
    BadInput(
        name="page-port-in-use",
        due="error",
        code=1,
        command="page",
        arguments=(*SHOWN, "--port", str(PORT)),
        change=record(PLAN),
        meanwhile=port_in_use,
        wrong="Another program has the port.",
    ),
    BadInput(
        name="page-host-misspelt",
        due="error",
        command="page",
        arguments=(*SHOWN, "--host", "127.0.0.l"),
        change=record(PLAN),
        wrong="The address is misspelt.",
    ),
    BadInput(
        name="page-host-of-another-machine",
        due="error",
        command="page",
        arguments=(*SHOWN, "--host", "192.0.2.1"),
        change=record(PLAN),
        wrong="The address is that of another machine.",
    ),
)
"""While a test runs, or before radiographs come: live, play, page, watch."""

CASES = (*BEFORE, *WHILE)
