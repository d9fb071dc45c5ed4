"""The laws that hold for every transform.

Letters: N rows, H and W pixels.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.api.common import as_path
from mcaptrack.api.options import PathLike
from mcaptrack.errors import McaptrackError
from mcaptrack.files import missing
from mcaptrack.geometry.arrays import Image
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.notices import Notice, listening, warn
from mcaptrack.registry import Entry
from mcaptrack.registry.guard import UNDONE, Guard
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, SIGHTINGS, TRACKS, VIDEO, Frame, Schema
from mcaptrack.transforms.guarded import guarded
from mcaptrack.transforms.protocol import Colour, Transform, check_options, latency_of, traits_of
from mcaptrack.transforms.stages import declared_stage

#: How far most rows of a re-tracker may be from all rows that it reads.
_NEAR_M, _NEAR_PX = 1.0, 30.0


class LawError(AssertionError):
    """A transform, a predictor, a format or so on breaks a law; the message says which one, and where."""


@contextmanager
def law(name: str) -> Iterator[None]:
    """A McaptrackError in this block is a LawError that names the law."""
    try:
        yield
    except McaptrackError as error:
        raise LawError(f"{name}: {error}") from None


def present(path: PathLike) -> Path:
    """The absolute path of a file or folder. Raises McaptrackError if there is none."""
    file = as_path(path)
    if not file.exists():
        raise McaptrackError(missing(file))
    return file.absolute()


@contextmanager
def unchanged(path: PathLike, what: str) -> Iterator[Path]:
    """Check that this block leaves a file or folder, ``what``, as it was; gives its absolute path."""
    file = present(path)
    before = content_of(file)
    try:
        yield file
    finally:
        if content_of(file) != before:
            raise LawError(f"pure: it changes {what}")


def content_of(path: Path) -> Any:
    """All bytes of a file or folder."""
    if path.is_dir():
        return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}
    return path.read_bytes()


def check_transform(transform: Transform, frames: Sequence[Frame] | None = None, *, seed: int = 0) -> None:
    """Check a transform against the laws that hold for every transform.

    The laws: it declares what the protocol asks for; every output has the rows of its schema, at times that increase;
    the same input gives the same output, also while it runs on another input, and is not changed; the output of the
    past does not depend on the future, but for ``latency_s``; it leaves the process that it runs in as it was (the
    working folder, random state and so on); shuffling the rows of a frame, or naming tracks otherwise, changes ids at
    most; frames without rows, and no frames at all, are valid input; the parameters can be kept in a log and give the
    same transform again.

    Parameters
    ----------
    transform : Transform
        The transform, with any parameters.
    frames : sequence of mcaptrack.schema.Frame, optional
        What it reads; by default ``sample_frames`` of its schema.
    seed : int, default 0
        Random seed of the sample, and of shuffling rows.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law, the output, the frame and its time.

    Examples
    --------
    >>> from mcaptrack.testing import check_transform
    >>> from mcaptrack.transforms import ByteTrack
    >>> check_transform(ByteTrack(max_age_s=1.0))
    """
    declares(transform, (), seed)
    sample = sample_frames(transform.reads, seed, colour=traits_of(transform).colour) if frames is None else frames
    inputs = list(sample)
    if not inputs:
        raise LawError("there are no frames to check the transform with")
    with same_process(type(transform).__name__) as said:
        for holds in LAWS.values():
            holds(transform, [frame._replace(rows=frame.rows.copy()) for frame in inputs], seed)
    for notice in said:
        warn(notice.message, notice.code)


@contextmanager
def same_process(name: str) -> Iterator[list[Notice]]:
    """Check that this block leaves the process as it was; what it changes is undone. Raises LawError if it doesn't.

    Warnings of the block go into the list alone: most are about copies of files.
    """
    guard, said = Guard(name), list[Notice]()
    with listening(said.append):
        try:
            with guard.step():
                yield said
        finally:
            guard.end()
    if guard.changed:
        raise LawError(f"process: it changes {' and '.join(guard.changed)} of the process that it runs in")
    for notice in said:  # of guards within
        if notice.message.endswith(UNDONE):
            raise LawError(f"process: {notice.message.removesuffix(UNDONE)} of the process that it runs in")


def sample_frames(schema: Schema, seed: int = 0, step_s: float = 0.0, colour: Colour = "grey") -> list[Frame]:
    """Return frames to test transforms with.

    Parameters
    ----------
    schema : Schema
        ``VIDEO`` gives pictures on which a block moves; ``DETECTIONS`` gives boxes of people who
        are missed now and then, and false positives, at uneven times; ``SIGHTINGS`` gives boxes
        of three cameras, on the ground; ``TRACKS`` gives tracks in pixels and metres with
        gaps, births, ends and changing ids.
    seed : int, default 0
        Random seed.
    step_s : float, optional
        Time between frames of tracks in seconds, by default 0.4.
    colour : str, default "grey"
        Pictures of brightness (H, W), or with "bgr" of blue, green and red (H, W, 3).

    Returns
    -------
    list of mcaptrack.schema.Frame
        12 pictures, 30 frames of detections or sightings, or 40 frames of tracks.

    Raises
    ------
    LawError
        For another schema.

    Examples
    --------
    >>> from mcaptrack.schema import TRACKS
    >>> from mcaptrack.testing import sample_frames
    >>> len(sample_frames(TRACKS))
    40
    """
    rng = np.random.default_rng(seed)
    if schema is VIDEO:
        frames = _pictures(rng)
        return frames if colour == "grey" else [frame._replace(rows=_tinted(frame.rows)) for frame in frames]
    if schema is DETECTIONS:
        return _detections(rng)
    if schema is TRACKS:
        return _tracks(rng, step_s or 0.4)
    if schema is SIGHTINGS:
        return _sightings(rng)
    raise LawError(f"declares: there is no sample of {schema.name}; give frames")


def _pictures(rng: np.random.Generator) -> list[Frame]:
    floor = rng.integers(60, 140, (48, 64))
    frames = []
    for number in range(12):
        image = floor + rng.integers(-3, 4, floor.shape)
        image[10:30, 4 * number : 4 * number + 8] = 230
        frames.append(Frame(seconds_to_ns(number / 10), number, image.astype(np.uint8)))
    return frames


def _tinted(grey: Image) -> Image:
    """A picture (H, W, 3) with three different channels; green is ``grey`` (H, W)."""
    return np.stack([grey // 2, grey, 255 - grey], axis=-1)


def _detections(rng: np.random.Generator) -> list[Frame]:
    start, speed = rng.uniform(50, 500, (4, 2)), rng.normal(0, 6, (4, 2))
    frames, now = [], 0.0
    for number in range(30):
        now += 0.1 * rng.choice([1, 1, 1, 1, 1, 4]) + rng.uniform(-0.01, 0.01)
        seen = (start + speed * number)[rng.random(4) > 0.25]
        centre = rng.permutation(np.concatenate([seen, rng.uniform(0, 600, (rng.poisson(0.3), 2))]))
        size = np.array([20.0, 50.0])
        x, y = (centre - size / 2).T
        count = len(centre)
        rows = DETECTIONS.rows(
            x_px=x,
            y_px=y,
            w_px=np.full(count, size[0]),
            h_px=np.full(count, size[1]),
            score=rng.uniform(0.2, 1.0, count),
            class_id=np.ones(count, np.uint32),
        )
        frames.append(Frame(seconds_to_ns(now), number, rows))
    return frames


def _sightings(rng: np.random.Generator) -> list[Frame]:
    start, speed = rng.uniform(-5, 5, (4, 2)), rng.normal(0, 0.3, (4, 2))
    frames = []
    for number in range(30):
        t_ns, at = seconds_to_ns(0.5 * number), start + 0.5 * speed * number
        person, camera = np.nonzero(rng.random((4, 3)) > (1.0 if number == 3 else 0.25))
        order = np.lexsort((person, camera))
        person, camera = person[order], camera[order]
        x_m, y_m = (at[person] + rng.normal(0, 0.1, (len(person), 2))).T
        rows = SIGHTINGS.rows(
            camera=camera,
            picture_ns=np.full(len(person), t_ns),
            box_row=person,
            x_m=x_m,
            y_m=y_m,
            cov_xx_m2=np.full(len(person), 0.02),
            cov_xy_m2=np.zeros(len(person)),
            cov_yy_m2=np.full(len(person), 0.02),
            score=rng.uniform(0.2, 1.0, len(person)),
            class_id=np.ones(len(person), np.uint32),
        )
        frames.append(Frame(t_ns, number, rows))
    return frames


def _tracks(rng: np.random.Generator, step_s: float) -> list[Frame]:
    place, speed, names = rng.uniform(-5, 5, (5, 2)), rng.normal(0, 1, (5, 2)), rng.permutation(50)[:5]
    frames = []
    for number in range(40):
        place = place + speed * step_s + rng.normal(0, 0.05, place.shape)
        seen = np.flatnonzero(rng.random(5) > 0.2)
        if rng.random() < 0.1:
            names[rng.integers(5)] = 50 + number
        rows = TRACKS.rows(
            track_id=names[seen].astype(np.int64),
            x_px=place[seen, 0] * 20 + 200,
            y_px=place[seen, 1] * 20 + 200,
            w_px=np.full(len(seen), 10.0),
            h_px=np.full(len(seen), 30.0),
            x_m=place[seen, 0],
            y_m=place[seen, 1],
            score=rng.random(len(seen)),
            observed=rng.random(len(seen)) > 0.1,
            source_id=np.full(len(seen), -1),
        )
        frames.append(Frame(seconds_to_ns(number * step_s), number, rows[rng.permutation(len(rows))]))
    return frames


# The laws: each takes the transform, frames, and a random seed


def declares(transform: Transform, frames: Sequence[Frame], seed: int) -> None:
    """It is a frozen dataclass that declares ``reads``, ``writes`` and ``latency_s``, and parameters in range."""
    if isinstance(transform, type):
        raise LawError(f"declares: {transform.__name__} is a class; give a transform, as in {transform.__name__}()")
    name = type(transform).__name__
    if not is_dataclass(transform):
        raise LawError(f"declares: {name} is no dataclass; the fields of a transform are its parameters")
    if not type(transform).__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise LawError(f"declares: {name} is not frozen; make it with @dataclass(frozen=True, kw_only=True)")
    for attribute, kind in (("reads", Schema), ("writes", Mapping), ("latency_s", Mapping)):
        if not isinstance(getattr(transform, attribute, None), kind):
            raise LawError(f"declares: {name}.{attribute} is no {kind.__name__}")
    if "" not in transform.writes:
        raise LawError(f"declares: {name}.writes has no main output; it needs the key ''")
    latencies_s = latency_of(transform)
    if set(latencies_s) != set(transform.writes):
        raise LawError(f"declares: {name}.latency_s is of {[*latencies_s]}, writes is of {[*transform.writes]}")
    for suffix, latency_s in latencies_s.items():
        if not latency_s >= 0:
            raise LawError(f"declares: {name}.latency_s of '{suffix}' is {latency_s}; it is 0 or more, in seconds")
    with law("declares"):
        check_options(transform)
    if hasattr(transform, "input_topic") or hasattr(transform, "output_topic"):
        declared_stage(_entry(transform, "stage"))


def _entry(transform: Transform, kind: str) -> Entry:
    cls = type(transform)
    return Entry(cls.__name__, kind, cls, cls.__module__, "", "")


def conforms(transform: Transform, frames: Sequence[Frame], seed: int) -> None:
    """Every output has the rows of its schema, at times of its input that increase; and a run on a log takes it.

    A re-tracker gives tracks where its input has some.
    """
    reads_and_writes = (transform.reads, transform.writes[""])
    kind = {(VIDEO, DETECTIONS): "detector", (DETECTIONS, TRACKS): "tracker", (SIGHTINGS, DETECTIONS): "fuser"}
    with law("conforms"):
        results = list(guarded(_entry(transform, kind.get(reads_and_writes, "transform")), transform, frames))
    for suffix, output in zip(transform.writes, zip(*results, strict=True), strict=False):
        for number, (before, frame) in enumerate(pairwise(output), start=1):
            if frame.t_ns <= before.t_ns:
                where = _where(suffix, number, frame)
                raise LawError(f"conforms: {where} is not later than {before.t_ns} ns before it")
        for number, frame in enumerate(output):
            if not frames[0].t_ns <= frame.t_ns <= frames[-1].t_ns:
                span = f"{frames[0].t_ns} to {frames[-1].t_ns} ns"
                raise LawError(f"conforms: {_where(suffix, number, frame)} is outside of its input, {span}")
    if reads_and_writes == (TRACKS, TRACKS) and not hasattr(transform, "input_topic"):
        _keeps_places(frames, [result[[*transform.writes].index("")] for result in results])


def _keeps_places(frames: Sequence[Frame], output: Sequence[Frame]) -> None:
    """Check that most rows of an output are near rows of the input at the same time, or the nearest."""
    times = np.array([frame.t_ns for frame in frames])
    for *names, limit, unit in (("x_m", "y_m", _NEAR_M, "m"), ("x_px", "y_px", _NEAR_PX, "px")):
        away = []
        for frame in output:
            places, others = (
                np.stack([rows[name] for name in names], axis=-1).astype(float)
                for rows in (frame.rows, frames[int(np.abs(times - frame.t_ns).argmin())].rows)
            )
            distances = np.linalg.norm(places[:, None] - others[None], axis=-1)
            away += np.fmin.reduce(distances, axis=1, initial=np.inf).tolist()
        known = [distance for distance in away if np.isfinite(distance)]
        if known and (usual := float(np.median(known))) > limit:
            raise LawError(f"conforms: rows are usually {usual:.3g} {unit} from those that it reads; tracks stay there")


def repeats(transform: Transform, frames: Sequence[Frame], seed: int) -> None:
    """The same input gives the same output, also while it runs on another input; and the input is not changed."""
    before = [_key(frame) for frame in frames]
    alone = [[_key(frame) for frame in result] for result in transform(frames)]
    for number, frame in enumerate(frames):
        if _key(frame) != before[number]:
            raise LawError(f"pure: it changes its input, first in frame {number} at {frame.t_ns} ns")
    other = iter(transform(frames[1:]))
    for number, result in enumerate(transform(frames)):
        if number >= len(alone) or [_key(frame) for frame in result] != alone[number]:
            raise LawError(f"pure: the second run differs from the first in result {number} at {result[0].t_ns} ns")
        next(other, None)


def causal(transform: Transform, frames: Sequence[Frame], seed: int) -> None:
    """The run of a prefix is a prefix of the run, but for what lies within ``latency_s`` of the prefix's end."""
    for cut in sorted({1, len(frames) // 2, len(frames) - 1} - {0}):
        prefix = list(frames[:cut])
        whole, part = _outputs(transform, frames), _outputs(transform, prefix)
        for (suffix, latency), of_whole, of_part in zip(latency_of(transform).items(), whole, part, strict=True):
            if latency == float("inf"):
                continue
            certain = prefix[-1].t_ns - latency * NS_PER_S
            then, now = ([frame for frame in output if frame.t_ns <= certain] for output in (of_part, of_whole))
            if len(then) != len(now):
                raise LawError(
                    f"causal: output '{suffix}' has {len(now)} frames up to {certain:.0f} ns, and {len(then)} without "
                    f"the frames after number {cut - 1}"
                )
            for number, (a, b) in enumerate(zip(then, now, strict=True)):
                if _key(a) != _key(b):
                    raise LawError(f"causal: {_where(suffix, number, b)} depends on frames after number {cut - 1}")


def order_blind(transform: Transform, frames: Sequence[Frame], seed: int) -> None:
    """Shuffling the rows of a frame, or naming tracks otherwise, changes the ids of tracks at most."""
    if transform.reads is VIDEO:
        return  # pictures have no rows
    rng = np.random.default_rng(seed)
    shuffled = [frame._replace(rows=frame.rows[rng.permutation(len(frame.rows))]) for frame in frames]
    _same_but_ids(transform, frames, shuffled, "the order of rows in a frame", {"track_id"})
    if "track_id" in (transform.reads.dtype.names or ()):
        named = [frame._replace(rows=frame.rows.copy()) for frame in frames]
        last = max((int(frame.rows["track_id"].max()) for frame in frames if len(frame.rows)), default=0)
        for frame in named:
            frame.rows["track_id"] = last - frame.rows["track_id"]
        every = {
            name for schema in transform.writes.values() for name in schema.dtype.names or () if name.endswith("_id")
        }
        _same_but_ids(transform, frames, named, "the ids of tracks", every - {"class_id"})


def _same_but_ids(
    transform: Transform, frames: Sequence[Frame], changed: Sequence[Frame], change: str, ids: Collection[str]
) -> None:
    """Check that a change of the input, put in words, changes these columns of the output alone."""
    tracks: dict[int | None, int] = {}
    others: dict[int | None, int] = {}
    pairs = zip(_outputs(transform, frames), _outputs(transform, changed), strict=True)
    for suffix, (output, other) in zip(transform.writes, pairs, strict=True):
        if len(output) != len(other):
            raise LawError(f"order-blind: the number of frames of output '{suffix}' depends on {change}")
        for number, (a, b) in enumerate(zip(output, other, strict=True)):
            for frame, past in ((a, tracks), (b, others)):
                for row, track_id in _without_ids(frame.rows, ids):
                    past[track_id] = hash((past.get(track_id), suffix, number, row))
            # ids are compared by all their rows so far: of two with equal rows in a frame, either may come first
            if sorted(tracks.values()) != sorted(others.values()):
                raise LawError(f"order-blind: {_where(suffix, number, a)} depends on {change}")


def empties(transform: Transform, frames: Sequence[Frame], seed: int) -> None:
    """Frames without rows, and no frames at all, are valid input; nothing comes of them."""
    if transform.reads is VIDEO:
        silent = [frame._replace(rows=np.full_like(frame.rows, 100)) for frame in frames]
    else:
        silent = [frame._replace(rows=frame.rows[:0]) for frame in frames]
    outputs = _outputs(transform, silent)
    for suffix, output in zip(transform.writes, outputs, strict=True):
        for number, frame in enumerate(output):
            if len(frame.rows) and transform.writes[suffix] is not CAMERA_MOTION:  # a row per picture
                raise LawError(f"empties: {_where(suffix, number, frame)} has rows, though its input has none")
    if not any(outputs):
        raise LawError("empties: frames without rows give no frames; a frame without rows says that nothing was there")
    if list(transform([])):
        raise LawError("empties: no frames give frames")


def rebuilds(transform: Transform, frames: Sequence[Frame], seed: int) -> None:
    """Its parameters can be kept in a log as JSON, and give the same transform again."""
    names = [field.name for field in fields(transform) if not field.metadata.get("context")]
    try:
        kept = json.loads(json.dumps({name: asdict(transform)[name] for name in names}))
    except TypeError as error:
        raise LawError(f"provenance: the parameters can't be kept in a log: {error}") from None
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in kept.items()}
    again = type(transform)(**values)
    for name in names:
        if getattr(again, name) != getattr(transform, name):
            raise LawError(f"provenance: {name} is {getattr(again, name)!r} when it was kept, not the same as before")


#: The laws by name, in the order in which they are checked.
LAWS: Final[Mapping[str, Callable[[Transform, Sequence[Frame], int], None]]] = {
    "declares": declares,
    "conforms": conforms,
    "pure": repeats,
    "causal": causal,
    "order-blind": order_blind,
    "empties": empties,
    "provenance": rebuilds,
}


def _outputs(transform: Transform, frames: Sequence[Frame]) -> list[list[Frame]]:
    """The frames of each output."""
    outputs: list[list[Frame]] = [[] for _ in transform.writes]
    for result in transform(frames):
        for frame, output in zip(result, outputs, strict=True):
            output.append(frame)
    return outputs


def _where(suffix: str, number: int, frame: Frame) -> str:
    return f"output '{suffix}', frame {number} at {frame.t_ns} ns"


def _key(frame: Frame) -> tuple[int, int, bytes]:
    """A frame to the bit, but for padding between columns."""
    names = frame.rows.dtype.names
    content = b"".join(frame.rows[name].tobytes() for name in names) if names else frame.rows.tobytes()
    return frame.t_ns, frame.index, content


def _without_ids(rows: Any, ids: Collection[str]) -> list[tuple[tuple[Any, ...], int | None]]:
    """Rows in an order of their own, with these ids left out and that of the track apart.

    Numbers are compared to 9 digits, since sums depend on the order.
    """
    names = [name for name in rows.dtype.names if name not in ids]
    has_ids = "track_id" in rows.dtype.names
    out = []
    for row in rows:
        values = tuple("nan" if row[n] != row[n] else round(float(row[n]), 9) for n in names)
        out.append((values, int(row["track_id"]) if has_ids else None))
    return sorted(out, key=lambda pair: [str(value) for value in pair[0]])
