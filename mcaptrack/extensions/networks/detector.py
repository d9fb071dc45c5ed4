"""Pictures -> detections by a network in ONNX format.

Pictures go through the network beside one another, one on each core; what is found in one doesn't depend on others.

Letters: N boxes.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain, islice
from math import sqrt
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError, did_you_mean
from mcaptrack.extensions.networks.catalogue import check, find, stored
from mcaptrack.extensions.networks.layouts import (
    LAYOUTS,
    SURE,
    Layout,
    MisreadError,
    NetworkSignature,
    class_count,
    possible,
    recognised,
)
from mcaptrack.extensions.networks.network import Device, NetworkFile, NetworkLimits, digest_of, read_file
from mcaptrack.extensions.networks.nms import Boxes, Size, Tile, join_tiles, place, suppress, tiles_of
from mcaptrack.extensions.networks.pictures import DetectorNetwork, workers
from mcaptrack.files import missing
from mcaptrack.geometry.arrays import Image, taken
from mcaptrack.geometry.boxes import parse_size
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, VIDEO, Frame, Schema
from mcaptrack.schema.classes import COCO, PEOPLE, PERSON
from mcaptrack.transforms.protocol import Colour, ModelCard, Suited, check_options, option, parameters, setting

LayoutChoice = Literal["auto", "yolox", "yolox-legacy", "nanodet", "rtdetr", "dfine", "rfdetr", "ultralytics"]

#: Headings of options.
NETWORK: Final = "The network"
_BOXES: Final = "What is detected"
#: The size of the input follows that of the picture.
_AS_PICTURE: Final = "picture"
_INPUT_SIZE: Final = rf"[0-9]+x[0-9]+|{_AS_PICTURE}"
#: Pixels of an input that follows the picture: smaller pictures are enlarged, at most twice, and larger ones reduced.
_LEAST_PIXELS, _MOST_PIXELS = 700_000, 1_000_000
_MOST_TILES: Final = 64
#: So many pictures in which nothing was found are kept, to try other layouts on.
_KEPT: Final = 4
#: The most classes without a name that are listed.
_SHOWN: Final = 8


# The classes of a detector: their names, the ones that are wanted, and their numbers in rows.


#: The numbers up to 90 that COCO's own numbers of categories leave out.
_LEFT_OUT: Final = frozenset({0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83})


def names_of(declared: Mapping[int, str], count: int | None) -> dict[int, str]:
    """The names of classes by index: as the file declares them, or COCO's for 80, 91 or an unknown number of classes.

    The only class of a network is a person. Others without names are called by their index.
    """
    if declared:
        return dict(declared)
    if count in (80, None):
        return dict(enumerate(COCO))
    if count in (90, 91):
        numbers = [number for number in range(91) if number not in _LEFT_OUT]
        return dict(zip(numbers, COCO, strict=True))
    return {0: PEOPLE[0]} if count == 1 else {index: str(index) for index in range(count)}


def numbers_of(names: Mapping[int, str]) -> dict[int, int]:
    """The number of each class in rows: 1 is a person and nothing else, 0 stays free for what is unknown.

    Others keep their index, plus one where the network counts from 0; the one that would be 1 takes the number of
    people, or the next one after all if there are none.
    """
    first = 0 if 0 not in names else 1
    people = _people(names)
    numbers = {index: index + first for index in names}
    free = max(numbers.values(), default=0) + 1 if people is None else numbers[people]
    for index, number in numbers.items():
        if people is not None and names[index].casefold() == names[people].casefold():
            numbers[index] = PERSON
        elif number == PERSON:
            numbers[index] = free
    return numbers


def wanted(names: Mapping[int, str], classes: str, where: str) -> list[int]:
    """The indices of classes that are wanted: names or indices with commas between them, or ``all``.

    Raises McaptrackError, which begins with ``where``, for one that there is not.
    """
    if are_all(classes):
        return sorted(names)
    by_name: dict[str, list[int]] = {}
    for index, name in names.items():  # two classes may have one name
        by_name.setdefault(name.casefold(), []).append(index)
    out: set[int] = set()
    for word in filter(None, (word.strip().casefold() for word in classes.split(","))):
        people = _people(names) if word == PEOPLE[0] else None
        indices = by_name.get(word) or ([] if people is None else by_name[names[people].casefold()])
        if not indices and word.isdecimal() and int(word) in names:
            indices = [int(word)]
        if not indices:
            raise McaptrackError(
                f"{where} has no class {word!r}; {did_you_mean(word, by_name)}`classes=` takes {_known(names)}"
            )
        out.update(indices)
    if not out:
        raise McaptrackError(f"`classes=` names none; {where} has {_known(names)}")
    return sorted(out)


def are_all(classes: str) -> bool:
    """Whether every class is wanted."""
    return classes.strip().casefold() == "all"


def _known(names: Mapping[int, str]) -> str:
    some = ", ".join(list(names.values())[:10])
    return f"{some} and {len(names) - 10} more, or all" if len(names) > 10 else f"{some}, or all"


def _people(names: Mapping[int, str]) -> int | None:
    """The first index of the class of people."""
    by_name = {name.casefold(): index for index, name in reversed(list(names.items()))}
    return next((by_name[name] for name in PEOPLE if name in by_name), None)


@dataclass(frozen=True, kw_only=True)
@parameters
class OnnxDetector:
    """With `--detector onnx:FILE` a network in ONNX format finds objects in each picture.

    Reads video, writes detections: one box for each object of the chosen classes.

    Parameters
    ----------
    file : str
        ONNX file of the network; `onnx:FILE` names it, too.
    layout : str
        Family of the network, which says what it takes and gives; `auto` tells it by names, shapes and a trial.
    input_size : str
        Width and height of the network's input, as in 960x736, or `picture` for about those of the picture;
        otherwise the network's own.
    device : str
        Where the network runs; `auto` takes a GPU if ONNX Runtime can use one.
    max_memory_mb : int
        Most memory that the network may take, in MB.
    tiles : str
        Columns and rows of tiles that each picture is cut into, as in 3x2, for small objects.
    overlap : float
        How much of its width or height a tile shares with the next one.
    classes : str
        Classes to detect, by name or index with commas between them; `all` for every one.
    min_score : float
        Boxes with a lower score are left out.
    max_iou : float
        Boxes of one class that overlap more are one object.

    Examples
    --------
    Nothing is opened before there are pictures:

    >>> detector = OnnxDetector(file="people.onnx", classes="person,bicycle", tiles="2x2")
    >>> list(detector([]))
    []
    """

    file: str = option("", theme=NETWORK)
    layout: LayoutChoice = setting("auto", theme=NETWORK)
    input_size: str = setting("", pattern=_INPUT_SIZE, theme=NETWORK)
    device: Device = option("auto", theme=NETWORK)
    max_memory_mb: int = setting(1000, least=10, most=1_000_000, theme=NETWORK)
    tiles: str = option("1x1", theme=_BOXES)
    overlap: float = setting(0.2, least=0.0, most=0.5, theme=_BOXES)
    classes: str = option("person", theme=_BOXES)
    min_score: float = option(0.1, least=0.0, most=1.0, search=(0.05, 0.6), theme=_BOXES)
    max_iou: float = setting(0.45, least=0.0, most=1.0, search=(0.3, 0.8), theme=_BOXES)

    reads: ClassVar[Schema] = VIDEO
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": DETECTIONS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})
    colour: ClassVar[Colour] = "bgr"
    #: Boxes of low scores are of people partly hidden: only ByteTrack makes use of them.
    suits: ClassVar[Mapping[str, Suited]] = MappingProxyType(
        {"tracker": Suited("bytetrack", on_ground=MappingProxyType({"cost": "metres"}))}
    )

    def __post_init__(self) -> None:
        check_options(self)
        tiles = parse_size(self.tiles)
        if tiles is None or not 0 < tiles[0] * tiles[1] <= _MOST_TILES:
            raise McaptrackError(f"tiles takes columns x rows, as in 3x2, {_MOST_TILES} at most, not {self.tiles}")
        if self.input_size not in ("", _AS_PICTURE) and parse_size(self.input_size) is None:
            raise McaptrackError(f"input_size takes width x height, as in 960x736, or picture, not {self.input_size}")

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        """Yield the boxes of each picture."""
        frames = iter(frames)
        first = next(frames, None)
        if first is None:
            return
        limits = NetworkLimits.with_memory(self.max_memory_mb, "`max_memory_mb=`", "a smaller `input_size=` takes less")
        file = read_file(self.weights(), limits)
        self.check_weights(file.sha256, len(file.data))
        with closing(DetectorNetwork(file, _input_size(self, first.rows), self.device, limits)) as network:
            run = _Run(self, file, network)
            for seen, boxes in run.detect(chain([first], frames)):
                yield (Frame(seen.t_ns, seen.frame, run.to_rows(boxes, seen.size)),)
        object.__setattr__(self, "_card", run.card())

    def weights(self) -> Path:
        """The file of the network. Raises McaptrackError if none is named, or it is not there."""
        if not self.file:
            raise McaptrackError("detector onnx needs a file, as in onnx:FILE")
        if not Path(self.file).is_file():
            raise McaptrackError(f"detector onnx: {missing(Path(self.file))}")
        return Path(self.file)

    def weights_sha256(self) -> str:
        """The digest of the network's file. Raises McaptrackError if it can't be read."""
        return digest_of(self.weights())

    def check_weights(self, sha256: str, size: int) -> None:
        """Raise McaptrackError if a file with this digest and size, in bytes, is not the right one; any is, here."""

    def model_card(self) -> ModelCard:
        """The facts of the network that ran last."""
        card: ModelCard = getattr(self, "_card", ModelCard())
        return card

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no detections, for a warning."""
        what = "nothing" if are_all(self.classes) else f"no {self.classes}"
        return f"the network finds {what} with a score of at least {self.min_score:g}"


