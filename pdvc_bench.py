"""The entry point of the command line, pdvc-bench, under a name that no user's folder has."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; where a folder of the same name hides one of our packages, say so in one line."""
    try:
        from pdvc.surroundings import check_namesakes

        check_namesakes("pdvc", "simulator", "validation")
    except ModuleNotFoundError:
        import pdvc

        print(
            f"error: pdvc: expected the package of pdvc-bench, found {pdvc.__path__}, which hides it", file=sys.stderr
        )
        sys.exit(1)
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    from validation.cli import app

    app()


if __name__ == "__main__":
    main()
