"""The entry point of the command line, pdvc-bench."""

from __future__ import annotations

import sys

from pdvc_bench import check_namesakes


def main() -> None:
    """Run the command line; where something hides one of our packages, say so in one line."""
    try:
        check_namesakes("pdvc", "simulator", "validation")
    except ImportError as error:
        sys.exit(f"error: {error}")
    from validation.cli import app

    app()


if __name__ == "__main__":
    main()
