"""Logs with something wrong in their structure: one of ``KINDS`` of damage at a place that a seed chooses."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable

import zstandard

Record = tuple[int, bytes]

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, DATA_END, FOOTER = 0x03, 0x04, 0x05, 0x06, 0x07, 0x0F, 0x02
NUMBERS = (0, 1, 2, 255, 2**15, 2**16 - 1, 2**31, 2**32 - 1, 2**32, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
TEXTS = (
    b"",
    b"\0",
    b"\n# x",
    b"\x1b[2J",
    b"/",
    b"..",
    b"\xff\xfe",
    "\u202e\u0000ü".encode(),
    b"a" * 70_000,
    b"/camera/tracks",
)


def split(data: bytes) -> list[Record]:
    """The records of a whole log, or of the content of a chunk."""
    at, end = (8, len(data) - 8) if data.startswith(MAGIC) else (0, len(data))
    found = []
    while at < end:
        opcode, size = struct.unpack_from("<BQ", data, at)
        found.append((opcode, data[at + 9 : at + 9 + size]))
        at += 9 + size
    return found


def joined(records: list[Record]) -> bytes:
    return b"".join(struct.pack("<BQ", opcode, len(body)) + body for opcode, body in records)


def content(body: bytes) -> bytes:
    length = struct.unpack_from("<I", body, 28)[0]
    data = body[32 + length + 8 :]
    return zstandard.decompress(data) if length else data


def chunk(body: bytes, data: bytes) -> Record:
    """A chunk with other content and the right checksum, uncompressed, its times as they were."""
    head = body[:16] + struct.pack("<QII", len(data), zlib.crc32(data), 0)
    return CHUNK, head + struct.pack("<Q", len(data)) + data


def without_summary(records: list[Record]) -> bytes:
    """A log of the records of a data section, without indexes: readers have to look into everything."""
    kept = [record for record in records if record[0] != INDEX]
    return MAGIC + joined([*kept, (DATA_END, bytes(4)), (FOOTER, bytes(20))]) + MAGIC


def parts(data: bytes) -> tuple[list[Record], list[Record]]:
    """The data section without its end, and the summary with its footer."""
    records = split(data)
    end = next(place for place, record in enumerate(records) if record[0] == DATA_END)
    return records[:end], records[end + 1 :]


def poke(chance: random.Random, data: bytes, first: int = 64) -> bytes:
    """A number near the beginning is another."""
    size = chance.choice([1, 2, 4, 8])
    number = chance.choice(NUMBERS) % 256**size
    at = chance.randrange(max(min(len(data), first) - size + 1, 1))
    return data[:at] + number.to_bytes(size, "little") + data[at + size :]


def flipped(chance: random.Random, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(chance.randint(1, 8)):
        out[chance.randrange(len(out))] ^= 1 << chance.randrange(8)
    return bytes(out)


def lengths(chance: random.Random, data: bytes) -> bytes:
    """A record says that it is of another length."""
    records = split(data)
    place = chance.randrange(len(records))
    at = 8 + len(joined(records[:place])) + 1
    size = len(records[place][1])
    said = chance.choice([*NUMBERS, size + 1, max(size - 1, 0), size + 9]) % 2**64
    return data[:at] + said.to_bytes(8, "little") + data[at + 8 :]


def opcodes(chance: random.Random, data: bytes) -> bytes:
    records = split(data)
    at = 8 + len(joined(records[: chance.randrange(len(records))]))
    return data[:at] + bytes([chance.choice([0, *range(1, 16), 0x7F, 0x80, 0xFF])]) + data[at + 1 :]


def fields(chance: random.Random, data: bytes) -> bytes:
    """A number in a record of the data section; the summary and its places stay right."""
    records = split(data)
    place = chance.randrange(len(records))
    records[place] = (records[place][0], poke(chance, records[place][1]))
    return MAGIC + joined(records) + MAGIC


def moved(chance: random.Random, data: bytes) -> bytes:
    """Records of the data section twice, gone, or in another order; the summary says what it said."""
    first, last = parts(data)
    deed, place, other = chance.choice(["twice", "gone", "order"]), *(chance.randrange(len(first)) for _ in range(2))
    if deed == "twice":
        first.insert(other, first[place])
    elif deed == "gone":
        del first[place]
    else:
        first[place], first[other] = first[other], first[place]
    return MAGIC + joined([*first, (DATA_END, bytes(4)), *last]) + MAGIC


def cut(chance: random.Random, data: bytes) -> bytes:
    return data[: chance.randrange(1, len(data))]


def appended(chance: random.Random, data: bytes) -> bytes:
    return data + chance.choice([data, data[: len(data) // 2], bytes(100), MAGIC])


def summaries(chance: random.Random, data: bytes) -> bytes:
    """A number in the summary, under the right checksum."""
    first, last = parts(data)
    place = chance.randrange(len(last))
    last[place] = (last[place][0], poke(chance, last[place][1]))
    head = struct.pack("<BQ", FOOTER, 20) + last[-1][1][:16]
    crc = zlib.crc32(joined(last[:-1]) + head)
    last[-1] = (FOOTER, last[-1][1][:16] + struct.pack("<I", crc))
    return MAGIC + joined([*first, (DATA_END, bytes(4)), *last]) + MAGIC


def inside(change: Callable[[random.Random, list[Record]], None]) -> Callable[[random.Random, bytes], bytes]:
    """Another content of one chunk, under the right checksum."""

    def made(chance: random.Random, data: bytes) -> bytes:
        records, _ = parts(data)
        place = chance.choice([n for n, record in enumerate(records) if record[0] == CHUNK])
        body = records[place][1]
        inner = split(content(body))
        change(chance, inner)
        records[place] = chunk(body, joined(inner))
        return without_summary(records)

    return made


def _one(chance: random.Random, records: list[Record], *opcodes: int) -> int:
    return chance.choice([n for n, record in enumerate(records) if record[0] in opcodes] or [0])


def times(chance: random.Random, records: list[Record]) -> None:
    """Messages at times that are far away, from one on."""
    first = _one(chance, records, MESSAGE)
    t_ns = chance.choice(NUMBERS[9:])
    for place, (opcode, body) in enumerate(records):
        if opcode == MESSAGE and place >= first:
            records[place] = (opcode, body[:6] + struct.pack("<Q", t_ns) + body[14:])


def payloads(chance: random.Random, records: list[Record]) -> None:
    place = _one(chance, records, MESSAGE)
    opcode, body = records[place]
    payload = chance.choice([flipped, poke, cut])(chance, body[22:] or b"x")
    records[place] = (opcode, body[:22] + payload)


def heads(chance: random.Random, records: list[Record]) -> None:
    place = _one(chance, records, MESSAGE)
    records[place] = (records[place][0], poke(chance, records[place][1], 22))


def descriptions(chance: random.Random, records: list[Record]) -> None:
    """A text of a schema or channel is another; or a number in it, or bits."""
    place = _one(chance, records, SCHEMA, CHANNEL)
    opcode, body = records[place]
    first = 2 if opcode == SCHEMA else 4
    size = struct.unpack_from("<I", body, first)[0]
    text = chance.choice(TEXTS)
    records[place] = chance.choice(
        [
            (opcode, body[:first] + struct.pack("<I", len(text)) + text + body[first + 4 + size :]),
            (opcode, poke(chance, body)),
            (opcode, flipped(chance, body)),
        ]
    )


KINDS: dict[str, Callable[[random.Random, bytes], bytes]] = {
    "bits": flipped, "lengths": lengths, "opcodes": opcodes, "fields": fields, "moved": moved, "cut": cut,
    "appended": appended, "summaries": summaries, "times": inside(times), "payloads": inside(payloads),
    "heads": inside(heads), "descriptions": inside(descriptions),
}  # fmt: skip


def mutant(seed: int, whole: bytes) -> tuple[str, bytes]:
    """Which kind of damage, and the damaged log."""
    chance = random.Random(seed)
    kind = list(KINDS)[seed % len(KINDS)]
    return kind, KINDS[kind](chance, whole)
