"""The ``mcaptrack`` command, and ``python -m mcaptrack``."""

import signal
import sys
from typing import NoReturn


def _terminated(number: int, _: object) -> NoReturn:
    """A polite kill leaves like Ctrl-C does: what is half written is removed."""
    raise SystemExit(128 + number)


def main() -> None:
    """Run the command line. Ctrl-C is exit 130 from the first moment on, also while modules are still being loaded."""
    signal.signal(signal.SIGTERM, _terminated)
    try:
        from mcaptrack.cli import app

        app()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # whoever read our output has had enough
        sys.stderr.close()
        sys.exit(0)
    finally:
        # All is done: a signal during Python's own goodbye ends the process without a word.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)


if __name__ == "__main__":
    main()
