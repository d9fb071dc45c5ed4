"""The ``mcaptrack`` command, and ``python -m mcaptrack``."""

import signal
import sys
from types import FrameType
from typing import TYPE_CHECKING, Final, NoReturn

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_SOON_S: Final = 0.01


def _terminated(number: int, _: object) -> NoReturn:
    """A polite kill leaves like Ctrl-C does: what is half written is removed."""
    raise SystemExit(128 + number)


def _once_more(unraisable: "UnraisableHookArgs") -> None:
    """A signal that came where Python raises nothing (a callback of the collector) comes again a moment later."""
    ignored = unraisable.exc_value
    if not isinstance(ignored, KeyboardInterrupt | SystemExit):
        sys.__unraisablehook__(unraisable)
        return

    def again(_: int, __: FrameType | None) -> NoReturn:
        raise ignored

    signal.signal(signal.SIGALRM, again)
    signal.setitimer(signal.ITIMER_REAL, _SOON_S)


def main() -> None:
    """Run the command line. Ctrl-C is exit 130 from the first moment on, also while modules are still being loaded."""
    signal.signal(signal.SIGTERM, _terminated)
    sys.unraisablehook = _once_more
    try:
        from mcaptrack.cli import app
        from mcaptrack.environment import hush_libraries

        hush_libraries()

        app()
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # whoever read our output has had enough
        sys.stderr.close()
        sys.exit(0)
    finally:
        # All is done: a signal during Python's own goodbye ends the process without a word.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            signal.signal(number, signal.SIG_DFL)


if __name__ == "__main__":
    main()
