"""Label files -> rows: MOTChallenge, KITTI tracking, Stanford Drone annotations, TrajNet text, ETH obsmat.

| format  | columns                                                                        | frames | unit |
|---------|--------------------------------------------------------------------------------|--------|------|
| mot     | frame, id, left, top, width, height[, score[, ...]]; 6 to 10, comma separated  | from 1 | px   |
| kitti   | frame id type truncated occluded alpha left top right bottom ...; 17 or 18     | from 0 | px   |
| sdd     | id xmin ymin xmax ymax frame lost occluded generated "label"; blank separated  | from 0 | px   |
| trajnet | frame id x y; comma or blank separated                                         | from 0 | m    |
| obsmat  | frame id x z y vx vz vy; blank separated                                       | from 0 | m    |

MOTChallenge's truth names the class of a box in column 8 since MOT16; in MOT15, which has 10 columns, a position stands
there. Truth also holds boxes of what isn't scored: see ``Aside``.

Letters: N rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from mcaptrack.errors import McaptrackError

Format = Literal["auto", "mot", "kitti", "sdd", "trajnet", "obsmat"]
Role = Literal["detections", "tracks", "truth"]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_NO_ID: Final = -1
_PEDESTRIAN: Final = 1


#: Classes of MOT16, 17 and 20 that are people but none to be found: on a vehicle, standing still (a statue),
#: distractors, reflections.
_DISTRACTORS: Final = (2, 7, 8, 12)
#: Occluded more than this, or truncated at all, KITTI's people don't count; boxes up to this height don't count against
#: anybody.
_KITTI_OCCLUDED: Final = 2
KITTI_HEIGHT_PX: Final = 25.0


@dataclass(frozen=True)
class Aside:
    """Labelled boxes that nobody has to find: frames (N,) as in the file, boxes (N, 4).

    ``forgiven`` (N,): a track that is matched with the box counts neither for nor against; otherwise it counts as found
    nobody. ``region`` (N,): so do tracks that match nobody and lie in the box.
    """

    frame: Ints
    boxes_px: Floats
    forgiven: Bools
    region: Bools


@dataclass(frozen=True)
class Labels:
    """The rows of a label file, ordered by frame and id.

    ``frame`` (N,) is the number in the file, which is ``first_frame`` for the video's first frame. ``id`` (N,) is -1 in
    detections. ``boxes_px`` (N, 4) or ``xy_m`` (N, 2) is None where the format has none. ``score`` (N,) is NaN where
    there is none. ``left_out`` says what the file holds that is not of people; of truth, ``aside`` holds it.
    """

    format: Format
    first_frame: int
    frame: Ints
    id: Ints
    boxes_px: Floats | None
    xy_m: Floats | None
    score: Floats
    left_out: str = ""
    aside: Aside | None = None

    @property
    def step(self) -> int:
        """Every how many frames there are labels: 1, or 12 where every twelfth frame was labelled."""
        frames = np.unique(self.frame)
        return int(np.gcd.reduce(np.diff(frames))) if len(frames) > 1 else 1

    @property
    def identified(self) -> bool:
        """Whether the rows say who it is."""
        return bool((self.id != _NO_ID).any())


def read_labels(path: Path, label_format: Format = "auto", role: Role = "tracks") -> Labels:
    """Read a label file. Raises McaptrackError, with the line, if it is not of that format or not of any."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise McaptrackError(f"{path} is not a label file: it is not text") from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None
    numbered = [
        (at, line) for at, line in enumerate(lines, start=1) if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise McaptrackError(f"{path} holds no labels")
    if label_format == "auto":
        label_format = _guess(path, *numbered[0])
    labels = _READERS[label_format](path, numbered, role)
    if labels.identified:
        _refuse_twins(path, labels)
    order = np.lexsort((labels.id, labels.frame)) if labels.identified else np.argsort(labels.frame, kind="stable")
    boxes, xy = labels.boxes_px, labels.xy_m
    return replace(
        labels,
        frame=labels.frame[order],
        id=labels.id[order],
        boxes_px=None if boxes is None else boxes[order],
        xy_m=None if xy is None else xy[order],
        score=labels.score[order],
    )


def _split(line: str) -> list[str]:
    return [part.strip() for part in line.split(",")] if "," in line else line.split()


def _guess(path: Path, number: int, line: str) -> Format:
    columns = _split(line)
    if "," in line and 6 <= len(columns) <= 10:
        return "mot"
    if len(columns) == 10 and columns[-1].startswith('"'):
        return "sdd"
    if len(columns) in (17, 18) and columns[2].isalpha():
        return "kitti"
    if len(columns) == 4:
        return "trajnet"
    if len(columns) == 8 and "," not in line:
        return "obsmat"
    known = ", ".join(name for name in get_args(Format) if name != "auto")
    raise McaptrackError(
        f"{path}:{number}: {len(columns)} columns are of no label format that is known here ({known}): {line[:60]}"
    )


def _table(
    path: Path, numbered: Sequence[tuple[int, str]], name: str, least: int, most: int, columns: str
) -> tuple[Floats, Ints]:
    """The numbers (N, least) of the first columns, and the line of each row."""
    values = np.empty((len(numbered), least))
    for row, (number, line) in enumerate(numbered):
        parts = _split(line)
        try:
            if not least <= len(parts) <= most:
                raise ValueError(f"{len(parts)} columns")
            values[row] = [float(part) for part in parts[:least]]
        except ValueError as error:
            why = str(error) if "columns" in str(error) else "not all are numbers"
            raise McaptrackError(f"{path}:{number}: not {name} ({columns}), {why}: {line[:60]}") from None
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        number, line = numbered[int(finite.argmin())]
        raise McaptrackError(f"{path}:{number}: a number is not finite: {line[:60]}")
    return values, np.array([number for number, _ in numbered])


def _whole(path: Path, lines: Ints, values: Floats, what: str, least: int) -> Ints:
    """A column of whole numbers."""
    wrong = (values != np.rint(values)) | (values < least) | (np.abs(values) > 2**53)
    if wrong.any():
        at = int(wrong.argmax())
        raise McaptrackError(f"{path}:{lines[at]}: {what} has to be a whole number from {least} on, not {values[at]:g}")
    return values.astype(np.int64)


def _boxes(path: Path, lines: Ints, boxes: Floats) -> Floats:
    wrong = (boxes[:, 2] < 0) | (boxes[:, 3] < 0)
    if wrong.any():
        at = int(wrong.argmax())
        w, h = boxes[at, 2:]
        raise McaptrackError(f"{path}:{lines[at]}: a box can't be {w:g} wide and {h:g} high")
    return boxes


def _read_mot(path: Path, numbered: Sequence[tuple[int, str]], role: Role) -> Labels:
    columns = "frame, id, left, top, width, height, score, ..."
    values, lines = _table(path, numbered, "MOTChallenge", 6, 10, columns)
    frame = _whole(path, lines, values[:, 0], "the frame", 0)
    extra = np.full((len(values), 2), np.nan)  # score, class
    for row, (number, line) in enumerate(numbered):
        parts = _split(line)
        parts = parts[6:8] if len(parts) < 10 else parts[6:7]  # 10 columns are MOT15's: no classes
        try:
            extra[row, : len(parts)] = [float(part) for part in parts]
        except ValueError:
            raise McaptrackError(
                f"{path}:{number}: not MOTChallenge ({columns}), not all are numbers: {line[:60]}"
            ) from None
    boxes = _boxes(path, lines, values[:, 2:6])
    ids = _whole(path, lines, values[:, 1], "the id", _NO_ID)
    kept = np.ones(len(values), bool)
    if role == "truth":
        kind = extra[:, 1]
        if (kind == 0).all():
            raise McaptrackError(
                f"{path}: the class of all {len(kind)} boxes (column 8) is 0; pedestrians are 1 there since MOT16, and "
                "-1 or no column 8 says that there are no classes"
            )
        # A score of 0 marks boxes that don't count.
        kept = (extra[:, 0] != 0) & ((kind == _PEDESTRIAN) | (kind == _NO_ID) | np.isnan(kind))
        if not kept.any():
            raise McaptrackError(f"{path}: all {len(kept)} boxes are marked as not counting (score 0 or a class but 1)")
    gone = int((~kept).sum())
    left = ~kept
    forgiven = np.isin(extra[left, 1], _DISTRACTORS)
    aside = Aside(frame[left], boxes[left], forgiven, np.zeros(gone, bool)) if (extra[:, 1] > 0).any() else None
    score = extra[:, 0] if role != "truth" else np.full(len(values), np.nan)
    return Labels(
        "mot",
        0 if (frame == 0).any() else 1,  # some programs count from 0 in this format too, and show it by a frame 0
        frame[kept],
        ids[kept],
        boxes[kept],
        None,
        score[kept],
        f"{gone} boxes that don't count (score 0 or a class but 1)" if gone else "",
        aside,
    )


def _read_kitti(path: Path, numbered: Sequence[tuple[int, str]], role: Role) -> Labels:
    """KITTI tracking: pedestrians. Scores (column 18) are those of a tracker's."""
    columns = "frame id type truncated occluded alpha left top right bottom height width length x y z rotation score"
    values = np.empty((len(numbered), 8))  # frame, id, truncated, occluded, corners
    kind, score = np.empty(len(numbered), object), np.full(len(numbered), np.nan)
    for row, (number, line) in enumerate(numbered):
        parts = _split(line)
        try:
            if len(parts) not in (17, 18):
                raise ValueError
            values[row] = [float(parts[at]) for at in (0, 1, 3, 4, 6, 7, 8, 9)]
            kind[row] = parts[2].lower()
            score[row] = float(parts[17]) if len(parts) == 18 else np.nan
        except ValueError:
            raise McaptrackError(f"{path}:{number}: not KITTI tracking ({columns}): {line[:60]}") from None
    lines = np.array([number for number, _ in numbered])
    frame, who = _whole(path, lines, values[:, 0], "the frame", 0), _whole(path, lines, values[:, 1], "the id", _NO_ID)
    corners = values[:, 4:8]
    boxes = _boxes(path, lines, np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1))
    people = kind == "pedestrian"
    if not people.any():
        raise McaptrackError(f"{path} holds no pedestrians, only {', '.join(sorted(set(kind.tolist())))}")
    seen = people.copy()
    if role == "truth":
        seen &= (values[:, 2] <= 0) & (values[:, 3] <= _KITTI_OCCLUDED)
    region = kind == "dontcare"
    left = ~seen & (people | (kind == "person_sitting") | (kind == "person") | region)
    aside = Aside(frame[left], boxes[left], ~region[left], region[left])
    gone = int((~seen).sum())
    return Labels(
        "kitti",
        0,
        frame[seen],
        who[seen],
        boxes[seen],
        None,
        score[seen],
        f"{gone} boxes that don't count (no pedestrians, or hidden or cut off)" if gone else "",
        aside if role == "truth" else None,
    )


