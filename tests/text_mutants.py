"""Label files and settings with something wrong in them: one to three faults that a seed chooses."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial

FRAMES = range(1, 21)
#: A whole file of every kind, by the name that it gets. All labels are of one who walks to the right.
WHOLE: dict[str, str] = {
    "mot.txt": "".join(f"{k},1,{20 + 3 * k},40,20,50,1,1,1\n" for k in FRAMES),
    "kitti.txt": "".join(
        f"{k} 1 Pedestrian 0 0 -1.5 {20 + 3 * k} 40 {40 + 3 * k} 90 1.7 0.5 0.5 1 1 9 0\n" for k in FRAMES
    ),
    "annotations.txt": "".join(f'1 {20 + 3 * k} 40 {40 + 3 * k} 90 {k} 0 0 0 "Pedestrian"\n' for k in FRAMES),
    "trajnet.txt": "".join(f"{10 * k} 1 {0.4 * k:.2f} 3.2\n" for k in FRAMES),
    "obsmat.txt": "".join(f"{10 * k} 1 {0.4 * k:.2f} 0 3.2 1 0 0\n" for k in FRAMES),
    "boxes.json": '{"annotations": [{"image_id": 1, "bbox": [1, 2, 3, 4], "category_id": 1}], "images": [{"id": 1}]}\n',
    "set.toml": '[track]\nmax-age-s = 2.0\nmin-hits-frames = 3\ncost = "iou"\nmix-classes = true\n[retrack]\ndrift = 0.1\n',
}
NUMBERS = (
    *("0", "-1", "1e9", "1e15", "1e308", "-1e400", "nan", "inf", "-0.0", "0x1f", "1_000", "٣", "", "1e-400", "+5"),
    *(str(2**31), str(2**53 + 1), str(2**63), str(2**64 + 7), "9" * 5000, "1." + "3" * 400, "true"),
)
TEXTS = (
    "\0",
    "\x1b[2J",
    "\u202e",
    "é" * 300,
    '"',
    "'",
    "[",
    "]" * 99,
    "=",
    "#",
    "\\u0000",
    "\ud7ff",
    "a" * 100_000,
    ",",
)
ENDS = ("\r\n", "\r", "\n\n", "\u2028", "\0\n", ";")


def mutant(seed: int) -> tuple[str, bytes]:
    """The name of a file, and what is in it."""
    rng = random.Random(seed)
    name = rng.choice(list(WHOLE))
    lines = WHOLE[name].splitlines()
    for _ in range(rng.choice([1, 1, 2, 3])):
        rng.choice(FAULTS)(rng, lines)
    data = bytearray(rng.choice(["\n", "\n", "\n", *ENDS]).join(lines).encode("utf-8", "surrogatepass"))
    for _ in range(rng.choice([0, 0, 0, 1, 5])):
        at = rng.randrange(len(data) + 1)
        data[at : at + rng.choice([0, 1, 7])] = rng.randbytes(rng.choice([0, 1, 3]))
    head = rng.choice([b"", b"", b"", b"", b"\xef\xbb\xbf", b"\xff\xfe", b"\x1f\x8b\x08"])
    return name, head + bytes(data[: rng.randrange(len(data) + 1)] if rng.random() < 0.1 else data)


def _values(line: str) -> tuple[list[str], str]:
    mark = "," if "," in line else " "
    return line.split(mark), mark


def _value(rng: random.Random, lines: list[str], values: tuple[str, ...]) -> None:
    """One value, in one line or in all."""
    place, column = rng.randrange(len(lines)), rng.randrange(20)
    other = rng.choice(values)
    for at in range(len(lines)) if rng.random() < 0.2 else [place]:
        parts, mark = _values(lines[at])
        parts[column % len(parts)] = other
        lines[at] = mark.join(parts)


def _columns(rng: random.Random, lines: list[str]) -> None:
    """One value more or less, in one line or in all."""
    place, is_more = rng.randrange(len(lines)), rng.random() < 0.5
    for at in range(len(lines)) if rng.random() < 0.5 else [place]:
        parts, mark = _values(lines[at])
        lines[at] = mark.join([*parts, "7"] if is_more else parts[:-1])


def _lines(rng: random.Random, lines: list[str]) -> None:
    """Lines twice, in another order, lost, or of another file."""
    at = rng.randrange(len(lines))
    match rng.randrange(5):
        case 0:
            lines.insert(rng.randrange(len(lines)), lines[at])
        case 1:
            rng.shuffle(lines)
        case 2 if len(lines) > 1:
            del lines[at]
        case 3:
            lines[at:at] = WHOLE[rng.choice(list(WHOLE))].splitlines()
        case _:
            lines[at:at] = [lines[at]] * 20_000


def _nesting(rng: random.Random, lines: list[str]) -> None:
    """Deep, long and strange things of TOML and JSON."""
    deep = rng.choice([3, 5000])
    strange = [
        f"a = {'[' * deep}{']' * deep}",
        f"a = {'{b = ' * deep}1{'}' * deep}",
        f"[{'.'.join('a' * deep)}]",
        "[track]\nmax-age-s = 1979-05-27T07:32:00Z",
        f"[track]\nmax-age-frames = {'9' * deep}",
        '[info]\noutput = "elsewhere.txt"\nforce = true',
        '{"images": ' + "[" * deep,
    ]
    lines.insert(rng.randrange(len(lines) + 1), rng.choice(strange))


FAULTS: tuple[Callable[[random.Random, list[str]], None], ...] = (
    partial(_value, values=NUMBERS),
    partial(_value, values=NUMBERS),
    partial(_value, values=TEXTS),
    _columns,
    _lines,
    _nesting,
)