# Which layout a network has: by its inputs and outputs, or where several fit, by what each finds in pictures.


#: What a layout finds in a picture, or why the outputs can't be read by it.
Found = Boxes | MisreadError
#: A layout is taken if its evidence is so many times that of each other one.
_CLEAR: Final = 2.0
#: After so many pictures with evidence for several layouts it can't be told.
_PATIENCE: Final = 25


def evidence(boxes: Boxes) -> float:
    """The amount of certain evidence: the sum of high scores."""
    return float(boxes.score[boxes.score >= SURE].sum())


def choose(path: Path, name: str, seen: NetworkSignature) -> list[Layout]:
    """The layouts that a network may have: the one of this name, or for "auto" all that fit.

    Raises McaptrackError if the outputs fit none, or not this one.
    """
    fitting = possible(seen)
    if name == "auto":
        if suited := recognised(seen):
            return suited
        if fitting:
            names = ", ".join(layout.name for layout in fitting)
            raise McaptrackError(f"{path} {_outputs(seen)}; its layout may be one of {names}: choose with `layout=`")
        raise McaptrackError(f"{path} {_outputs(seen)}, as no detector of a known layout does ({_all()})")
    if not LAYOUTS[name].fits(seen):
        others = ", ".join(layout.name for layout in fitting)
        fits = f"that fits {others}" if others else f"that fits no layout ({_all()})"
        raise McaptrackError(f"{path} {_outputs(seen)}, which a detector of layout {name} does not; {fits}")
    return [LAYOUTS[name]]


