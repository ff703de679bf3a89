"""The commands that show a test while it runs: page, watch."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Annotated, Self

import typer

from validation.commands.parts import answering, tell

LAST_S = 1.0
"""How long a page beside a measurement outlives it."""

Followed = Annotated[
    Path, typer.Argument(metavar="FILE", help="The measurement that live was told to write, or its record.")
]


def page(
    file: Followed,
    host: Annotated[
        str, typer.Option("--host", metavar="ADDRESS", help="Where to be reached; 0.0.0.0: from other machines too.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, metavar="N", help="Where to be reached; 0: any that is free.")
    ] = 0,
    until_closed: Annotated[bool, typer.Option("--until-closed", hidden=True)] = False,
) -> None:
    """Show a test on a page while it runs, or afterwards, from its record and pictures alone.

    Prints the address to open. Other machines get in only where --host lets them, and only with the token in that
    address. The page may be opened late, and ended and started again, whatever live does.

    Example:  `pdvc-bench page out/motion.nc`
    """
    with answering(resume="the same command shows it again"):
        import asyncio

        from validation.view.page.server import serve
        from validation.view.places import find_places

        places = find_places(file)
        if until_closed:
            threading.Thread(target=_end_with_stdin, daemon=True).start()
        asyncio.run(serve(places, host, port, lambda url: print(url, flush=True)))


def watch(file: Followed) -> None:
    """Show a test in the terminal while it runs, from its record; ends when the whole test is measured.

    Where stdout is no terminal, its lines are printed as they come.

    Example:  `pdvc-bench watch out/motion.nc`
    """
    with answering(resume="the same command shows it again"):
        from rich.console import Console

        from validation.view import terminal
        from validation.view.places import find_places

        terminal.watch(find_places(file), Console())


def _end_with_stdin() -> None:
    """End this process once who started it has ended, however that came."""
    sys.stdin.buffer.read()
    # the record's last line, written just before, is still to be shown
    time.sleep(LAST_S)
    os._exit(0)


class PageBeside:
    """The page as a process of its own, which ends with what is done meanwhile."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._process: subprocess.Popen[bytes] | None = None
        self._tried = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            self._process.wait()

    def start(self) -> None:
        """Start it, unless it was tried before; its address is printed on stderr."""
        if self._tried:
            return
        self._tried = True
        # without it the measurement goes on
        try:
            command = [sys.executable, "-m", "pdvc_bench", "page", str(self._file), "--until-closed"]
            # in a session of its own: Ctrl-C is for this process, and ends the page by closing its stdin
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=2, start_new_session=True)
        except OSError as error:
            tell(f"no page: {error}")
