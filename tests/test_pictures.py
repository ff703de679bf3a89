"""Pictures that live leaves: what they show, which stay, and that none of them stops a measurement."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from pdvc.record import record_of
from tests.followed_tests import ALARM, PLAN, latest, pictured, seen, written
from validation.view import pictures as room
from validation.view.pictures import RESIDUAL_PX, Pictures, radiograph_png, residual_png
from validation.view.places import find_places


def read(picture: bytes) -> Image.Image:
    return Image.open(io.BytesIO(picture))


def names(folder):
    return sorted(path.name for path in folder.glob("*.png"))


def test_a_radiograph_is_as_white_as_the_air_is_bright():
    picture = read(radiograph_png(seen(0)[0].counts))
    assert picture.mode == "L"
    assert picture.size == (30, 40)
    shown = np.array(picture)
    assert shown[0, 0] == 255
    assert shown[0, 15] == pytest.approx(255 / 4, abs=1)


def test_a_residual_is_blue_below_and_red_above_and_white_where_there_is_none():
    shown = np.array(read(residual_png(seen(0)[1].residual)).convert("RGB")).astype(int)
    over, under, half, none = shown[5, 5:9]
    np.testing.assert_array_equal(over, [103, 0, 31])  # the ends of RdBu, as published by ColorBrewer
    np.testing.assert_array_equal(under, [5, 48, 97])
    assert half[0] > 220 > 150 > half[2]
    assert none.min() > 240
    np.testing.assert_array_equal(none, shown[0, 0])


def test_a_dark_radiograph_and_a_large_one_are_shown_too():
    assert not np.array(read(radiograph_png(np.zeros((4, 3), dtype=np.uint16)))).any()
    large = np.zeros((3, 2 * RESIDUAL_PX + 1), dtype=np.float32)
    assert read(residual_png(large)).size == ((2 * RESIDUAL_PX + 1 + 2) // 3, 1)


def test_the_newest_pair_stays_and_the_one_before_and_those_of_alarms(tmp_path):
    places = written(tmp_path, PLAN)
    # the alarm may be told before its pictures are made
    assert not pictured(places, tmp_path / "arriving", 3, 4, 5, 6, 7, told=(ALARM,))
    assert names(places.pictures) == [f"0000{t}.{name}.png" for t in (6, 7) for name in ("radiograph", "residual")]
    assert names(places.pictures / "alarms") == ["00005.radiograph.png", "00005.residual.png"]
    assert latest(places)["step"] == 7
    assert latest(places)["alarms"] == [5]
    assert 0 <= latest(places)["lag_s"] < 60
    # a process that goes on knows nothing of those before, but they are cleared away
    assert not pictured(places, tmp_path / "arriving", 8)
    assert names(places.pictures) == ["00008.radiograph.png", "00008.residual.png"]
    assert latest(places)["alarms"] == [5]


def test_an_alarm_told_after_its_pictures_were_made_keeps_them(tmp_path):
    places = written(tmp_path, PLAN)
    (tmp_path / "00005.tif").write_bytes(b"")
    pictures = Pictures(places.pictures, tmp_path, pytest.fail)
    pictures.see(*seen(5))
    pictures.tell(PLAN)
    assert latest(places)["alarms"] == []
    pictures.tell(ALARM)
    assert latest(places)["alarms"] == [5]


def test_pictures_that_cannot_be_written_are_told_once_and_stop_nothing(tmp_path, monkeypatch):
    places = written(tmp_path, PLAN)

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(room, "write_whole", full)
        (warned,) = pictured(places, tmp_path / "arriving", 3, 4, 5, told=(ALARM,))
    assert "no pictures" in warned
    assert "No space left on device" in warned
    # there may be room again
    assert not pictured(places, tmp_path / "arriving", 6)
    assert latest(places)["step"] == 6


def test_a_radiograph_that_is_gone_already_has_no_picture(tmp_path):
    warned: list[str] = []
    Pictures(tmp_path / "pictures", tmp_path, warned.append).see(*seen(3))
    assert len(warned) == 1


def test_the_record_is_where_live_writes_it(tmp_path):
    places = written(tmp_path, PLAN)
    assert places.record == record_of(places.file)
    assert find_places(places.file) == find_places(places.record) == places
