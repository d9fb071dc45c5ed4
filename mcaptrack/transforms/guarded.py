"""Run a transform of another package: its errors become one line that names it, and its output is checked.

What it changes in this process is undone after each step (see ``mcaptrack.registry.guard``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.registry import Entry, failure, is_interruption
from mcaptrack.registry.guard import Guard
from mcaptrack.schema import SCORES_MAPPED, SIGHTINGS, Frame, Schema
from mcaptrack.schema.impossible import first_impossible
from mcaptrack.transforms.protocol import Transform, traits_of

#: Kinds with a main output of one frame for each frame that is read, at its time and with its number.
_ONE_FOR_EACH: Final = ("detector", "tracker", "fuser")
#: Above the largest time in nanoseconds, and above the largest frame number, that a log can hold.
_END_NS, _END_INDEX = 2**63, 2**32
#: Marks the end of a transform's output.
_END: Final = object()


def guarded(
    entry: Entry, transform: Transform, frames: Iterable[Frame], guard: Guard | None = None
) -> Iterator[tuple[Frame, ...]]:
    """Run a transform and check each of its outputs; one of our own is run as it is.

    Parameters
    ----------
    entry : Entry
        The transform in the registry, to name it in errors.
    transform : Transform
    frames : iterable of Frame
        Its input.
    guard : Guard, optional
        Keeps what it changes in this process; by default this becomes a warning.

    Yields
    ------
    tuple of Frame

    Raises
    ------
    McaptrackError
        If the transform raises an exception, or yields anything but a tuple of frames with the rows of its schemas, in
        order of time; also if a detector or tracker yields a frame that was not in its input. The message names the
        transform and the frame. Exceptions of ``frames`` are passed on unchanged.
    """
    if entry.is_built_in:
        yield from transform(frames)
        return
    if guard is None:
        guard = Guard(str(entry))
        try:
            yield from guarded(entry, transform, frames, guard)
        finally:
            guard.end()
        return
    source = _Source(frames, traits_of(transform).passes, guard)
    try:
        with guard.step():
            outputs = iter(transform(source))
    except BaseException as error:  # code of other packages may raise anything
        raise source.error_of(entry, error) from error
    last_ns: int | None = None
    low, high, reach = 0.0, 1.0, 0.0
    while True:
        try:
            with guard.step():
                result = next(outputs, _END)
        except BaseException as error:
            raise source.error_of(entry, error) from error
        if result is _END:
            break
        checked = _checked(entry, transform, result, last_ns, source.where)
        main = checked[list(transform.writes).index("")]
        if entry.kind in _ONE_FOR_EACH and not source.answered(main):
            raise McaptrackError(
                f"{entry} gave frame {main.index} of {main.t_ns} ns {source.where}, which is not in its input or was "
                "given before; it has to yield one frame for each, with the same t_ns and index"
            )
        if entry.kind == "detector":
            reach = float(np.fmax.reduce(main.rows["x_px"] + main.rows["w_px"], initial=reach))
        for frame in checked:
            if "score" in (frame.rows.dtype.names or ()) and len(frame.rows):
                low = float(np.fmin.reduce(frame.rows["score"], initial=low))
                high = float(np.fmax.reduce(frame.rows["score"], initial=high))
        yield checked
        last_ns = checked[0].t_ns
    if low < 0 or high > 1:
        warn(f"{entry} gave scores from {low:g} to {high:g}; {SCORES_MAPPED}", "scores")
    if 0 < reach <= 1:
        warn(
            f"{entry} gave boxes that all lie within one pixel; they are in pixels, not in shares of a picture", "units"
        )
    if entry.kind in _ONE_FOR_EACH and (missing := source.unanswered()):
        warn(
            f"{entry} gave no frame for {missing} of {source.count}; a frame without rows says that nothing was there, "
            "a missing frame does not",
            "left-out",
        )


class _Source:
    """The input of a transform: notes the frames that were taken and not answered, and an exception of the input."""

    def __init__(self, frames: Iterable[Frame], passes: int, guard: Guard) -> None:
        self._all, self._passes, self._guard = frames, passes, guard
        self._frames = iter(frames)
        self._is_begun = False
        self._error: BaseException | None = None
        self._open: Counter[tuple[int, int]] = Counter()
        self.count = 0
        self.where = "before the first frame"

    def __iter__(self) -> Iterator[Frame]:
        if self._passes == 1:
            return self
        if self._is_begun:
            self._frames = iter(self._all)
            self._is_begun, self.count = False, 0
            self._open.clear()
        return iter(self.__next__, None)  # another object: transforms refuse what can be read only once

    def __next__(self) -> Frame:
        self._is_begun = True
        try:
            with self._guard.pause():  # the input is not its code
                frame = next(self._frames, None)
        except BaseException as error:
            self._error = error
            raise
        if frame is None:
            raise StopIteration
        self.where = f"at frame {frame.index} ({frame.t_ns} ns)"
        self._open[frame.t_ns, frame.index] += 1
        self.count += 1
        return frame

    def answered(self, frame: Frame) -> bool:
        """Note the output for a frame. Returns whether the frame was taken from the input and not answered before."""
        key = frame.t_ns, frame.index
        if not self._open[key]:
            return False
        self._open[key] -= 1
        if not self._open[key]:
            del self._open[key]
        return True

    def unanswered(self) -> int:
        """The number of frames that were taken and not answered."""
        return self._open.total()

    def error_of(self, entry: Entry, error: BaseException) -> BaseException:
        """An exception of the input, or an interruption, as it is; another one as an error that names the transform."""
        if error is self._error or is_interruption(error):
            return error
        return failure(entry, f"failed {self.where}", error)


def _checked(entry: Entry, transform: Transform, result: object, last_ns: int | None, where: str) -> tuple[Frame, ...]:
    """The frames that a transform yielded. Raises McaptrackError if they are not as its schemas demand."""
    schemas = list(transform.writes.values())
    # A Frame is a tuple itself; to yield one without a tuple around it is a common mistake.
    frames = result if isinstance(result, tuple) and not isinstance(result, Frame) else None
    if frames is None or len(frames) != len(schemas) or not all(isinstance(frame, Frame) for frame in frames):
        gave = f"a {type(result).__name__}"
        if frames is not None:
            gave = f"a tuple of {', '.join(type(value).__name__ for value in frames) or 'nothing'}"
        wanted = f"a tuple with a Frame for each of its outputs ({len(schemas)})"
        raise McaptrackError(f"{entry} gave {gave} {where}; it has to yield {wanted}")
    checked = tuple(
        _checked_frame(entry, frame, schema, last_ns, where) for frame, schema in zip(frames, schemas, strict=True)
    )
    joined = len(checked[list(transform.writes).index("")].rows)
    for frame, schema in zip(checked, schemas, strict=True):
        if schema is SIGHTINGS and (frame.rows["detection"] >= joined).any():
            last = frame.rows["detection"].max()
            raise McaptrackError(f"{entry} gave sightings {where} of detection {last}; it gave {joined}, from 0 on")
    return checked


def _checked_frame(entry: Entry, frame: Frame, schema: Schema, last_ns: int | None, where: str) -> Frame:
    """A frame with numbers of Python and rows of its own in the layout of the schema: it may be kept, and written."""
    if not isinstance(frame.t_ns, int | np.integer) or not isinstance(frame.index, int | np.integer):
        raise McaptrackError(f"{entry} gave a frame {where} with a t_ns or index that is no whole number")
    t_ns, index = int(frame.t_ns), int(frame.index)
    if not (0 <= t_ns < _END_NS and 0 <= index < _END_INDEX):
        raise McaptrackError(f"{entry} gave frame {index} of {t_ns} ns {where}; a log holds no such time or number")
    if last_ns is not None and t_ns < last_ns:
        raise McaptrackError(f"{entry} gave a frame of {t_ns} ns {where}, after one of {last_ns} ns")
    if not isinstance(frame.rows, np.ndarray):
        raise McaptrackError(f"{entry} gave rows {where} that are a {type(frame.rows).__name__}, no NumPy array")
    try:
        rows = schema.check(frame.rows)
        rows = schema.rows(**{name: rows[name] for name in schema.dtype.names or ()})
    except ValueError as error:
        raise McaptrackError(f"{entry} gave rows {where} that are wrong: {error}") from None
    if fault := first_impossible(schema, rows):
        row, problem = fault
        raise McaptrackError(f"{entry} gave rows {where} that are wrong: in row {row} {problem}")
    return Frame(t_ns, index, rows)
