"""Scans in NXtomo, NeXus's definition for tomography: HDF5, one entry for each scan; read and written.

Read are ``instrument/detector``: ``data``, ``image_key`` (0: radiograph, 1: flat, 2: dark, 3: invalid) or
``image_key_control``, ``x_pixel_size``, ``distance`` to the sample and ``x_rotation_axis_pixel_position``;
``instrument/source/distance``; and ``sample/rotation_angle``, taken as counter-clockwise seen from above, which is
positive about the vertical axis of NeXus. Images are taken as an eye at the source sees them unless
``detector/transformations`` turns them by 180 degrees about the vertical axis, which mirrors columns, or about the
horizontal one, which mirrors rows (so writes the package nxtomo from version 1.3 of its files on; ``x_flipped`` and
``y_flipped`` before). A turn about the beam is the detector's roll. Axes are those of NeXus, z along the beam and y
up; in files of nxtomo before version 2.0 that name no other, x is along the beam and z up.

The definition has no place for times and forces. They are written, and read where they are there, as fields
``time`` and ``force`` of the entry's ``data`` group, one number for each frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdvc.experiment import Experiment, Series
from pdvc.geometry import ConeBeam
from validation.doors.quantities import ANGLE, FORCE, LENGTH, TIME, Units, in_ours
from validation.doors.refusal import refused
from validation.doors.scan import Counts, Floats, Images, Scan, along_frame, along_pixels

if TYPE_CHECKING:
    import h5py

DETECTOR = "instrument/detector"
ANGLES = "sample/rotation_angle"
RADIOGRAPH, FLAT, DARK = 0, 1, 2
LARGEST_COUNT = 65535
_WITHIN_DEG = 1e-3
COORDINATES = "NeXus_Coordinate_System"
"""Attribute of an entry by which the package nxtomo tells which way its axes run."""
_BEAM, _UP, _ACROSS = 0, 1, 2
_AXES = {"McStas": ("z", "y", "x"), "ESRF": ("x", "z", "y")}
"""Names of the axes along the beam, up and across."""


def read_nxtomo(path: Path, entry: str = "", given: Mapping[str, float] | None = None) -> Scan:
    """Read a scan from an entry of a file, the only one unless it is named.

    What is `given` of the geometry elsewhere is not looked for. Raises FormatError, in one line, for what is
    missing, unreadable, or not to be described by `pdvc.geometry`.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            place = _entry(path, file, entry)
            return _Entry(path, place, file[place]).scan(given or {})
    except FileNotFoundError:
        raise refused(path, "", "an NXtomo file", "none") from None
    except OSError as error:
        if error.errno is not None:
            raise
        raise refused(path, "", "an NXtomo file, HDF5", error) from None


def _entry(path: Path, file: h5py.File, wanted: str) -> str:
    """Return the place of the wanted entry, or of the only one that says it is NXtomo."""
    import h5py

    if wanted:
        if not isinstance(file.get(wanted), h5py.Group):
            raise refused(path, wanted, "an entry", f"none; there is {', '.join(file) or 'nothing'}")
        return wanted
    found: list[str] = []

    def look(name: str, item: object) -> None:
        definition = item.get("definition") if isinstance(item, h5py.Group) else None
        if isinstance(definition, h5py.Dataset) and _text(definition[()]) == "NXtomo":
            found.append(name)

    file.visititems(look)
    if len(found) != 1:
        listed = f"{len(found)}: choose by {path.name}::NAME among {', '.join(found)}" if found else "none"
        raise refused(path, "definition", "one entry NXtomo", listed)
    return found[0]


