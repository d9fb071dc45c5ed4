"""The ``mcaptrack`` command, and ``python -m mcaptrack``."""

import signal
import sys
from types import FrameType
from typing import TYPE_CHECKING, Final, NoReturn

from mcaptrack.streams import LostOutputError, open_streams

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_SOON_S: Final = 0.01
#: Windows has none.
_HANGUP: Final = getattr(signal, "SIGHUP", None)


#: The signals that ended this command.
_RECEIVED: Final[list[int]] = []


def _end(number: int, _: object) -> NoReturn:
    """Unwind, so that what is half written is removed: on Ctrl-C, and on a polite kill as well."""
    _RECEIVED.append(number)
    raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)


def _once_more(unraisable: "UnraisableHookArgs") -> None:
    """A signal that came where Python raises nothing (a callback of the collector) comes again a moment later."""
    ignored = unraisable.exc_value
    if not isinstance(ignored, KeyboardInterrupt | SystemExit):
        sys.__unraisablehook__(unraisable)
        return

    def again(_: int, where: FrameType | None) -> None:
        while where is not None and where.f_code is not _once_more.__code__:
            where = where.f_back
        if where is None:  # otherwise still here, where it would be ignored, too
            signal.setitimer(signal.ITIMER_REAL, 0)
            raise ignored

    signal.signal(signal.SIGALRM, again)
    # Repeated, because one that comes just before a wait in C begins is noted only when the wait ends.
    signal.setitimer(signal.ITIMER_REAL, _SOON_S, 10 * _SOON_S)


def main() -> None:
    """Run the command line. Ctrl-C is exit 130 from the first moment on, also while modules are still being loaded."""
    signal.signal(signal.SIGTERM, _end)
    if _HANGUP is not None and signal.getsignal(_HANGUP) is signal.SIG_DFL:  # a terminal that is closed; not with nohup
        signal.signal(_HANGUP, _end)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where the caller ignores it
        signal.signal(signal.SIGINT, _end)
    sys.unraisablehook = _once_more
    open_streams()
    try:
        from mcaptrack.cli import app
        from mcaptrack.environment import set_up_libraries

        set_up_libraries()
        try:
            app()
        except SystemExit:
            sys.stdout.flush()  # output that is lost here makes the exit code 1
            raise
    except BrokenPipeError:  # whoever read our output has had enough
        sys.exit(1)
    except LostOutputError as error:
        from mcaptrack.cli.text import say

        say(str(error), "error")
        sys.exit(1)
    except BaseException as error:
        # Libraries turn a signal into errors of their own: one in the middle of an import becomes an ImportError.
        if _RECEIVED and not (isinstance(error, SystemExit) and error.code in (0, None)):
            sys.exit(128 + _RECEIVED[0])
        raise
    finally:
        # All is done: a signal during Python's own goodbye ends the process without a word.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM, _HANGUP):
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)


if __name__ == "__main__":
    main()
