"""Messages of a log in the types of the ``mcap`` package, decoded by its decoder factories or by their definitions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from hashlib import blake2b
from typing import Any, NamedTuple

from mcap.decoder import DecoderFactory
from mcap.exceptions import DecoderNotFoundError
from mcap.records import Channel, Message, Schema

from mcaptrack.errors import McaptrackError
from mcaptrack.log import Log
from mcaptrack.sources.foreign.definitions import MessageType, is_defined
from mcaptrack.sources.foreign.flatten import message_type_of, recorded_decoder

Decode = Callable[[bytes], Any]


class DecodedMessage(NamedTuple):
    """A message of a log, in the types of the ``mcap`` package.

    Attributes
    ----------
    schema : mcap.records.Schema or None
        What its payload is; None for a channel without a schema.
    channel : mcap.records.Channel
        Its topic, the encoding of its payload, and the metadata of the channel.
    message : mcap.records.Message
        ``log_time`` and ``publish_time`` in nanoseconds, ``sequence``, and ``data``: its payload as it was recorded.
    decoded : object
        Its payload decoded; None with ``decode=False``.

    """

    schema: Schema | None
    channel: Channel
    message: Message
    decoded: Any

    @property
    def decoded_message(self) -> object:
        """The same as ``decoded``, by its name in the tuples of ``mcap.reader``."""
        return self.decoded


class NoDecoderError(McaptrackError, DecoderNotFoundError):
    """A message that neither a decoder factory nor mcaptrack decodes."""


def decoded_messages(
    opened: Log,
    topics: Collection[str],
    start_ns: int | None,
    end_ns: int | None,
    *,
    factories: Iterable[DecoderFactory],
    decode: bool,
    reverse: bool,
) -> Iterator[DecodedMessage]:
    """Yield the messages of an open log; see ``Recording.messages``."""
    decoders: dict[int, Decode] = {}
    for schema, channel, message in opened.records(topics, start_ns, end_ns, reverse=reverse):
        if not decode:
            yield DecodedMessage(schema, channel, message, None)
            continue
        decoder = decoders.get(channel.id)
        try:
            if decoder is None:
                decoder = decoders[channel.id] = _decoder(opened, schema, channel, factories)
            decoded = decoder(message.data)
        except McaptrackError as error:
            where = f"{opened.path}: {channel.topic} at {message.log_time} ns"
            raise type(error)(f"{where}: {error}; `decode=False` leaves messages as they are") from None
        yield DecodedMessage(schema, channel, message, decoded)


def checked_factories(factories: Any) -> tuple[DecoderFactory, ...]:
    """Return decoder factories as a tuple. Raises McaptrackError for anything else, such as their classes."""
    several = isinstance(factories, Iterable) and not isinstance(factories, type)
    given: tuple[Any, ...] = tuple(factories) if several else (factories,)
    for factory in given:
        if isinstance(factory, type) or not callable(getattr(factory, "decoder_for", None)):
            raise McaptrackError(
                "`decoder_factories=` has decoder factories of the mcap package, such as "
                f"[mcap_ros2.decoder.DecoderFactory()], not {factory!r:.60}"
            )
    return given


def _decoder(opened: Log, schema: Schema | None, channel: Channel, factories: Iterable[DecoderFactory]) -> Decode:
    """The decoder of a channel: of the first factory that has one, or by the definition in the log."""
    for factory in factories:
        decoder = factory.decoder_for(channel.message_encoding, _with_own_id(schema))
        if decoder is not None:
            return decoder
    fields = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
    kind = MessageType(*fields, channel.message_encoding)
    try:
        return recorded_decoder(kind if is_defined(kind) else message_type_of(opened, channel.topic))
    except McaptrackError as error:
        raise NoDecoderError(f"{error}; `decoder_factories=` takes decoders of the mcap package") from None


def _with_own_id(schema: Schema | None) -> Schema | None:
    """Return a schema with an id that no other has in any log: factories keep decoders by the ids of schemas."""
    if schema is None:
        return None
    digest = blake2b(repr((schema.name, schema.encoding, schema.data)).encode(), digest_size=8)
    return replace(schema, id=int.from_bytes(digest.digest(), "little"))
