"""The commands between this and other programs: import, export."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from validation.commands.parts import Threads, answering, read_options, tell, use_threads


class SeriesName(StrEnum):
    """The series of an experiment."""

    REFERENCE = "reference"
    TEST = "test"


_SCAN = (
    "An NXtomo file (FILE::ENTRY chooses one of several), Nikon's .xtekct, North Star's .nsipro, a folder of single "
    "TIFFs with or without radiographs.csv, that table, or one TIFF stack."
)


def import_(
    reference: Annotated[str, typer.Option("--reference", metavar="SCAN", help=f"The scan at rest. {_SCAN}")],
    test: Annotated[str, typer.Option("--test", metavar="SCAN", help="The radiographs of the test, the same way.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="The experiment folder to write.")],
    flats: Annotated[
        Path | None,
        typer.Option(
            "--flats", metavar="TIFF|DIR", help="Images without the sample; unless given, those of the scan at rest."
        ),
    ] = None,
    darks: Annotated[
        Path | None,
        typer.Option("--darks", metavar="TIFF|DIR", help="Images without X-rays; unless given, as the flats."),
    ] = None,
    reference_table: Annotated[
        Path | None,
        typer.Option(
            "--reference-table", metavar="CSV", help="A line for each view: columns angle, time, force with units."
        ),
    ] = None,
    test_table: Annotated[
        Path | None,
        typer.Option("--test-table", metavar="CSV", help="The same for the test; stands above what its files tell."),
    ] = None,
    period_s: Annotated[
        float | None,
        typer.Option("--period-s", min=1e-6, metavar="S", help="Time from one radiograph of the test to the next."),
    ] = None,
    start_s: Annotated[
        float, typer.Option("--start-s", metavar="S", help="With --period-s: time of the first radiograph.")
    ] = 0.0,
    forces: Annotated[
        Path | None,
        typer.Option("--forces", metavar="CSV", help="The testing machine's record: columns time and force, units."),
    ] = None,
    time_column: Annotated[
        str, typer.Option("--time-column", metavar="NAME", help="Its column of times, if it has another name.")
    ] = "time",
    force_column: Annotated[
        str | None,
        typer.Option("--force-column", metavar="NAME", help="Its column of forces, if not force or load."),
    ] = None,
    clock_s: Annotated[
        float,
        typer.Option("--clock-s", metavar="S", help="What the machine's clock shows when the scanner's shows 0."),
    ] = 0.0,
    no_forces: Annotated[
        bool, typer.Option("--no-forces", help="No force was recorded during the test: write zeros.")
    ] = False,
    geometry: Annotated[
        Path | None,
        typer.Option(
            "--geometry",
            metavar="FILE",
            help="Distances, and the detector's place: RTK's .xml, or ASTRA's vectors, .csv.",
        ),
    ] = None,
    source_axis_mm: Annotated[
        float | None, typer.Option("--source-axis-mm", metavar="MM", help="Source to rotation axis.")
    ] = None,
    source_detector_mm: Annotated[
        float | None, typer.Option("--source-detector-mm", metavar="MM", help="Source to detector.")
    ] = None,
    pixel_mm: Annotated[float | None, typer.Option("--pixel-mm", metavar="MM", help="Pitch of the pixels.")] = None,
    column_shift_mm: Annotated[
        float | None, typer.Option("--column-shift-mm", metavar="MM", help="Middle of the image right of the axis.")
    ] = None,
    row_shift_mm: Annotated[
        float | None, typer.Option("--row-shift-mm", metavar="MM", help="Middle of the image below the source.")
    ] = None,
    roll_deg: Annotated[
        float | None, typer.Option("--roll-deg", metavar="DEG", help="Detector turned clockwise in the image.")
    ] = None,
    mirror_columns: Annotated[
        bool, typer.Option("--mirror-columns", help="Images are stored left to right exchanged.")
    ] = False,
    mirror_rows: Annotated[bool, typer.Option("--mirror-rows", help="Images are stored upside down.")] = False,
    turn_back: Annotated[
        bool, typer.Option("--turn-back", help="The stage turns the other way than the format's sense.")
    ] = False,
    title: Annotated[str, typer.Option("--title", metavar="TEXT", help="A line for figures and reports.")] = "",
    material: Annotated[str, typer.Option("--material", metavar="TEXT", help="What the sample is made of.")] = "",
    frames: Annotated[int, typer.Option("--frames", min=1, metavar="N", help="Frames averaged into each image.")] = 1,
    photons_per_count: Annotated[
        float | None,
        typer.Option("--photons-per-count", metavar="N", help="Detected photons that make one count of one frame."),
    ] = None,
    readout_noise_counts: Annotated[
        float | None,
        typer.Option("--readout-noise-counts", metavar="N", help="Standard deviation of the readout of one frame."),
    ] = None,
) -> None:
    """Make an experiment folder of a reference scan and a test as scanners write them, and the machine's forces.

    What a format does not hold is asked for by an option. What was taken for granted is printed.

    Example:  `pdvc-bench import --reference scan.xtekct --test during --period-s 2 --forces machine.csv -o mine`
    """
    with answering(resume="give the same command again to begin anew") as progress:
        from validation.doors.assembly import write_folder
        from validation.doors.request import ForceRecord, Request

        def told(**values: float | None) -> dict[str, float]:
            return {key: value for key, value in values.items() if value is not None}

        whole = Request(
            reference=reference,
            test=test,
            flats=flats,
            darks=darks,
            reference_table=reference_table,
            test_table=test_table,
            period_s=period_s,
            start_s=start_s,
            forces=None
            if forces is None
            else ForceRecord(path=forces, time_column=time_column, force_column=force_column, clock_s=clock_s),
            no_forces=no_forces,
            geometry_file=geometry,
            geometry=told(
                source_axis_mm=source_axis_mm,
                source_detector_mm=source_detector_mm,
                pixel_mm=pixel_mm,
                column_shift_mm=column_shift_mm,
                row_shift_mm=row_shift_mm,
                roll_deg=roll_deg,
            ),
            mirror_columns=mirror_columns,
            mirror_rows=mirror_rows,
            turn_back=turn_back,
            title=title,
            material=material,
            acquisition={
                "frames": frames,
                **told(photons_per_count=photons_per_count, readout_noise_counts=readout_noise_counts),
            },
        ).assembled()
        write_folder(whole, out, progress=progress)
    for note in whole.notes:
        tell(note)
    tell(f"experiment: {out}; look at it before it is measured: pdvc-bench inspect {out}")


def export(
    source: Annotated[
        Path, typer.Argument(metavar="FILE|DIR", help="A measurement, as written by measure; or an experiment folder.")
    ],
    experiment: Annotated[
        Path | None,
        typer.Option("--experiment", metavar="DIR", help="Of a measurement: the folder that was measured."),
    ] = None,
    vtk: Annotated[
        Path | None,
        typer.Option(
            "--vtk", metavar="DIR", help="The moving surface for ParaView; with --experiment, the sample's outline."
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Displacement and strain as a table of text.")
    ] = None,
    parquet: Annotated[
        Path | None, typer.Option("--parquet", metavar="FILE", help="The same table as Parquet (extra: parquet).")
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            "--points",
            metavar="CSV",
            help="Columns x, y, z with units: where the table asks. Default: between sections.",
        ),
    ] = None,
    gauge_mm: Annotated[
        float | None,
        typer.Option("--gauge-mm", metavar="MM", help="Length over which the table's strain is. Default: a section."),
    ] = None,
    volume: Annotated[
        Path | None, typer.Option("--volume", metavar="TIFF", help="The volume at rest, reconstructed, for ImageJ.")
    ] = None,
    geometry: Annotated[
        Path | None,
        typer.Option("--geometry", metavar="FILE", help="The geometry: .xml for RTK, .csv for ASTRA (cone_vec)."),
    ] = None,
    series: Annotated[
        SeriesName, typer.Option("--series", help="Whose angles --geometry is of.")
    ] = SeriesName.REFERENCE,
    nxtomo: Annotated[
        Path | None, typer.Option("--nxtomo", metavar="FILE", help="The experiment as NXtomo (HDF5), two entries.")
    ] = None,
    options: Annotated[
        str | None,
        typer.Option(
            "--options", metavar="NAME|TOML", help="For outline and volume; else the measurement's, or default."
        ),
    ] = None,
    work: Annotated[
        Path | None,
        typer.Option("--work", metavar="DIR", help="Where measure or prepare kept a volume, to be taken from there."),
    ] = None,
    threads: Threads = None,
) -> None:
    """Write a measurement, or an experiment, for other programs: ParaView, tables, ImageJ, ASTRA, RTK, NXtomo.

    Example:  `pdvc-bench export motion.nc --experiment mine --vtk out/vtk --csv out/motion.csv`
    """
    with answering() as progress:
        from validation.doors.export import Export

        use_threads(threads)
        written = Export(
            vtk=vtk,
            csv=csv,
            parquet=parquet,
            points=points,
            gauge_mm=gauge_mm,
            volume=volume,
            geometry=geometry,
            series=series.value,
            nxtomo=nxtomo,
            options=None if options is None else read_options(options),
            work=work,
        ).write(source, experiment, progress=progress)
    for path in written:
        tell(f"written: {path}")