class Contest:
    """Which of several layouts a network has, by what each finds in pictures that are seen in order.

    ``layouts`` are those that are still possible, one once it is settled.
    """

    def __init__(self, path: Path, layouts: Sequence[Layout]) -> None:
        self._path = path
        self.layouts = list(layouts)
        self._sums = {layout.name: 0.0 for layout in layouts}
        self._pictures = 0

    @property
    def is_settled(self) -> bool:
        """Whether one layout is left."""
        return len(self.layouts) == 1

    def see(self, results: Mapping[str, Found]) -> None:
        """Judge by what each layout finds in a picture.

        Raises McaptrackError if none is left, or if it can't be told.
        """
        if self.is_settled:
            return
        boxes = {name: result for name, result in results.items() if isinstance(result, Boxes)}
        if not any(layout.name in boxes for layout in self.layouts):
            why = "; ".join(f"read as {layout.name}, {results[layout.name]}" for layout in self.layouts)
            raise McaptrackError(f"{self._path} fits no layout: {why}")
        self.layouts = [layout for layout in self.layouts if layout.name in boxes]
        for layout in self.layouts:
            self._sums[layout.name] += evidence(boxes[layout.name])
        ordered = sorted(self.layouts, key=lambda layout: -self._sums[layout.name])
        best, second = (self._sums[layout.name] for layout in (ordered * 2)[:2])
        self._pictures += best > 0
        if len(ordered) == 1 or (best > 0 and best >= _CLEAR * second):
            self.layouts = ordered[:1]
        elif self._pictures >= _PATIENCE:
            raise McaptrackError(self._unclear())

    def end(self) -> None:
        """Settle on what is left, after the last picture. Raises McaptrackError if it can't be told."""
        if not self.is_settled and self._pictures:
            raise McaptrackError(self._unclear())
        self.layouts = self.layouts[:1]

    def _unclear(self) -> str:
        names = " and ".join(layout.name for layout in self.layouts)
        return f"{self._path} finds much the same read as {names}; choose with `layout=`"