def _read_sdd(path: Path, numbered: Sequence[tuple[int, str]], role: Role) -> Labels:
    columns = 'id xmin ymin xmax ymax frame lost occluded generated "label"'
    values, lines = _table(path, numbered, "Stanford Drone annotations", 9, 10, columns)
    labels = np.array([_split(line)[-1].strip('"') for _, line in numbered])
    corners = values[:, 1:5]
    boxes = _boxes(path, lines, np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1))
    lost, other = values[:, 6] != 0, labels != "Pedestrian"
    kept = ~lost & ~other
    if not kept.any():
        raise McaptrackError(f"{path} holds no pedestrians, only {', '.join(sorted(set(labels.tolist())))}")
    gone = [f"{int((other & ~lost).sum())} boxes of others than pedestrians"] if (other & ~lost).any() else []
    gone += [f"{int(lost.sum())} boxes out of sight (lost)"] if lost.any() else []
    return Labels(
        "sdd",
        0,
        _whole(path, lines, values[:, 5], "the frame", 0)[kept],
        _whole(path, lines, values[:, 0], "the id", 0)[kept],
        boxes[kept],
        None,
        np.full(int(kept.sum()), np.nan),
        " and ".join(gone),
    )


def _read_trajnet(path: Path, numbered: Sequence[tuple[int, str]], role: Role) -> Labels:
    values, lines = _table(path, numbered, "TrajNet", 4, 4, "frame id x y")
    return _positions(path, "trajnet", lines, values[:, 0], values[:, 1], values[:, 2:4])


