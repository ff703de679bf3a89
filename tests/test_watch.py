"""A test watched in a terminal: numbers, bars and alarms within 80 x 24 characters, and plain lines elsewhere."""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest
from rich.console import Console

from tests.command_line import only_line, pdvc_bench
from tests.followed_tests import ALARM, LOST, OVER, PLAN, STEPS, add, pictured, step, written
from validation.view import terminal
from validation.view.state import State
from validation.view.terminal import bar, passed, screen_of


def shown(*lines, now_s=1e9 + 5.5, lag_s=0.41, size=(80, 24)) -> str:
    """Return what is shown on a screen of (columns, lines)."""
    console = Console(record=True, width=size[0], height=size[1], file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        console.print(screen_of(State.of(lines), now_s, lag_s, size[1] - 1, size[0]))
    text = console.export_text(styles=False)
    assert len(text.splitlines()) < size[1]
    assert max(map(len, text.splitlines())) <= size[0]
    return text


RUNNING = (PLAN, *(step(t) for t in range(6)))


def test_the_numbers_of_the_newest_step_are_shown_with_intervals():
    text = shown(*RUNNING)
    for words in (
        PLAN.title,
        "following",
        "5 of 0 to 11",
        "300 N",
        "0.500 ± 0.020 %",
        "0.0200 ± 0.0008 mm",  # of 4 mm
        "usually 1.0 s",
        "0.41 s",
        "0.38 s",
        "1.02",
    ):
        assert words in text
    assert "ALARM" not in text


def test_each_section_has_a_bar_the_top_one_first():
    lines = [
        line for line in shown(*RUNNING).splitlines() if " mm " in line and "±" in line and "extension" not in line
    ]
    assert [float(line.split()[0]) for line in lines] == [1.75, 1.25, 0.75, 0.25, -0.25, -0.75, -1.25, -1.75]
    lengths = [line.count("█") for line in lines]
    assert lengths == lengths[::-1]
    assert lengths[3] == max(lengths) > 30
    # exp(-0.75^2) / exp(-0.25^2) of the longest
    assert lengths[2] == pytest.approx(math.exp(-0.5) * lengths[3], abs=1)
    assert "0.94 ± 0.04 %" in lines[3]


def test_alarms_stand_out_and_their_place_is_marked():
    alarms = [replace(ALARM, step=t, reason=f"why {t} " + "and so on " * 12) for t in range(5)]
    text = shown(*RUNNING, *alarms, LOST)
    assert re.search(r"alarms +5 ", text)
    assert re.search(r"lost +1 ", text)
    assert [f"step {t}: why {t}" in text for t in range(5)] == [False, False, True, True, True]
    # of the newest the whole reason
    assert " ".join(text.split()).count("and so on " * 11 + "and so on") == 1
    assert "lost: 00006.tif: expected 4 x 3 px" in text
    (marked,) = (line for line in text.splitlines() if line.rstrip().endswith(" alarm"))
    assert marked.startswith("  1.25 mm")


@pytest.mark.parametrize(
    ("lines", "now_s", "words"),
    [
        ((PLAN,), 0.0, "waiting for the first radiograph"),
        (RUNNING, 1e9 + 7.9, "following"),
        (RUNNING, 1e9 + 8.1, "no new radiograph for a while"),
        ((PLAN, *(step(t) for t in range(STEPS) if t != LOST.step), LOST), 2e9, "the whole test is being measured"),
        ((*RUNNING, OVER), 2e9, "test over: measurement in motion.nc"),
    ],
)
def test_it_is_said_how_the_test_is(lines, now_s, words):
    assert words in shown(*lines, now_s=now_s)


def test_a_radiograph_that_came_late_is_not_the_newest():
    assert "5 of 0 to 11" in shown(PLAN, step(4), step(5), step(3))


def test_many_sections_and_what_is_not_known_fit_as_well():
    height = tuple(k / 10 for k in range(61))
    line = replace(
        step(5), strain=(math.nan, 0.01, *(0.001,) * 58), strain_std=(math.nan,) * 60, mean_strain_std=math.nan
    )
    text = shown(replace(PLAN, height_mm=height), line, ALARM, LOST, lag_s=math.nan)
    assert "1.00 ± – %" in text
    assert "nan" not in text


def test_a_time_is_told_in_the_unit_that_suits_it():
    assert [passed(s) for s in (-0.1, 100, 200, 5 * 3600, 9e5)] == ["0 s", "100 s", "3 min", "5 h", "10 days"]


def test_a_bar_is_right_to_an_eighth():
    assert [bar(length) for length in (0, 0.125, 0.5, 0.99, 1, 2.25)] == ["", "▏", "▌", "█", "█", "██▎"]


def test_without_a_terminal_lines_are_printed_as_they_come(tmp_path):
    places = written(tmp_path, PLAN, step(0))
    command = [sys.executable, "-m", "pdvc_bench", "watch", places.file]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().rstrip() == PLAN.words()
        assert process.stdout.readline().rstrip() == step(0).words()
        add(places, ALARM, LOST, OVER)
        rest, error = process.communicate(timeout=10)
    assert rest.splitlines() == [line.words() for line in (ALARM, LOST, OVER)]
    assert not error
    assert process.returncode == 0


def test_it_is_interrupted_like_any_other_command(tmp_path):
    places = written(tmp_path, PLAN)
    command = [sys.executable, "-m", "pdvc_bench", "watch", places.file]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=10)
    assert error == "interrupted; the same command shows it again\n"
    assert process.returncode == 130


def test_in_a_terminal_the_screen_follows_until_the_measurement(tmp_path):
    places = written(tmp_path, *RUNNING)
    pictured(places, tmp_path / "arriving", 5)
    console = Console(width=80, height=24, force_terminal=True, record=True, file=(tmp_path / "screen").open("w"))
    watching = threading.Thread(target=terminal.watch, args=(places, console))
    watching.start()
    time.sleep(0.4)
    add(places, *(step(t) for t in range(6, STEPS)), OVER)
    watching.join(10)
    assert not watching.is_alive()
    console.file.close()
    screen = (tmp_path / "screen").read_text()
    assert "5 of 0 to 11" in screen
    assert "11 of 0 to 11" in screen[screen.rindex("test over: measurement in motion.nc") :]
    assert "nan" not in screen


def test_what_became_no_record_is_told(tmp_path):
    places = written(tmp_path, PLAN)
    for text in ("nonsense", step(0).text().replace('"mean_strain": 0.0,', '"mean_strain": "large",')):
        places.record.write_text(f"{PLAN.text()}\n{text}\n")
        result = pdvc_bench("watch", places.file)
        assert result.exit_code == 2
        assert "line 2: expected a line of a record" in only_line(result)
