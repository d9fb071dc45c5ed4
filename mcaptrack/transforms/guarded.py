"""Run a transform of another package: its errors become one line that names it, and its output is checked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.registry import Entry, failure
from mcaptrack.schema import Frame
from mcaptrack.transforms.protocol import Transform


def guarded(entry: Entry, transform: Transform, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
    """Run a transform and check each of its outputs.

    Parameters
    ----------
    entry : Entry
        The transform in the registry, to name it in errors.
    transform : Transform
    frames : iterable of Frame
        Its input.

    Yields
    ------
    tuple of Frame

    Raises
    ------
    McaptrackError
        If the transform raises an exception, or yields anything but a tuple of frames with the rows of its schemas, in
        order of time. The message names the transform and the frame. Exceptions of ``frames`` are passed on unchanged.
    """
    source = _Source(frames)
    try:
        made = iter(transform(source))
    except Exception as error:
        raise source.error_of(entry, error) from error
    last_ns: int | None = None
    while True:
        try:
            result = next(made)
        except StopIteration:
            return
        except Exception as error:
            raise source.error_of(entry, error) from error
        yield _checked(entry, transform, result, last_ns, source.where)
        last_ns = result[0].t_ns if result else last_ns


class _Source:
    """The input of a transform: notes which frame was taken last, and which exception the input raised."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames = iter(frames)
        self._error: BaseException | None = None
        self.where = "before the first frame"

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        try:
            frame = next(self._frames)
        except StopIteration:
            raise
        except BaseException as error:
            self._error = error
            raise
        self.where = f"at frame {frame.index} ({frame.t_ns} ns)"
        return frame

    def error_of(self, entry: Entry, error: Exception) -> Exception:
        """An exception of the input as it is; one of the transform as an error that names the transform."""
        if error is self._error:
            return error
        if isinstance(error, McaptrackError):
            return McaptrackError(f"{entry}: {error}")
        return failure(entry, f"failed {self.where}", error)


def _checked(entry: Entry, transform: Transform, result: object, last_ns: int | None, where: str) -> tuple[Frame, ...]:
    """The frames that a transform yielded. Raises McaptrackError if they are not as its schemas demand."""
    schemas = list(transform.writes.values())
    # A Frame is a tuple itself; to yield one without a tuple around it is a common mistake.
    frames = result if isinstance(result, tuple) and not isinstance(result, Frame) else None
    if frames is None or len(frames) != len(schemas) or not all(isinstance(one, Frame) for one in frames):
        gave = f"a {type(result).__name__}" if frames is None else f"a tuple of {len(frames)}"
        wanted = f"a tuple with a Frame for each of its outputs ({len(schemas)})"
        raise McaptrackError(f"{entry} gave {gave} {where}; it has to yield {wanted}")
    for frame, schema in zip(frames, schemas, strict=True):
        if not isinstance(frame.t_ns, int | np.integer) or not isinstance(frame.index, int | np.integer):
            raise McaptrackError(f"{entry} gave a frame {where} with a t_ns or index that is no integer")
        if last_ns is not None and frame.t_ns < last_ns:
            raise McaptrackError(f"{entry} gave a frame of {frame.t_ns} ns {where}, after one of {last_ns} ns")
        if not isinstance(frame.rows, np.ndarray):
            raise McaptrackError(f"{entry} gave rows {where} that are a {type(frame.rows).__name__}, no NumPy array")
        try:
            schema.check(frame.rows)
        except ValueError as error:
            raise McaptrackError(f"{entry} gave rows {where} that are wrong: {error}") from None
    return frames
