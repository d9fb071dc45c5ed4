"""The fields of messages by their paths, of a batch of messages at once, or of each message for itself.

``Things`` are decoded messages: those of JSON and of encodings that aren't read as columns, those that drawings and
readers of packages take, and those of a batch in which some can't be read. ``Columns`` are messages that
``mcaptrack.columns`` reads. Both give the same values, so that a reader need not know which they are.

Letters: M messages, N things (messages, or members of lists in them), K members.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import nan
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
from mcap.well_known import MessageEncoding

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.log.messages import Payloads
from mcaptrack.sources.foreign.decoding import decoder_with_errors, number, text, time_of, unpacker
from mcaptrack.sources.foreign.definitions import MessageType
from mcaptrack.sources.foreign.flatten import UnreadMessages, column_reader, message_type_of, payload_decoder

if TYPE_CHECKING:
    import pyarrow as pa

T = TypeVar("T")
Path = tuple[str, ...]
#: The token of a list in a path, all members of which count; others, such as "[0]", stand for one member.
EACH: Final = "[]"
#: So many messages are read together, as columns and as objects: one that can't be read costs little, and few objects
#: are kept, which Python would look through again and again.
_COLUMNS, _OBJECTS = 1024, 32


class Things:
    """N decoded messages or members of lists, with their fields as attributes, and the values of these by path.

    Fields that are missing have no value; in protobuf, which leaves out zeros, they are 0.
    """

    def __init__(self, objects: Sequence[Any]) -> None:
        self._objects = objects

    def __len__(self) -> int:
        return len(self._objects)

    @property
    def single(self) -> Any:
        """The one message that these are, for those who read messages as objects."""
        (message,) = self._objects
        return message

    def has(self, path: Path) -> bool:
        """Whether there is such a field."""
        return any(value is not None for value in self.values(path))

    def is_set(self, path: Path) -> Bools:
        """Whether each thing has the field (N,): in protobuf and JSON it may be missing."""
        return np.array([_is_set(thing, path) for thing in self._objects], bool)

    def values(self, path: Path) -> list[Any]:
        """The values of a field (N,); None where it is missing."""
        if path and not any(token.startswith("[") for token in path):
            with suppress(AttributeError):  # all have it
                return list(map(attrgetter(".".join(path)), self._objects))
        return [_value(thing, path) for thing in self._objects]

    def numbers(self, path: Path) -> Floats:
        """The numbers of a field (N,); NaN where it is missing."""
        return np.array([number(value) for value in self.values(path)], np.float64)

    def stamps(self, path: Path) -> Ints:
        """The times of a field in ns (N,); 0 where it is missing, or a number without a unit.

        Raises ValueError if it holds no times.
        """
        out = []
        for thing, value in zip(self._objects, self.values(path), strict=True):
            if value is None and _value(thing, path[:-1]) is not None:
                raise AttributeError(name=path[-1])  # a head without a time
            out.append(0 if value is None or isinstance(value, int | float) else time_of(value))
        return np.array(out, np.int64)

    def members(self, path: Path) -> tuple[Ints, Things]:
        """The thing of each member of a list (K,), and the members. Its path ends with "[]"; () are the things."""
        if not path:
            return np.arange(len(self)), self
        lists = [() if value is None else value for value in self.values(path[:-1])]
        owner = np.repeat(np.arange(len(lists)), [len(each) for each in lists])
        return owner, Things([member for each in lists for member in each])

    def texts(self, path: Path) -> Any:
        """The texts of a field (N,); "" where it is missing."""
        return np.array(["" if value is None else text(value) for value in self.values(path)], object)

    def vectors(self, path: Path, names: str = "xyz") -> Floats:
        """Points, quaternions, or arrays of numbers (N, 3) or (N, 4); NaN where one of them, such as z, is missing."""
        parts = names if self.has((*path, "x")) else [f"[{place}]" for place in range(len(names))]
        return np.stack([self.numbers((*path, part)) for part in parts], axis=-1)


def _value(thing: Any, path: Path) -> Any:
    """The value at a path; None where JSON leaves it out, and for a member that a list doesn't have."""
    try:
        for token in path:
            thing = thing[int(token[1:-1] or 0)] if token.startswith("[") else getattr(thing, token)
    except (AttributeError, IndexError, TypeError):
        return None
    return thing


