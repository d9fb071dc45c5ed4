"""What threads of Delta's library print about a request that failed: the user sees one line instead, and all else."""

from __future__ import annotations

import os
import threading

import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Url
from mcaptrack.tables.delta.opening import reporting
from mcaptrack.tables.delta.quiet import without_panics
from tests.awaiting import until

#: As it was printed when a store refused a file of a table.
PANIC = b"""
thread 'tokio-rt-worker' (26881) panicked at /home/runner/.cargo/registry/src/object_store-0.13.2/src/buffered.rs:369:41:
Already shut down
stack backtrace:
   0: rust_begin_unwind
             at /rustc/library/std/src/panicking.rs:697:5
note: Some details are omitted, run with `RUST_BACKTRACE=full` for a verbose backtrace.
"""
WHERE = Url("s3://bucket/lake")


def printed(capfd: pytest.CaptureFixture[str]) -> str:
    return capfd.readouterr().err


@pytest.mark.parametrize("size", [1, 7, 64, 10_000])
def test_panics_are_left_out_and_all_else_is_passed_on(capfd, size):
    text = b"one\n\ntwo\n" + PANIC + PANIC + b"three\n\n" + PANIC + b"thread 'x' is fine\n\xff half a line"
    with pytest.raises(McaptrackError, match="can't be written"), reporting(WHERE, "written"):
        for start in range(0, len(text), size):
            os.write(2, text[start : start + size])
        raise OSError("no")
    assert printed(capfd) == "one\n\ntwo\nthree\n\nthread 'x' is fine\n\ufffd half a line"
    os.write(2, b"after\n" + PANIC)
    assert printed(capfd) == "after\n" + PANIC.decode()


def test_a_panic_that_leads_to_no_error_is_said(capfd):
    with reporting(WHERE, "written"):
        os.write(2, b"one\n" + PANIC + b"two\n")
    assert printed(capfd) == "one\ntwo\n" + PANIC.decode()


def test_a_progress_bar_is_passed_on_before_its_line_ends(capfd):
    with without_panics():
        os.write(2, b"\rhalf")
        said = until(lambda: printed(capfd))
    assert said == "\rhalf"


def test_threads_may_use_it_at_the_same_time(capfd):
    """Four tables are written at once; one of them fails."""
    both = threading.Barrier(2)

    def other() -> None:
        with without_panics():
            both.wait()
            os.write(2, b"other\n")
            both.wait()

    before = os.fstat(2).st_ino
    thread = threading.Thread(target=other)
    thread.start()
    with pytest.raises(McaptrackError), reporting(WHERE, "written"):
        both.wait()
        os.write(2, PANIC)
        raise OSError("no")
    both.wait()
    thread.join()
    assert printed(capfd) == "other\n"
    assert os.fstat(2).st_ino == before
