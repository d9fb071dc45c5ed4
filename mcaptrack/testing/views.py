"""The laws that hold for every judge, page and player of logs, and viewer on the web."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import unquote_plus

import numpy as np

from mcaptrack import log as logs
from mcaptrack import pipeline
from mcaptrack.api.options import PathLike, no_progress
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.registry import Entry, answer_of, blamed
from mcaptrack.sources.cameras import cameras
from mcaptrack.testing.formats import object_entry
from mcaptrack.testing.functions import function_entry, without_channels
from mcaptrack.testing.transforms import LawError, law, same_process, unchanged
from mcaptrack.viewing.serving import AS_MANY_AS_FIT, LogPage, WebViewer

T = TypeVar("T")
Judge = Callable[[list[Image], list[Image]], float]

#: Heights and widths of crops: of a person near and far, and of boxes at the border of a picture.
_CROPS: Final = ((120, 50), (24, 10), (3, 1), (1, 4))
#: Where a viewer gets a file from.
_ADDRESS: Final = "http://127.0.0.1:1/a b&c"
#: The largest size of a player, in megabytes.
_MAX_MB: Final = 16.0


def check_judge(judge: Judge, *, seed: int = 0) -> None:
    """Check a judge of ``review`` against the laws that hold for every one.

    The laws: its class is made without arguments; it gives a finite number for crops of any size, also for one on each
    side; the same crops give the same number, also after others, and are not changed; no other crops are likelier one
    person than the same ones on both sides; it leaves the process that it runs in as it was.

    Parameters
    ----------
    judge : callable
        The judge.
    seed : int, default 0
        Random seed of the crops.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from mcaptrack.testing import check_judge
    >>> class Alike:
    ...     def __call__(self, before, after):
    ...         means = [np.mean([crop.mean() for crop in side]) for side in (before, after)]
    ...         return 3.0 - abs(means[0] - means[1])
    >>> check_judge(Alike())
    """
    entry = object_entry("judge", judge, "__call__")
    with law("declares"):
        entry.made("__call__")
    rng = np.random.default_rng(seed)
    people = [
        [rng.integers(low, low + 90, (*size, 3)).astype(np.uint8) for size in sizes]
        for low, sizes in ((20, _CROPS), (140, _CROPS), (80, _CROPS[1:2]))
    ]
    kept = [[crop.tobytes() for crop in side] for side in people]
    pairs = [(before, after) for before in people for after in people]

    def ask() -> list[float]:
        with law("conforms"):
            return [_log_odds(entry, judge, *pair) for pair in pairs]

    with same_process(entry.name):
        first = ask()
        pairs.reverse()
        if ask()[::-1] != first:
            raise LawError("pure: the same crops give another number when others were compared before")
        if [[crop.tobytes() for crop in side] for side in people] != kept:
            raise LawError("pure: it changes its crops")
    likely = np.reshape(first, (len(people), -1))
    if (likely > np.diag(likely)[:, None] + 1e-6).any():
        raise LawError("sign: other crops are likelier one person than the same ones; it gives log odds that both are")


def _log_odds(entry: Entry, judge: Judge, before: list[Image], after: list[Image]) -> float:
    with blamed(entry, f"failed at {len(before)} and {len(after)} crops"):
        number = float(judge(before, after))
    if not np.isfinite(number):
        raise McaptrackError(f"{entry} gives {number} as log odds; give a finite number")
    return number


def check_page(function: Callable[[], LogPage], log: PathLike) -> None:
    """Check a page of ``view`` against the laws that hold for every one.

    The laws: it gives a ``LogPage``; its policy says what it may load; the same log gives the same page, in UTF-8, and
    is not changed; a log without channels gives a page, or McaptrackError; it leaves the process that it runs in as it
    was.

    Parameters
    ----------
    function : callable
        The function of the entry point.
    log : path
        A log that it is about.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from mcaptrack.testing import check_page
    >>> from mcaptrack.viewing.formatting import policy
    >>> from mcaptrack.viewing.serving import LogPage
    >>> check_page(lambda: LogPage(lambda opened: b"<p>" + opened.path.name.encode(), policy()), "log.mcap")
    """
    entry = function_entry("page", function)
    with _on_log(entry, log) as path:
        page = answer_of(entry, LogPage, "its function", function)
        _check_page(entry, page, path)
        _check_without_channels(entry, page.make)


def _check_page(entry: Entry, page: LogPage, path: Path) -> None:
    """Check the page of a log that has something to show."""
    if not (isinstance(page.policy, str) and page.policy.isprintable() and "default-src" in page.policy):
        raise LawError(
            f"declares: its policy, {page.policy!r:.60}, doesn't say what it may load: \"default-src 'none'\""
        )
    first, again = (_made_of(entry, page.make, path) for _ in range(2))
    if first != again:
        raise LawError("pure: the same log gives another page when it is made again")
    try:
        first.decode()
    except UnicodeDecodeError as error:
        raise LawError(f"conforms: its page is not in UTF-8: {error}") from None


def check_player(player: Any, log: PathLike) -> None:
    """Check a player of logs against the laws that hold for every one.

    The laws: its class is made without arguments, and has ``show`` and ``page``; ``show`` gives what notebooks can
    show, of all pictures and of a time, no larger than it may be; ``page`` gives a ``LogPage`` of each camera, for
    which the laws of pages hold; the same log gives the same, and is not changed; a log without channels is shown, or
    raises McaptrackError; it leaves the process that it runs in as it was.

    Parameters
    ----------
    player : object
        The player.
    log : path
        A log that it can show.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.
    """
    entry = object_entry("player", player, "show")
    with law("declares"):
        entry.made("show", "page")

    def html(opened: logs.Log, at_s: float | None = None) -> bytes:
        options = {"topics": (), "camera": None, "choice": AS_MANY_AS_FIT, "max_mb": _MAX_MB, "progress": no_progress}
        shown = player.show(opened, at_s, **options)
        has_bundle = hasattr(shown, "_repr_mimebundle_")
        return bytes((shown._repr_mimebundle_()["text/html"] if has_bundle else shown._repr_html_()).encode())

    with _on_log(entry, log) as path:
        with logs.read(path) as opened:
            middle_s = (opened.end_ns - opened.start_ns) / NS_PER_S / 2
            views = [(camera.prefix, False) for camera in cameras(opened)]
            views += [(prefix, True) for prefix, _ in views if pipeline.views_from_above(opened, prefix)]
        for at_s in (None, middle_s):
            first, again = (_made_of(entry, partial(html, at_s=at_s), path) for _ in range(2))
            if len(first) > _MAX_MB * 1e6:
                raise LawError(f"conforms: it takes {len(first) / 1e6:.1f} MB where `max_mb={_MAX_MB:g}` is the limit")
            if first != again:
                raise LawError("pure: the same log is shown in another way when it is shown again")
        for view in views:
            _check_page(entry, answer_of(entry, LogPage, "page", player.page, *view), path)
        _check_without_channels(entry, html)


def check_viewer(function: Callable[[], WebViewer], log: PathLike) -> None:
    """Check a viewer on the web against the laws that hold for every one.

    The laws: it gives a ``WebViewer``; its ``end`` is the end of names of files; it makes a file of this log; its link
    has the address of the file, escaped; of a log without channels it makes a file, raises McaptrackError, or says why
    it doesn't; it leaves the log, and the process that it runs in, as they were.

    Parameters
    ----------
    function : callable
        The function of the entry point.
    log : path
        A log that it can show.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.

    Examples
    --------
    >>> from urllib.parse import urlencode
    >>> from mcaptrack.testing import check_viewer
    >>> from mcaptrack.viewing.serving import WebViewer
    >>> def link(address):
    ...     return f"https://viewer.example/?{urlencode({'file': address})}"
    >>> def topics():
    ...     return WebViewer(".topics", lambda opened: " ".join(opened.channels).encode(), link, lambda opened: "")
    >>> check_viewer(topics, "log.mcap")
    """
    entry = function_entry("viewer", function)
    with _on_log(entry, log) as path:
        viewer = answer_of(entry, WebViewer, "its function", function)
        if not (isinstance(viewer.end, str) and re.fullmatch(r"\.[\w.-]+", viewer.end)):
            raise LawError(f"declares: its end is {viewer.end!r:.40}; it is the end of a name, as in '.rrd'")
        with logs.read(path) as opened:
            if why := answer_of(entry, str, "why_not", viewer.why_not, opened):
                raise LawError(f"conforms: it makes no file of this log: {why}")
        _made_of(entry, viewer.make, path)
        link = answer_of(entry, str, "link", viewer.link, _ADDRESS)
        if not re.match("https?://", link) or _ADDRESS not in unquote_plus(link) or "b&c" in link:
            raise LawError(
                f"conforms: its link to {_ADDRESS!r} is {link!r}; it has the address, escaped as by urlencode"
            )
        _check_without_channels(entry, lambda opened: b"" if viewer.why_not(opened) else viewer.make(opened))


@contextmanager
def _on_log(entry: Entry, log: PathLike) -> Iterator[Path]:
    """Check that this block leaves a log and the process as they were; a McaptrackError in it is a LawError."""
    with unchanged(log, "the log") as path, same_process(entry.name), law("conforms"):
        yield path


def _made_of(entry: Entry, make: Callable[[logs.Log], bytes], path: Path) -> bytes:
    with logs.read(path) as opened:
        return answer_of(entry, bytes, "make", make, opened)


def _check_without_channels(entry: Entry, make: Callable[[logs.Log], bytes]) -> None:
    with without_channels() as empty:
        try:
            _made_of(entry, make, empty)
        except McaptrackError as error:
            if not isinstance(error.__cause__, McaptrackError):
                raise LawError(f"empties: of a log without channels {error}; raise McaptrackError") from None