def _is_set(thing: Any, path: Path) -> bool:
    owner = _value(thing, path[:-1])
    return owner.HasField(path[-1]) if hasattr(owner, "HasField") else _value(owner, path[-1:]) is not None


class Columns(Things):
    """Things with columns as fields. ``unset`` is the number of fields that are missing, and not in a list."""

    def __init__(self, columns: Mapping[Path, pa.Array], count: int, unset: float) -> None:
        self._columns, self._count, self._unset = columns, count, unset

    def __len__(self) -> int:
        return self._count

    def has(self, path: Path) -> bool:
        return self._column(path) is not None or any(other[: len(path)] == path for other in self._columns)

    def is_set(self, path: Path) -> Bools:
        column = next((column for other, column in self._columns.items() if other[: len(path)] == path), None)
        if column is None:
            return np.zeros(self._count, bool)
        return np.asarray(column.is_valid().to_numpy(zero_copy_only=False))

    def values(self, path: Path) -> list[Any]:
        column = self._column(path)
        return [None] * self._count if column is None else column.to_pylist()

    def numbers(self, path: Path) -> Floats:
        import pyarrow as pa

        column = self._column(path)
        if column is None:
            return np.full(self._count, nan)
        if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
            return np.array([number(value) for value in column.to_pylist()], np.float64)
        if column.null_count and not any(token.startswith("[") for token in path):
            column = column.fill_null(self._unset)
        return np.asarray(column.to_numpy(zero_copy_only=False), np.float64)

    def stamps(self, path: Path) -> Ints:
        import pyarrow as pa

        column = self._column(path)
        if column is None and not self.has(path):
            return np.zeros(self._count, np.int64)
        if column is not None and (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
            return np.zeros(self._count, np.int64)
        if column is None or not pa.types.is_timestamp(column.type):
            raise ValueError(f"{'.'.join(path)} is no time")
        return np.asarray(column.cast(pa.int64()).fill_null(0).to_numpy())

    def members(self, path: Path) -> tuple[Ints, Things]:
        import pyarrow.compute as pc

        if not path:
            return np.arange(self._count), self
        lists = self._column(path[:-1])
        if lists is None:
            return np.arange(0), Things(())
        members = pc.list_flatten(lists)
        return np.asarray(pc.list_parent_indices(lists)), Columns(dict(_leaves(members, ())), len(members), self._unset)

    def _column(self, path: Path) -> pa.Array | None:
        """The column of a field; None if there is none."""
        import pyarrow as pa

        begin = next((place for place, token in enumerate(path) if token.startswith("[")), len(path))
        column = self._columns.get(path[:begin])
        if begin == len(path) or column is None or not pa.types.is_list(column.type):
            return column if begin == len(path) else None
        at = column.offsets.to_numpy().astype(np.int64)
        place = at[:-1] + int(path[begin][1:-1] or 0)
        members = column.values.take(pa.array(place, mask=place >= at[1:]))
        return Columns(dict(_leaves(members, ())), self._count, self._unset)._column(path[begin + 1 :])


def _leaves(column: pa.Array, path: Path) -> Iterator[tuple[Path, pa.Array]]:
    """The fields of structs, and of structs in them, by path; a column of anything else by itself."""
    import pyarrow as pa

    if not pa.types.is_struct(column.type):
        yield path, column
        return
    for field, inner in zip(column.type, column.flatten(), strict=True):
        yield from _leaves(inner, (*path, field.name))


class ChannelRead(NamedTuple, Generic[T]):
    """The log times of the messages of a channel (M,), what was read of some of them, each with their numbers, and
    those that can't be read.
    """

    log_ns: Ints
    parts: list[tuple[Ints, T]]
    unread: UnreadMessages


def read_channel(
    opened: log.Log, topic: str, read: Callable[[Things], T], paths: Collection[Path] = ()
) -> ChannelRead[T]:
    """Read the messages of a channel: those of a batch together, if ``paths`` says which fields are read, as columns
    where they can be. Others, and those of a batch in which some can't be read, are read each for itself.

    Raises McaptrackError, with topic and time, if messages of this type can't be read, or if none of them can.
    """
    unread = UnreadMessages(f"{opened.path}: {topic}", opened.channel(topic).messages)
    decode = payload_decoder(opened, topic, lambda kind: decoder_with_errors(kind, lambda one: read(Things([one]))))
    together, size = _reader_of_batches(message_type_of(opened, topic), paths)
    times, parts, done = [np.empty(0, np.int64)], list[tuple[Ints, T]](), 0
    for batch in _pieces(opened.payloads(topic), size):
        count, seen = len(batch.t_ns), len(parts)
        unread.count(count)
        if paths:
            with suppress(Exception):  # of bytes that are no such message: which one is found out one by one
                parts.append((np.arange(done, done + count), read(together(batch))))
        for at, (t_ns, payload) in enumerate(() if len(parts) > seen else _single_payloads(batch), done):
            try:
                parts.append((np.array([at]), decode(payload)))
            except McaptrackError as error:
                unread.add(t_ns, str(error))
        times.append(batch.t_ns)
        done += count
    return ChannelRead(np.concatenate(times), parts, unread)


def _reader_of_batches(kind: MessageType, paths: Collection[Path]) -> tuple[Callable[[Payloads], Things], int]:
    """A function that reads messages together, and how many."""
    reader = None
    if paths and kind.encoding != MessageEncoding.JSON:  # which has no types, and needs no Arrow
        with suppress(ValueError, McaptrackError):
            reader = column_reader(kind, _wanted(paths), True)
    if reader is None:
        unpack = unpacker(kind)
        return lambda batch: Things([unpack(payload) for _, payload in _single_payloads(batch)]), _OBJECTS
    unset = 0.0 if kind.encoding == MessageEncoding.Protobuf else nan
    return lambda batch: Columns(reader.read(batch.data, batch.start, batch.end), len(batch.t_ns), unset), _COLUMNS


def _pieces(batches: Iterable[Payloads], size: int) -> Iterator[Payloads]:
    """Batches of at most so many messages."""
    for batch in batches:
        for low in range(0, len(batch.t_ns), size):
            part = slice(low, low + size)
            t_ns, data, *places = batch
            yield Payloads(t_ns[part], data, *(column[part] for column in places))


def _single_payloads(batch: Payloads) -> Iterator[tuple[int, bytes]]:
    """Time and bytes of each message of a batch."""
    for t_ns, start, end in zip(batch.t_ns.tolist(), batch.start.tolist(), batch.end.tolist(), strict=True):
        yield t_ns, batch.data[start:end].tobytes()


#: The fields that say when and where a message was measured.
HEADS: Final = (("header",), ("timestamp",), ("frame_id",))


def heads(messages: Things) -> tuple[Ints, Any]:
    """Stamps in ns and frames of messages (M,): of their headers, or their own. Raises ValueError if they have none."""
    if messages.has(("header",)):
        return messages.stamps(("header", "stamp")), messages.texts(("header", "frame_id"))
    if messages.has(("timestamp",)):
        return messages.stamps(("timestamp",)), messages.texts(("frame_id",))
    raise ValueError("it has no stamp")


def _wanted(paths: Collection[Path]) -> Callable[[Path], bool]:
    """A function that says whether a field is at one of the paths, above or below it."""
    plain = {tuple(token for token in path if not token.startswith("[")) for path in paths}
    return lambda path: any(path[: len(other)] == other[: len(path)] for other in plain)
