"""The page of a test while it runs: who gets what from its server, and what a browser shows of it."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing, suppress

import pytest
from tornado.httpclient import AsyncHTTPClient, HTTPResponse

from pdvc.record import Line, Record
from tests.browser import CHROMIUM, Browser
from tests.command_line import only_line, pdvc_bench
from tests.followed_tests import ALARM, LOST, OVER, PLAN, STEPS, TITLE, add, pictured, step, written
from validation.commands.watching import PageBeside
from validation.view.page.access import Access
from validation.view.page.server import serve
from validation.view.places import Places

PATIENCE_S = 10.0


@asynccontextmanager
async def served(places: Places, host: str = "127.0.0.1", port: int = 0) -> AsyncIterator[str]:
    """Serve a page meanwhile, at the address that is handed over."""
    url: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(serve(places, host, port, url.set_result))
    try:
        yield await asyncio.wait_for(url, PATIENCE_S)
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def get(url: str, **headers: str) -> HTTPResponse:
    return await AsyncHTTPClient().fetch(url, headers=headers, raise_error=False)


class Listener:
    """Reads server-sent events."""

    def __init__(self, reader: asyncio.StreamReader) -> None:
        self._reader = reader
        self.mark = ""

    async def next(self, *kinds: str) -> tuple[str, str]:
        """Return the next event of these kinds, and its data."""
        while True:
            event: dict[str, str] = {}
            while line := (await asyncio.wait_for(self._reader.readline(), PATIENCE_S)).decode().rstrip("\n"):
                key, _, value = line.partition(": ")
                event[key] = value
            self.mark = event.get("id", self.mark)
            if event["event"] in kinds:
                return event["event"], event["data"]

    async def lines(self, count: int) -> list[str]:
        return [(await self.next("line", "reset"))[1] for _ in range(count)]


@asynccontextmanager
async def listening(url: str, mark: str = "") -> AsyncIterator[Listener]:
    port = int(re.findall(r":(\d+)/", url)[0])
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    # HTTP 1.0: what comes is not cut into chunks
    resume = f"Last-Event-ID: {mark}\r\n" if mark else ""
    writer.write(f"GET /events HTTP/1.0\r\nHost: localhost\r\n{resume}\r\n".encode())
    head = (await reader.readuntil(b"\r\n\r\n")).decode()
    assert " 200 " in head
    assert "text/event-stream" in head
    try:
        yield Listener(reader)
    finally:
        writer.close()
        await writer.wait_closed()


def texts(*lines: Line) -> list[str]:
    return [line.text() for line in lines]


class TestEvents:
    def test_lines_come_as_they_are_added_and_half_a_line_waits(self, tmp_path):
        places = written(tmp_path, PLAN, step(0))

        async def main():
            async with served(places) as url, listening(url) as listener:
                assert await listener.lines(2) == texts(PLAN, step(0))
                add(places, step(1))
                assert await listener.lines(1) == texts(step(1))
                whole = step(2).text().encode() + b"\n"
                with places.record.open("ab", buffering=0) as file:
                    file.write(whole[:70])
                    for _ in range(2):
                        assert (await listener.next("line", "clock"))[0] == "clock"
                    file.write(whole[70:])
                assert await listener.lines(1) == texts(step(2))

        asyncio.run(main())

    def test_a_reader_that_was_cut_off_goes_on_after_the_last_line_that_it_had(self, tmp_path):
        places = written(tmp_path, PLAN, step(0), step(1))

        async def main():
            async with served(places) as url, listening(url) as listener:
                await listener.lines(2)
                mark = listener.mark
            # another server knows the mark too
            async with served(places) as url, listening(url, mark) as listener:
                assert await listener.lines(1) == texts(step(1))

        asyncio.run(main())

    @pytest.mark.parametrize("mark", ["nonsense", "1-2-3-4", "0-99999-1", "0-50-1", "-5--1-0", ""])
    def test_a_mark_of_another_record_begins_anew(self, tmp_path, mark):
        places = written(tmp_path / "other", PLAN, step(0, unix_s=2e9), step(1))

        async def main(mark):
            if not mark:
                async with served(places) as url, listening(url) as listener:
                    await listener.lines(2)
                    mark = listener.mark
            written(tmp_path, PLAN, step(0), step(1))
            async with served(Places(file=tmp_path / "motion.nc")) as url, listening(url, mark) as listener:
                assert await listener.next("line", "reset") == ("reset", "")
                assert await listener.lines(3) == texts(PLAN, step(0), step(1))

        asyncio.run(main(mark))

    def test_a_test_begun_anew_is_shown_from_its_beginning(self, tmp_path):
        places = written(tmp_path, PLAN, step(0), step(1))

        async def main():
            async with served(places) as url, listening(url) as listener:
                await listener.lines(3)
                places.record.unlink()
                assert await listener.next("line", "reset") == ("reset", "")
                add(places, PLAN)
                assert await listener.lines(1) == texts(PLAN)

        asyncio.run(main())

    def test_half_a_line_that_a_killed_process_left_is_never_shown(self, tmp_path):
        places = written(tmp_path, PLAN)

        async def main():
            async with served(places) as url, listening(url) as listener:
                await listener.lines(1)
                with places.record.open("ab") as file:
                    file.write(b'{"what": "st')
                assert (await listener.next("line", "reset", "clock"))[0] == "clock"
                with closing(Record(places.record)) as record:
                    record.add(step(0))
                assert await listener.lines(1) == texts(step(0))

        asyncio.run(main())

    def test_newest_pictures_are_told_and_sent(self, tmp_path):
        places = written(tmp_path, PLAN)

        async def main():
            async with served(places) as url, listening(url) as listener:
                pictured(places, tmp_path / "arriving", 4, 5, told=(ALARM,))
                told = {}
                while told.get("step") != 5:
                    told = json.loads((await listener.next("pictures"))[1])
                assert told["alarms"] == [5]
                for name in ("00005.radiograph", "00005.residual", "alarms/00005.residual"):
                    answer = await get(f"{url}pictures/{name}.png")
                    assert answer.headers["Content-Type"] == "image/png"
                    assert answer.body == (places.pictures / f"{name}.png").read_bytes()
                assert (await get(f"{url}pictures/00001.residual.png")).code == 404

        asyncio.run(main())


class TestAccess:
    def test_another_name_for_this_machine_is_refused(self, tmp_path):
        places = written(tmp_path, PLAN)

        async def main():
            async with served(places) as url:
                for name in ("localhost", "127.0.0.1:80", "[::1]:80"):
                    assert (await get(url, Host=name)).code == 200
                for name in ("[", "x@[::1", "a b"):
                    assert (await get(url, Host=name)).code in (400, 403)
                for name in ("example.org", "localhost.example.org", "127.0.0.1.example.org", "0.0.0.0"):
                    for path in ("", "events", "page.js", "pictures/00001.residual.png"):
                        assert (await get(url + path, Host=name)).code == 403

        asyncio.run(main())

    def test_from_other_machines_a_token_is_needed_and_then_a_cookie_does(self, tmp_path):
        places = written(tmp_path, PLAN)

        async def main():
            async with served(places, "0.0.0.0") as url:
                token, port = re.fullmatch(r"http://.+:(\d+)/\?token=(\S{22,})", url).group(2, 1)
                here = f"http://127.0.0.1:{port}/"
                for query in ("", "?token=", "?token=wrong", f"?token={token}x", f"?token={token[:-1]}"):
                    for path in ("", "page.js", "events", "colours.js"):
                        assert (await get(here + path + query)).code == 403
                opened = await get(f"{here}?token={token}", Host="lab.example.org")
                assert opened.code == 200
                cookie = opened.headers["Set-Cookie"]
                assert "HttpOnly" in cookie
                assert "SameSite=Strict" in cookie
                assert (await get(f"{here}page.js", Cookie=cookie.partition(";")[0])).code == 200
                assert (await get(f"{here}page.js", Cookie=cookie.partition("=")[0] + "=wrong")).code == 403

        asyncio.run(main())

    def test_each_page_has_a_token_of_its_own_and_this_machine_needs_none(self):
        assert Access.at("0.0.0.0").token != Access.at("0.0.0.0").token
        assert [Access.at(host).token for host in ("127.0.0.1", "localhost", "::1", "127.1.2.3")] == [""] * 4
        assert all(Access.at(host).token for host in ("", "::", "192.168.1.5", "lab", "10.0.0.1"))
        assert Access.at("::1").url(80) == "http://[::1]:80/"

    def test_nothing_but_the_page_is_served_and_nothing_foreign_is_loaded(self, tmp_path):
        places = written(tmp_path, PLAN)

        async def main():
            async with served(places) as url:
                for path in (
                    "",
                    "page.css",
                    "page.js",
                    "chart.js",
                    "figures.js",
                    "record.js",
                    "colours.js",
                    "icon.svg",
                ):
                    answer = await get(url + path)
                    assert answer.code == 200
                    assert answer.headers["Content-Security-Policy"].startswith("default-src 'self';")
                    assert answer.headers["X-Content-Type-Options"] == "nosniff"
                    assert "http" not in answer.body.decode().replace("http://www.w3.org/2000/svg", "")
                for path in ("server.py", "motion.nc.record.jsonl", "pictures/../motion.nc", "pictures/latest.json"):
                    assert (await get(url + path)).code == 404

        asyncio.run(main())


class TestCommand:
    @pytest.mark.parametrize("command", ["page", "watch"])
    def test_what_is_no_record_is_answered_in_one_line(self, tmp_path, command):
        result = pdvc_bench(command, tmp_path / "motion.nc")
        assert result.exit_code == 2
        assert "motion.nc.record.jsonl: expected the record of a test, found none" in only_line(result)
        for text, found in (
            ("not JSON\n", "line 1: expected a line of a record"),
            ("", "begins with a plan, found no whole line"),
            (step(0).text() + "\n", "begins with a plan, found a line of kind step"),
            (
                '{"what": "plan", "title": "", "steps": 9, "height_mm": 4.0, "voxel_mm": 1}\n',
                "line 1: expected a line of",
            ),
            ('{"what": "weather"}\n', "line 1: expected a line of a record"),
        ):
            (tmp_path / "motion.nc.record.jsonl").write_text(text)
            result = pdvc_bench(command, tmp_path / "motion.nc")
            assert result.exit_code == 2
            assert found in only_line(result)

    def test_an_address_that_is_taken_or_none_is_answered_in_one_line(self, tmp_path):
        places = written(tmp_path, PLAN)

        async def main():
            async with served(places) as url:
                return await asyncio.to_thread(pdvc_bench, "page", places.file, "--port", re.findall(r"\d+", url)[-1])

        taken = asyncio.run(main())
        assert taken.exit_code == 1
        assert re.fullmatch(r"error: 127.0.0.1: expected a free port, found \d+ in use", only_line(taken))
        for host in ("256.1.1.1", "192.0.2.1", ""):
            nowhere = pdvc_bench("page", places.file, "--host", host)
            assert nowhere.exit_code == 2
            assert f"error: --host: expected an address of this machine, found '{host}'" in only_line(nowhere)

    def test_it_prints_its_address_and_ends_with_ctrl_c(self, tmp_path):
        places = written(tmp_path, PLAN)
        command = [sys.executable, "-m", "pdvc_bench", "page", places.record]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            url = process.stdout.readline().strip()

            async def main():
                async with listening(url) as listener:
                    assert await listener.lines(1) == texts(PLAN)
                    # with somebody still looking
                    process.send_signal(signal.SIGINT)
                    return await asyncio.to_thread(process.communicate, timeout=PATIENCE_S)

            rest, error = asyncio.run(main())
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", url)
        assert not rest
        assert error == "interrupted; the same command shows it again\n"
        assert process.returncode == 130

    async def told_at_the_end(self, places, capfd) -> str:
        """Return the last line of which those who look at a page beside a measurement are told."""
        capfd.readouterr()
        with PageBeside(places.file) as page:
            page.start()
            url = ""
            while not url:
                url = capfd.readouterr().err
                await asyncio.sleep(0.02)
            async with listening(url) as listener:
                await listener.lines(1)
                add(places, OVER)
                ended = asyncio.create_task(asyncio.to_thread(page.__exit__, None, None, None))
                (last,) = await listener.lines(1)
                await ended
        return last

    def test_a_page_beside_a_measurement_ends_with_it_however_that_ends(self, tmp_path, capfd):
        places = written(tmp_path, PLAN)
        with PageBeside(places.file):
            pass  # one that was never asked for
        with PageBeside(places.file) as page:
            page.start()
            page.start()
            process = page._process
            assert process.poll() is None
        assert process.returncode == 0
        assert asyncio.run(self.told_at_the_end(places, capfd)) == OVER.text()
        code = (
            "import os, sys; from pathlib import Path; from validation.commands.watching import PageBeside\n"
            "with PageBeside(Path(sys.argv[1])) as page: page.start(); os.kill(os.getpid(), 9)"
        )
        killed = subprocess.run(
            [sys.executable, "-c", code, places.file], capture_output=True, text=True, check=False, timeout=60
        )
        # its stderr was inherited: to have read it to its end shows that the page has ended too
        assert killed.returncode == -signal.SIGKILL
        assert capfd.readouterr().out == ""


browser_needed = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on PATH: the page is not looked at")


@browser_needed
class TestInABrowser:
    def test_it_shows_a_test_from_its_first_radiograph_to_its_end(self, tmp_path):
        places = written(tmp_path, PLAN)
        server = Places(file=places.file)

        async def main():
            async with Browser(tmp_path / "profile") as browser:
                async with served(server) as url:
                    await browser.open(url)
                    await browser.wait_for(says("status", "waiting for the first radiograph"))
                    await browser.wait_for(f"{text('title')} === {json.dumps(TITLE)}")
                    now_s = await browser.ask("Date.now() / 1000")
                    add(places, *(step(t, now_s - 5) for t in range(6)))
                    pictured(places, tmp_path / "arriving", 4, 5, told=(ALARM,))
                    await browser.wait_for(says("status", "following"))
                    await shows_numbers(browser)
                    await browser.wait_for(loaded("radiograph"))
                    await browser.wait_for(loaded("residual"))
                    # a map of one colour would be an empty one
                    await browser.wait_for(f"{COLOURS} > 20")
                    assert await browser.ask("document.getElementById('banner').hidden")
                    add(places, ALARM, LOST)
                    await browser.wait_for(f"{text('banner')} === '⚠ ALARM crackstep 5: {ALARM.reason}'")
                    events = f"loststep 6: 00006.tif: expected 4 x 3 px⚠ crackstep 5: {ALARM.reason}"
                    await browser.wait_for(f"{text('events')} === {json.dumps(events)}")
                    await browser.wait_for(f"{all_of('.shots img', 'e.naturalWidth > 0')}.length === 2")
                    await browser.wait_for("document.title.startsWith('ALARM: ')")
                    port = int(url.rpartition(":")[2].strip("/"))
                # a page that is closed, and opened again at the same address
                await browser.wait_for(says("status", "connection lost: trying again"))
                await refused(port)
                add(places, *(step(t, now_s - 5) for t in range(7, STEPS)))
                async with served(server, port=port):
                    await browser.wait_for(says("step", str(STEPS - 1)))
                    await browser.wait_for("document.querySelectorAll('#events li').length === 2")
                    await browser.wait_for(says("status", "all radiographs are in: the whole test is being measured"))
                    add(places, OVER)
                    await browser.wait_for(says("status", "test over: measurement in motion.nc"))
                    complaints = [each for each in browser.complaints if "ERR_" not in each and "503" not in each]
                    assert not complaints

        asyncio.run(main())

    def test_radiographs_that_stay_away_are_noticed(self, tmp_path):
        places = written(tmp_path, PLAN, *(step(t) for t in range(4)))

        async def main():
            async with Browser(tmp_path / "profile") as browser, served(places) as url:
                await browser.open(url)
                await browser.wait_for(says("status", "no new radiograph for a while"))
                await browser.wait_for("document.body.dataset.state === 'late'")
                await browser.wait_for(says("since-unit", "days ago"))

        asyncio.run(main())

    @pytest.mark.parametrize("size", [(1600, 900), (1024, 768), (768, 1024), (390, 844)])
    def test_nothing_is_cut_off_on_a_desk_a_tablet_or_a_phone(self, tmp_path, size):
        places = written(tmp_path, PLAN, *(step(t, time.time() - 30) for t in range(5)), ALARM, LOST)
        pictured(places, tmp_path / "arriving", 4)

        async def main():
            async with Browser(tmp_path / "profile") as browser, served(places) as url:
                await browser.open(url, *size)
                await browser.wait_for(says("step", "4"))
                await browser.wait_for(loaded("residual"))
                assert await browser.ask("document.documentElement.scrollWidth <= window.innerWidth")
                assert await browser.ask(all_of("dt, dd, figcaption", "e.scrollWidth > e.clientWidth + 1")) == []
                if size[0] > 700:  # all at one glance
                    assert await browser.ask("document.documentElement.scrollHeight <= window.innerHeight")
                assert await browser.ask(all_of("main > figure canvas", "e.clientHeight < 100")) == []

        asyncio.run(main())


COLOURS = """(() => {
  const map = document.getElementById("map");
  const { data } = map.getContext("2d").getImageData(0, 0, map.width, map.height);
  return new Set(new Uint32Array(data.buffer)).size;
})()"""


def text(name: str) -> str:
    return f"document.getElementById('{name}').textContent"


def says(name: str, words: str) -> str:
    return f"{text(name)} === '{words}'"


def loaded(name: str) -> str:
    return f"document.getElementById('{name}').naturalWidth > 0"


async def refused(port: int) -> None:
    """Answer the page once with an error, as what stands between both may do: a browser gives up then."""
    asked = asyncio.Event()

    async def refuse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
        writer.close()
        await writer.wait_closed()
        asked.set()

    async with await asyncio.start_server(refuse, "127.0.0.1", port):
        await asyncio.wait_for(asked.wait(), PATIENCE_S)


def all_of(selector: str, condition: str) -> str:
    """Return the words of all elements e for which a condition holds."""
    return f"[...document.querySelectorAll('{selector}')].filter((e) => {condition}).map((e) => e.textContent)"


async def shows_numbers(browser: Browser) -> None:
    """Check the numbers of step 5: 0.5 % of 4 mm, with 1.96 standard deviations of 1e-4."""
    for name, shown in {
        "force": "300",
        "strain": "0.500",
        "strain-half": "± 0.020 %",
        "extension": "0.0200",
        "extension-half": "± 0.0008 mm",
        "step": "5",
        "usual": "usually 1.0 s",
        "work": "work 0.38 s, χ² 1.02",
        "time": "at 10.0 s, 36.0°",
    }.items():
        await browser.wait_for(f"{text(name)} === {json.dumps(shown)}")
