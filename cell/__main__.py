"""`python -m cell`, and the command `cell`: Ctrl-C prints one line and exits with 130."""

import signal
import sys


def main() -> None:
    """Entry point of the console script."""
    try:
        from cell.cli import main as command  # takes a while, in which one may change one's mind

        command()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(128 + signal.SIGINT) from None


if __name__ == "__main__":
    main()
