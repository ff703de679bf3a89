"""Pictures of the newest radiograph and of what its motion leaves unexplained, for eyes beside the test.

A folder beside the record, readable without this software::

    00057.radiograph.png    counts, from black to as bright as the air (gray)
    00057.residual.png      the used window: residual over its standard deviation, from -5 (blue) to 5 (red)
    latest.json             {"step": 57, "lag_s": 0.4, "alarms": [41]}: of which step the newest are, how long it took
                            from the radiograph's file to its motion, and of which alarms there are pictures
    alarms/                 the same two of each step at which an alarm was raised, and a motion told

Each file is written whole. Once there is a newer pair, the one before it stays for those who are still reading it.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pdvc.record import AlarmLine, Line
from pdvc.whole import write_whole
from validation.view.places import ALARMS, LATEST

if TYPE_CHECKING:
    # these load all kernels, which who only looks need not
    from pdvc.incoming import Arrival
    from pdvc.tracker import Taken

LIMIT = 5.0
"""Largest residual that is told apart, in standard deviations."""
RADIOGRAPH_PX, RESIDUAL_PX = 640, 1024
"""Longest side of a picture: of a larger image every second pixel is shown, or every third, and so on."""
AIR = 0.995
"""Share of the pixels that are darker than what is shown white."""


class Pictures:
    """Write pictures of a test that is followed; where that fails, the measurement goes on without.

    `radiographs` is where they arrive, `warn` is told once why there are no pictures.
    """

    def __init__(self, folder: Path, radiographs: Path, warn: Callable[[str], None]) -> None:
        self._folder, self._radiographs, self._warn = folder, radiographs, warn
        self._newest: tuple[int, dict[str, bytes], float] | None = None
        self._awaited: set[int] = set()
        self._failed = False

    def see(self, arrival: Arrival, taken: Taken) -> None:
        """Show a radiograph whose motion was told."""
        self._attempt(lambda: self._show(arrival, taken))

    def tell(self, line: Line) -> None:
        """Keep the pictures of a step that raises an alarm, which may be told before or after they are made."""
        if not isinstance(line, AlarmLine):
            return
        if self._newest is None or self._newest[0] != line.step:
            self._awaited.add(line.step)
        else:
            self._attempt(lambda: self._keep(line.step))

    def _show(self, arrival: Arrival, taken: Taken) -> None:
        if self._newest and arrival.step < self._newest[0]:
            return
        # by the clock of the disk, which may be that of another machine
        lag_s = time.time() - (self._radiographs / arrival.file).stat().st_mtime
        pair = {"radiograph": radiograph_png(arrival.counts), "residual": residual_png(taken.residual)}
        before = self._newest[0] if self._newest else arrival.step
        self._newest = arrival.step, pair, lag_s
        for name, picture in pair.items():
            write_whole(self._folder / f"{arrival.step:05d}.{name}.png", picture)
        if arrival.step in self._awaited:
            self._keep(arrival.step)
        else:
            self._say_latest()
        stay = {f"{step:05d}" for step in (before, arrival.step)}
        for old in self._folder.glob("*.png"):
            if old.name.partition(".")[0] not in stay:
                old.unlink(missing_ok=True)

    def _keep(self, step: int) -> None:
        """Keep the pictures of the newest step."""
        assert self._newest is not None
        self._awaited.discard(step)
        for name, picture in self._newest[1].items():
            write_whole(self._folder / ALARMS / f"{step:05d}.{name}.png", picture)
        self._say_latest()

    def _say_latest(self) -> None:
        assert self._newest is not None
        step, _, lag_s = self._newest
        kept = sorted(int(path.name.partition(".")[0]) for path in (self._folder / ALARMS).glob("*.residual.png"))
        latest = {"step": step, "lag_s": round(lag_s, 3), "alarms": kept}
        write_whole(self._folder / LATEST, json.dumps(latest).encode())

    def _attempt(self, draw: Callable[[], None]) -> None:
        try:
            draw()
        # whatever is the matter with a picture, the measurement is worth more
        except Exception as error:
            if not self._failed:
                self._warn(f"no pictures for a while: {self._folder}: {error}")
            self._failed = True
        else:
            self._failed = False


def radiograph_png(counts: NDArray[np.uint16]) -> bytes:
    """Return a radiograph (row, column) in gray, as white as the air is bright."""
    shown = _thinned(counts, RADIOGRAPH_PX).astype(np.float32)
    bright = max(float(np.quantile(shown, AIR)), 1.0)
    return _png(Image.fromarray(np.clip(shown * (255 / bright), 0, 255).astype(np.uint8)))


def residual_png(residual: NDArray[np.float32]) -> bytes:
    """Return a residual over its standard deviation (row, column), white where it is none."""
    shown = np.nan_to_num(_thinned(residual, RESIDUAL_PX))
    picture = Image.fromarray(np.round((np.clip(shown / LIMIT, -1, 1) + 1) * 127.5).astype(np.uint8))
    picture.putpalette(colours("RdBu_r").tobytes())
    return _png(picture)


def colours(name: str) -> NDArray[np.uint8]:
    """Return a colour map as red, green, blue (256, 3)."""
    return np.asarray(matplotlib.colormaps[name](np.arange(256), bytes=True))[:, :3]


def _thinned(image: NDArray[Any], most: int) -> NDArray[Any]:
    every = -(-max(image.shape) // most)
    return image[::every, ::every]


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    # noise hardly packs: a higher level takes longer for nothing
    picture.save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()