def refuse_if_misread(
    path: Path, layout: Layout, pictures: int, results: Mapping[str, Sequence[Found]], is_chosen: bool
) -> None:
    """Refuse a network that found nothing in any picture though another layout finds boxes in some of them.

    Parameters
    ----------
    path : Path
        Of the network.
    layout : Layout
        The layout by which it found nothing.
    pictures : int
        How many pictures there were.
    found : mapping of str to sequence of Boxes or MisreadError
        What each other layout that fits finds in some of the pictures.
    is_chosen : bool
        Whether the layout was named.

    """
    for name, boxes in results.items():
        with_boxes = [picture for picture in boxes if isinstance(picture, Boxes) and evidence(picture) > 0]
        if with_boxes:
            count = sum(int((picture.score >= SURE).sum()) for picture in with_boxes)
            instead = f"choose `layout={name!r}`" if is_chosen else "choose with `layout=`"
            raise McaptrackError(
                f"{path}, read as {layout.name}, finds nothing in {pictures} pictures, and read as {name} finds "
                f"{count} boxes in {len(with_boxes)} of {len(boxes)}; {instead}"
            )


def _outputs(seen: NetworkSignature) -> str:
    some = [f"{name} {' x '.join(map(str, array.shape)) or 'a number'}" for name, array in seen.outputs.items()]
    more = f" and {len(some) - 6} more" if len(some) > 6 else ""
    names = f", with {seen.names} names of classes" if seen.names else ""
    size = f"{seen.size[0]}x{seen.size[1]}"
    return f"takes {', '.join(seen.inputs)} and gives {', '.join(some[:6])}{more} at {size}{names}"


def _all() -> str:
    return ", ".join(LAYOUTS)


class _Seen(NamedTuple):
    """A picture, of which width and height are kept, and what each layout that is still possible finds in it."""

    t_ns: int
    frame: int
    size: Size
    results: Mapping[str, Found]