class _Entry:
    """An entry of an open file."""

    def __init__(self, path: Path, place: str, group: h5py.Group) -> None:
        self._path = path
        self._place = place
        self._group = group

    def scan(self, given: Mapping[str, float]) -> Scan:
        keys = self._keys()
        data = self._dataset(f"{DETECTOR}/data")
        if data.ndim != 3 or not np.issubdtype(data.dtype, np.integer) or len(data) != len(keys):
            expected = f"whole counts ({len(keys)} as image_key, row, column)"
            raise self._refused(f"{DETECTOR}/data", expected, f"{data.dtype} of shape {data.shape}")
        size = int(data.shape[1]), int(data.shape[2])
        of = {key: np.flatnonzero(keys == key) for key in (RADIOGRAPH, FLAT, DARK)}
        if not len(of[RADIOGRAPH]):
            raise self._refused(f"{DETECTOR}/image_key", "radiographs, 0", f"only {np.unique(keys).tolist()}")
        angles, noted = self._angles(len(keys))
        scan = Scan(
            source=self._path,
            images=self._images(of[RADIOGRAPH], size),
            angle_deg=angles[of[RADIOGRAPH]],
            time_s=self._recorded("data/time", TIME, of[RADIOGRAPH], len(keys)),
            force_N=self._recorded("data/force", FORCE, of[RADIOGRAPH], len(keys)),
            geometry=self._geometry(size, given),
            flats=self._images(of[FLAT], size) if len(of[FLAT]) else None,
            darks=self._images(of[DARK], size) if len(of[DARK]) else None,
            title=_text(self._group["title"][()]) if "title" in self._group else "",
            notes=noted,
        )
        columns, rows = self._flips()
        return scan.mirrored(columns=columns, rows=rows)

    def _keys(self) -> Floats:
        control = f"{DETECTOR}/image_key_control"
        place = control if control in self._group else f"{DETECTOR}/image_key"
        return np.asarray(self._dataset(place)[()])

    def _images(self, which: Any, size: tuple[int, int]) -> Images:
        path, place = self._path, f"{self._place}/{DETECTOR}/data"

        def read(k: int) -> Counts:
            import h5py

            with h5py.File(path, "r") as file:
                try:
                    image = file[place][int(which[k])]
                except OSError as error:
                    raise refused(path, f"{place}: frame {which[k]}", "an image", error) from None
            if image.min() < 0 or image.max() > LARGEST_COUNT:
                found = f"{image.min()} to {image.max()}"
                raise refused(path, f"{place}: frame {which[k]}", f"counts from 0 to {LARGEST_COUNT}", found)
            return np.asarray(image, dtype=np.uint16)

        return Images(count=len(which), size=size, read=read)

    def _angles(self, frames: int) -> tuple[Floats, tuple[str, ...]]:
        dataset = self._dataset(ANGLES)
        values = self._of_frames(dataset, ANGLES, frames)
        if "units" not in dataset.attrs:
            return values, (f"{self._path}: {self._place}/{ANGLES}: no units: taken as degrees",)
        return values * self._factor(dataset, ANGLE, ANGLES), ()

    def _recorded(self, place: str, units: Units, which: Any, frames: int) -> Floats | None:
        if place not in self._group:
            return None
        dataset = self._dataset(place)
        return np.asarray(self._of_frames(dataset, place, frames)[which] * self._factor(dataset, units, place))

    def _of_frames(self, dataset: h5py.Dataset, place: str, frames: int) -> Floats:
        """Return one number for each frame."""
        if dataset.shape != (frames,) or not np.issubdtype(dataset.dtype, np.number):
            found = f"{dataset.dtype} of shape {dataset.shape}"
            raise self._refused(place, f"{frames} numbers, one for each frame", found)
        return np.asarray(dataset[()], dtype=float)

    def _geometry(self, size: tuple[int, int], given: Mapping[str, float]) -> dict[str, float]:
        """Return what the entry tells, of stored images; a key that it does not tell is left out."""
        found: dict[str, float] = {}
        pixel = f"{DETECTOR}/x_pixel_size"
        if "pixel_mm" not in given and pixel in self._group:
            found["pixel_mm"] = self._length(pixel)
            high = f"{DETECTOR}/y_pixel_size"
            if high in self._group and abs(self._length(high) - found["pixel_mm"]) > 1e-3 * found["pixel_mm"]:
                raise self._refused(high, f"square pixels, {found['pixel_mm']:g} mm", f"{self._length(high):g} mm")
        source = "instrument/source/distance"
        if source in self._group and "source_axis_mm" not in given:
            # NeXus counts along the beam, from the sample: what is before it is negative
            found["source_axis_mm"] = abs(self._length(source))
            distance = f"{DETECTOR}/distance"
            if distance in self._group and "source_detector_mm" not in given:
                found["source_detector_mm"] = found["source_axis_mm"] + abs(self._length(distance))
        found["roll_deg"] = self._turn(_BEAM)
        pixel_mm = found.get("pixel_mm", given.get("pixel_mm"))
        if pixel_mm is not None:
            found |= self._shifts(size, pixel_mm, math.radians(found["roll_deg"]))
        return found

    def _shifts(self, size: tuple[int, int], pixel_mm: float, roll_rad: float) -> dict[str, float]:
        """Return where the middle of the image is, from the pixel in which axis and midplane are seen."""
        places = []
        for name, count in (("x", size[1]), ("y", size[0])):
            key = f"{DETECTOR}/{name}_rotation_axis_pixel_position"
            middle = (count - 1) / 2
            places.append(middle - self._number(key) if key in self._group else 0.0)
        columns, rows = along_frame(places[0] * pixel_mm, places[1] * pixel_mm, roll_rad)
        return {"column_shift_mm": columns, "row_shift_mm": rows}

    def _flips(self) -> tuple[bool, bool]:
        """Return whether columns, and whether rows, are stored the other way round."""
        old = [f"{DETECTOR}/{name}_flipped" in self._group for name in "xy"]
        if any(old):
            return tuple(  # type: ignore[return-value]
                there and bool(self._dataset(f"{DETECTOR}/{name}_flipped")[()])
                for name, there in zip("xy", old, strict=True)
            )
        turns = {axis: self._turn(axis) for axis in (_UP, _ACROSS)}
        for axis, turn in turns.items():
            if min(abs(turn), abs(abs(turn) - 180)) > _WITHIN_DEG:
                where = f"{DETECTOR}/transformations"
                raise self._refused(where, f"a turn about {self._axes()[axis]} by 0 or 180 degrees", f"{turn:g}")
        return abs(turns[_UP]) > 90, abs(turns[_ACROSS]) > 90

    def _axes(self) -> tuple[str, str, str]:
        """Return the names of the axes along the beam, up and across."""
        told = _text(self._group.attrs.get(COORDINATES, ""))
        if not told:
            told = "ESRF" if float(self._group.attrs.get("version", 2.0)) < 2.0 else "McStas"
        if told not in _AXES:
            raise self._refused(COORDINATES, " or ".join(_AXES), repr(told))
        return _AXES[told]

    def _turn(self, which: int) -> float:
        """Return by how many degrees the detector is turned about the axis along the beam, up or across."""
        turned, axis = 0.0, [float(name == self._axes()[which]) for name in "xyz"]
        transformations = self._group.get(f"{DETECTOR}/transformations", {})
        for name, dataset in transformations.items():
            if _text(dataset.attrs.get("transformation_type", "")) != "rotation" or dataset.shape not in ((), (1,)):
                continue
            along = float(np.dot(dataset.attrs.get("vector", (0, 0, 0)), axis))
            place = f"{DETECTOR}/transformations/{name}"
            turned += along * float(np.ravel(dataset[()])[0]) * self._factor(dataset, ANGLE, place)
        return turned

    def _length(self, place: str) -> float:
        return self._number(place) * self._factor(self._dataset(place), LENGTH, place)

    def _number(self, place: str) -> float:
        values = np.ravel(self._dataset(place)[()])
        if len(values) != 1 or not np.issubdtype(values.dtype, np.number) or not np.isfinite(values[0]):
            raise self._refused(place, "a number", values[:3].tolist())
        return float(values[0])

    def _factor(self, dataset: h5py.Dataset, units: Units, place: str) -> float:
        if "units" not in dataset.attrs:
            raise self._refused(place, "an attribute units", "none")
        return in_ours(units, _text(dataset.attrs["units"]), self._path, f"{self._place}/{place}: units")

    def _dataset(self, place: str) -> h5py.Dataset:
        import h5py

        found = self._group.get(place)
        if not isinstance(found, h5py.Dataset):
            raise self._refused(place, "a dataset", "none")
        return found

    def _refused(self, place: str, expected: str, found: object) -> Exception:
        return refused(self._path, f"{self._place}/{place}", expected, found)