def _read_obsmat(path: Path, numbered: Sequence[tuple[int, str]], role: Role) -> Labels:
    values, lines = _table(path, numbered, "an ETH obsmat", 8, 8, "frame id x z y vx vz vy")
    return _positions(path, "obsmat", lines, values[:, 0], values[:, 1], values[:, [2, 4]])


def _positions(path: Path, name: Format, lines: Ints, frame: Floats, who: Floats, xy_m: Floats) -> Labels:
    return Labels(
        name,
        0,
        _whole(path, lines, frame, "the frame", 0),
        _whole(path, lines, who, "the id", 0),
        None,
        xy_m,
        np.full(len(frame), np.nan),
    )


def _refuse_twins(path: Path, labels: Labels) -> None:
    """Nobody can be in two places in one frame."""
    order = np.lexsort((labels.id, labels.frame))
    frame, who = labels.frame[order], labels.id[order]
    twins = np.flatnonzero((frame[1:] == frame[:-1]) & (who[1:] == who[:-1]))
    if len(twins):
        at = twins[0]
        raise McaptrackError(f"{path}: id {who[at]} appears twice in frame {frame[at]}")


_READERS: Final[dict[str, Callable[[Path, Sequence[tuple[int, str]], Role], Labels]]] = {
    "mot": _read_mot,
    "kitti": _read_kitti,
    "sdd": _read_sdd,
    "trajnet": _read_trajnet,
    "obsmat": _read_obsmat,
}


def read_homography(path: Path) -> tuple[float, ...]:
    """A 3x3 homography, comma or blank separated, as 9 numbers row by row. Raises McaptrackError if it is none."""
    try:
        text = path.read_text(encoding="utf-8")
        rows = [[float(part) for part in _split(line)] for line in text.splitlines() if line.strip()]
    except (UnicodeDecodeError, ValueError):
        raise McaptrackError(f"{path} is no homography: 3 rows of 3 numbers, comma or blank separated") from None
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        shape = " + ".join(str(len(row)) for row in rows) or "no"
        raise McaptrackError(f"{path} is no homography: 3 rows of 3 numbers, not {shape} numbers")
    return tuple(number for row in rows for number in row)