class _Run:
    """One run of a detector: its network, and which layout it has."""

    def __init__(self, options: OnnxDetector, file: NetworkFile, network: DetectorNetwork) -> None:
        self._options, self._path, self._sha256 = options, file.path, file.sha256
        self._grid = parse_size(options.tiles) or (1, 1)
        self._network = network
        seen = network.signature
        layouts = choose(file.path, options.layout, seen)
        count = class_count(layouts[0], seen)
        self._names, self._is_named = names_of(network.names, count), bool(network.names)
        self._unknown: Counter[int] = Counter()
        self._wanted = np.array(wanted(self._names, options.classes, str(file.path)), np.int64)
        self._numbers = numbers_of(self._names)
        self._contest, self._has_found = Contest(file.path, layouts), False

    def detect(self, frames: Iterator[Frame]) -> Iterator[tuple[_Seen, Boxes]]:
        """The boxes of each picture, of all classes. Raises McaptrackError as the network and the contest do."""
        waiting: list[_Seen] = []
        kept: list[Image] = []
        pictures = 0
        for image, seen in self._look(frames):
            self._contest.see(seen.results)
            waiting.append(seen)
            pictures += 1
            if not self._has_found and (pictures & (pictures - 1)) == 0:  # the first, second, fourth, eighth ...
                kept = [*kept, image][-_KEPT:]
            if self._contest.is_settled:
                yield from self._drain(waiting)
        self._contest.end()
        yield from self._drain(waiting)
        if not self._has_found:
            self._refuse_if_misread(pictures, kept)
        self._warn_of_unknown()

    def to_rows(self, boxes: Boxes, size: Size) -> NDArray[np.void]:
        """Rows of the wanted classes, within the picture, in reading order."""
        unknown, count = np.unique(boxes.label[~np.isin(boxes.label, list(self._names))], return_counts=True)
        self._unknown.update(dict(zip(unknown.tolist(), count.tolist(), strict=True)))
        boxes = taken(boxes, np.isin(boxes.label, self._wanted))
        xyxy = np.clip(boxes.xyxy, 0, [*size, *size])
        boxes = taken(boxes._replace(xyxy=xyxy), (xyxy[:, 2] > xyxy[:, 0]) & (xyxy[:, 3] > xyxy[:, 1]))
        order = np.lexsort((boxes.score, boxes.label, boxes.xyxy[:, 0], boxes.xyxy[:, 1]))
        x1, y1, x2, y2 = boxes.xyxy[order].T
        numbers = [self._numbers[label] for label in boxes.label[order].tolist()]
        return DETECTIONS.rows(
            x_px=x1, y_px=y1, w_px=x2 - x1, h_px=y2 - y1, score=boxes.score[order], class_id=np.array(numbers, np.int64)
        )

    def card(self) -> ModelCard:
        """The facts of the network."""
        facts = {"layout": self._contest.layouts[0].name, "input_size": "x".join(map(str, self._network.size))}
        names = {self._numbers[index]: self._names[index] for index in self._wanted.tolist()}
        return ModelCard(self._sha256, names, facts)

    def _drain(self, waiting: list[_Seen]) -> Iterator[tuple[_Seen, Boxes]]:
        """The pictures that wait, with the boxes of the layout that was settled on."""
        layout = self._contest.layouts[0]
        for seen in waiting:
            boxes = seen.results[layout.name]
            if isinstance(boxes, MisreadError):
                raise McaptrackError(self._misread(seen.frame, layout, boxes))
            self._has_found |= len(boxes.score) > 0
            yield seen, boxes
        waiting.clear()

    def _misread(self, frame: int, layout: Layout, error: MisreadError) -> str:
        # RT-DETR and D-FINE differ in nothing but the name.
        others = [
            other.name for other in possible(self._network.signature) if replace(other, name=layout.name) != layout
        ]
        then = f"choose another `layout=` ({', '.join(others)})" if others else "no other layout fits it"
        return f"{self._path}, read as {layout.name}: in frame {frame} {error}; {then}"

    def _look(self, frames: Iterator[Frame]) -> Iterator[tuple[Image, _Seen]]:
        """Look at pictures, several beside one another; results come in order."""
        count, batch = workers(), self._network.batch
        with ThreadPoolExecutor(count) as pool:
            running: deque[Future[list[tuple[Image, _Seen]]]] = deque()
            is_done = False
            try:
                while some := list(islice(frames, batch)):
                    running.append(pool.submit(self._look_at, some))
                    if len(running) > count:
                        yield from running.popleft().result()
                while running:
                    yield from running.popleft().result()
                is_done = True
            finally:
                for future in running:
                    future.cancel()
                if not is_done:  # the pool waits for pictures that the network may never be done with
                    self._network.close()

    def _look_at(self, frames: list[Frame]) -> list[tuple[Image, _Seen]]:
        results: list[dict[str, Found]] = [{} for _ in frames]
        for layout in self._contest.layouts:
            for by_layout, boxes in zip(results, self._boxes(layout, frames), strict=True):
                by_layout[layout.name] = boxes
        return [
            (frame.rows, _Seen(frame.t_ns, frame.index, (frame.rows.shape[1], frame.rows.shape[0]), by_layout))
            for frame, by_layout in zip(frames, results, strict=True)
        ]

    def _boxes(self, layout: Layout, frames: list[Frame]) -> list[Found]:
        """The boxes that a layout finds in pictures, or why its outputs can't be read."""
        size, options = self._network.size, self._options
        tiles = [tiles_of(frame.rows.shape[1], frame.rows.shape[0], *self._grid, options.overlap) for frame in frames]
        jobs = [(frame, tile) for frame, those in zip(frames, tiles, strict=True) for tile in those]
        parts: list[Found] = []
        for start in range(0, len(jobs), self._network.batch):
            some = jobs[start : start + self._network.batch]
            placed = [place(frame.rows, tile, size, layout.fit, layout.pad) for frame, tile in some]
            outputs = self._network.run(np.stack([layout.blob(canvas) for canvas, _ in placed]))
            if not all(np.isfinite(array.sum(dtype=np.float64)) for array in outputs.values()):
                raise McaptrackError(
                    f"{self._path} gives numbers that are not finite at {some[0][0].t_ns} ns (frame {some[0][0].index})"
                )
            try:
                read = layout.read(outputs, size, options.min_score)
            except MisreadError as error:
                parts += [error] * len(some)
                continue
            parts += [
                boxes._replace(xyxy=placement.to_picture(boxes.xyxy))
                for boxes, (_, placement) in zip(read, placed, strict=True)
            ]
        out: list[Found] = []
        for those in tiles:
            own, parts = parts[: len(those)], parts[len(those) :]
            out.append(self._merged(layout, own, those))
        return out

    def _merged(self, layout: Layout, parts: list[Found], tiles: list[Tile]) -> Found:
        """The boxes of a picture from those of its tiles."""
        readable = [boxes for boxes in parts if isinstance(boxes, Boxes)]
        if len(readable) < len(parts):
            return next(error for error in parts if isinstance(error, MisreadError))
        if len(readable) == 1:
            return readable[0] if layout.suppresses else suppress(readable[0], self._options.max_iou)
        suppressed = readable if layout.suppresses else [suppress(boxes, self._options.max_iou) for boxes in readable]
        return join_tiles(suppressed, tiles, self._options.max_iou)

    def _refuse_if_misread(self, pictures: int, kept: Sequence[Image]) -> None:
        layout = self._contest.layouts[0]
        others = [other for other in recognised(self._network.signature) if other.name != layout.name]
        frames = [Frame(0, 0, image) for image in kept]
        results = {str(other.name): [self._boxes(other, [frame])[0] for frame in frames] for other in others}
        refuse_if_misread(self._path, layout, pictures, results, self._options.layout != "auto")

    def _warn_of_unknown(self) -> None:
        """Warn of boxes of classes that names don't include: the names may be of other classes, too."""
        if self._unknown:
            classes = sorted(self._unknown)
            shown = ", ".join(map(str, classes[:_SHOWN])) + (", ..." if len(classes) > _SHOWN else "")
            which = "in the file" if self._is_named else "of COCO, which are assumed"
            text = f"{self._path}: {self._unknown.total()} boxes are of classes ({shown}) without a name"
            warn(f"{text} among the {len(self._names)} {which}; they are left out", "classes")