def _text(value: Any) -> str:
    value = value[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def write_nxtomo(path: Path, experiment: Experiment) -> None:
    """Write an experiment as NXtomo, under its name only when it is complete: the entries `reference` and `test`.

    Each has the radiographs of one series after all darks and flats, so that it can be read by itself.
    """
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    try:
        with h5py.File(partial, "w") as file:
            file.attrs["default"] = "reference"
            for name, series in (("reference", experiment.reference), ("test", experiment.test)):
                _write_entry(file.create_group(name), experiment, series)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _write_entry(entry: h5py.Group, experiment: Experiment, series: Series) -> None:
    import h5py

    entry.attrs["NX_class"] = "NXentry"
    # of the layout, as the package nxtomo counts
    entry.attrs["version"] = 2.0
    entry.attrs[COORDINATES] = "McStas"
    entry["definition"] = "NXtomo"
    entry["title"] = experiment.title
    before = len(experiment.darks) + len(experiment.flats)
    keys = np.repeat([DARK, FLAT, RADIOGRAPH], [len(experiment.darks), len(experiment.flats), len(series)])
    detector = _group(_group(entry, "instrument", "NXinstrument"), "detector", "NXdetector")
    size = experiment.geometry.rows, experiment.geometry.columns
    data = detector.create_dataset("data", (len(keys), *size), np.uint16, chunks=(1, *size))
    place = 0
    for images in (experiment.darks, experiment.flats, series.counts):
        for image in images:
            data[place] = image
            place += 1
    detector["image_key"] = keys
    _write_geometry(entry["instrument"], detector, experiment.geometry)

    def with_images_before(values: Floats) -> Floats:
        return np.concatenate([np.zeros(before), values])

    sample = _group(entry, "sample", "NXsample")
    sample["name"] = experiment.material or experiment.title
    _quantity(sample, "rotation_angle", with_images_before(np.rad2deg(series.angle_rad)), "deg")
    shown = _group(entry, "data", "NXdata")
    shown.attrs["signal"] = "data"
    for target in (f"{DETECTOR}/data", f"{DETECTOR}/image_key", ANGLES):
        shown[target.rpartition("/")[2]] = h5py.SoftLink(f"{entry.name}/{target}")
    _quantity(shown, "time", with_images_before(series.time_s), "s")
    _quantity(shown, "force", with_images_before(series.force_N), "N")


def _write_geometry(instrument: h5py.Group, detector: h5py.Group, geometry: ConeBeam) -> None:
    source = _group(instrument, "source", "NXsource")
    source["type"], source["probe"] = "Fixed Tube X-ray", "x-ray"
    _quantity(source, "distance", -geometry.source_axis_mm, "mm")
    _quantity(detector, "distance", geometry.source_detector_mm - geometry.source_axis_mm, "mm")
    for name in "xy":
        _quantity(detector, f"{name}_pixel_size", geometry.pixel_mm, "mm")
    columns, rows = along_pixels(geometry.column_shift_mm, geometry.row_shift_mm, geometry.roll_rad)
    for name, count, shift in (("x", geometry.columns, columns), ("y", geometry.rows, rows)):
        detector[f"{name}_rotation_axis_pixel_position"] = (count - 1) / 2 - shift / geometry.pixel_mm
    if geometry.roll_rad:
        transformations = _group(detector, "transformations", "NXtransformations")
        roll = _quantity(transformations, "roll", math.degrees(geometry.roll_rad), "deg")
        roll.attrs.update({"transformation_type": "rotation", "vector": [0.0, 0.0, 1.0], "depends_on": "."})


def _group(parent: h5py.Group, name: str, kind: str) -> h5py.Group:
    made = parent.create_group(name)
    made.attrs["NX_class"] = kind
    return made


def _quantity(group: h5py.Group, name: str, value: Any, unit: str) -> h5py.Dataset:
    group[name] = value
    group[name].attrs["units"] = unit
    return group[name]