def _input_size(options: OnnxDetector, first: Image) -> Size | None:
    if options.input_size != _AS_PICTURE:
        return parse_size(options.input_size)
    height, width = first.shape[:2]
    x1, y1, x2, y2 = tiles_of(width, height, *(parse_size(options.tiles) or (1, 1)), options.overlap)[0]
    return size_for(x2 - x1, y2 - y1)


def size_for(width: int, height: int) -> Size:
    """The size of an input for pictures of this size: about the same, from 0.7 to 1 million pixels, enlarged at most
    twice; multiples of 32.
    """
    pixels = width * height
    scale = min(2.0, sqrt(_LEAST_PIXELS / pixels)) if pixels < _LEAST_PIXELS else min(1.0, sqrt(_MOST_PIXELS / pixels))
    wide, high = (max(32, -(-round(side * scale) // 32) * 32) for side in (width, height))
    return wide, high


# The detectors of the catalogue, each with the settings that suit it.


@dataclass(frozen=True, kw_only=True)
@parameters
class CataloguedDetector(OnnxDetector):
    """Base of the detectors of the catalogue: YOLOX, with an input of about the size of the picture.

    Parameters
    ----------
    layout : str
        Family of the network.
    input_size : str
        Width and height of the network's input, as in 416x416, or `picture` for about those of the picture.
    """

    layout: LayoutChoice = setting("yolox", theme=NETWORK)
    input_size: str = setting("picture", pattern=_INPUT_SIZE, theme=NETWORK)

    #: False boxes score up to 0.6 and begin no tracks, so that those that begin need no confirmation.
    suits: ClassVar[Mapping[str, Suited]] = MappingProxyType(
        {
            "tracker": OnnxDetector.suits["tracker"]._replace(
                parameters=MappingProxyType({"new_score": 0.7, "min_hits_frames": 1})
            )
        }
    )
    #: Its name in the catalogue.
    model: ClassVar[str]

    def weights(self) -> Path:
        """The file of the network. Raises McaptrackError if it was not fetched."""
        return super().weights() if self.file else stored(find(self.model))

    def check_weights(self, sha256: str, size: int) -> None:
        """Raise McaptrackError if a file with this digest and size, in bytes, is not that of the catalogue."""
        check(find(self.model), sha256, size, self.weights())

    def weights_sha256(self) -> str:
        """The digest of the network's file."""
        return find(self.model).sha256


@dataclass(frozen=True, kw_only=True)
class YoloxNano(CataloguedDetector):
    """With `--detector yolox-nano` a small network finds people and other objects in each picture.

    Reads video, writes detections. `mcaptrack models get yolox-nano` fetches its weights once.

    References
    ----------
    .. [1] Z. Ge, S. Liu, F. Wang, Z. Li, J. Sun: YOLOX: Exceeding YOLO Series in 2021. arXiv:2107.08430.
    """

    model: ClassVar[str] = "yolox-nano"


@dataclass(frozen=True, kw_only=True)
class YoloxTiny(CataloguedDetector):
    """With `--detector yolox-tiny` a larger network does the same more slowly.

    References
    ----------
    .. [1] Z. Ge, S. Liu, F. Wang, Z. Li, J. Sun: YOLOX: Exceeding YOLO Series in 2021. arXiv:2107.08430.
    """

    model: ClassVar[str] = "yolox-tiny"


@dataclass(frozen=True, kw_only=True)
class YoloxS(CataloguedDetector):
    """With `--detector yolox-s` a network for GPUs does the same.

    References
    ----------
    .. [1] Z. Ge, S. Liu, F. Wang, Z. Li, J. Sun: YOLOX: Exceeding YOLO Series in 2021. arXiv:2107.08430.
    """

    model: ClassVar[str] = "yolox-s"
