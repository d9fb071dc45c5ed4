"""Tracks as "CVAT for video 1.1": an XML file that CVAT takes as the annotations of a task with the same pictures.

All boxes are written. Those that CVAT can interpolate between others are no keyframes, so that a person who moves a box
moves its neighbours, too. Letters: N boxes of a track.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.tables.box_files import BoxFile, ExportedBoxes

#: The attribute that keeps the id of a track: CVAT gives tracks new numbers.
TRACK_ID: Final = "track_id"
#: Corners of boxes that are no keyframes are at most this far from where CVAT interpolates them.
KEYFRAME_PX: Final = 1.0
#: Characters that XML can't hold.
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_COLOURS: Final = ("#fa3253", "#3d3df5", "#33ddff", "#ffcc33", "#b83df5", "#24b353", "#ff6a4d", "#8c78f0")


class CvatFile(BoxFile):
    """The file, track by track; a box without an id is a track of one frame."""

    title, end, holds = "CVAT", ".cvat.xml", frozenset({"observed"})

    def content(self, boxes: ExportedBoxes) -> Iterator[bytes]:
        """Yield head, tracks and end."""
        yield _head(boxes).encode("utf-8")
        names = {number: _plain(name) for number, name in boxes.classes.items()}
        order = np.lexsort((boxes.frame, boxes.id)) if boxes.has_ids else np.arange(len(boxes.id))
        key = boxes.id[order] if boxes.has_ids else order
        starts = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
        for number, rows in enumerate(np.split(order, starts[1:])):
            yield _track(boxes, number, rows, names).encode("utf-8")
        yield b"</annotations>\n"

    def remarks(self, boxes: ExportedBoxes) -> Iterable[str]:
        """Say how many boxes get the label of their track."""
        return (describe_classes(boxes),)


def describe_classes(boxes: ExportedBoxes) -> str:
    """Say how many boxes get the label of their track in place of their own class; "" if none do."""
    if not boxes.has_ids:
        return ""
    _, track = np.unique(boxes.id, return_inverse=True)
    _, kind = np.unique(boxes.class_id, return_inverse=True)
    _, most = np.unique(track * (kind.max() + 1) + kind, return_counts=True)
    owner = np.unique(track * (kind.max() + 1) + kind) // (kind.max() + 1)
    largest = np.zeros(track.max() + 1, np.int64)
    np.maximum.at(largest, owner, most)
    others = len(track) - int(largest.sum())
    return f"a track has one label in CVAT: {others:,} boxes get that of their track" if others else ""


def _head(boxes: ExportedBoxes) -> str:
    """The beginning, as in CVAT's own files: the labels, and the number and size of pictures."""
    width, height = boxes.size or np.ceil((boxes.boxes[:, :2] + boxes.boxes[:, 2:]).max(axis=0)).astype(int).tolist()
    labels = "".join(
        f"""
        <label>
          <name>{escape(_plain(name))}</name>
          <color>{_COLOURS[number % len(_COLOURS)]}</color>
          <type>any</type>
          <attributes>{_ATTRIBUTE if boxes.has_ids else ""}</attributes>
        </label>"""
        for number, name in enumerate(boxes.classes.values())
    )
    return f"""<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta>
    <task>
      <name>{escape(_plain(boxes.topic))}</name>
      <size>{boxes.last_frame + 1}</size>
      <mode>interpolation</mode>
      <overlap>0</overlap>
      <start_frame>0</start_frame>
      <stop_frame>{boxes.last_frame}</stop_frame>
      <frame_filter></frame_filter>
      <labels>{labels}
      </labels>
      <original_size>
        <width>{width}</width>
        <height>{height}</height>
      </original_size>
    </task>
  </meta>
"""


_ATTRIBUTE: Final = f"""
            <attribute>
              <name>{TRACK_ID}</name>
              <mutable>False</mutable>
              <input_type>text</input_type>
              <default_value></default_value>
              <values></values>
            </attribute>
          """


def _track(boxes: ExportedBoxes, number: int, rows: Ints, names: dict[int, str]) -> str:
    frame, box, occluded = boxes.frame[rows], boxes.boxes[rows], ~boxes.observed[rows]
    corners = np.concatenate([box[:, :2], box[:, :2] + box[:, 2:]], axis=1)
    kinds, counts = np.unique(boxes.class_id[rows], return_counts=True)
    label = names[int(kinds[counts.argmax()])]
    place = np.searchsorted(boxes.frames, frame)
    is_gap = np.diff(place) > 1
    key = keyframes(frame, corners, occluded, is_gap)
    own = f'<attribute name="{TRACK_ID}">{int(boxes.id[rows[0]])}</attribute>' if boxes.has_ids else ""
    lines = [f'  <track id="{number}" label={quoteattr(label)} source="auto">\n']
    # A track ends after the last box before a gap, and at its own end unless that is the end of the pictures.
    ends = np.append(is_gap, frame[-1] < boxes.last_frame).tolist()
    following = np.append(boxes.frames, 0)[place + 1].tolist()
    columns = (frame.tolist(), corners.tolist(), occluded.tolist(), key.tolist(), ends, following)
    for at, corner, is_hidden, is_key, is_end, after in zip(*columns, strict=True):
        lines.append(_box(at, corner, is_hidden, is_key, False, own))
        if is_end:
            lines.append(_box(after, corner, is_hidden, True, True, own))
    return "".join((*lines, "  </track>\n"))


def _box(frame: int, corner: list[float], is_occluded: bool, is_key: bool, is_outside: bool, own: str) -> str:
    left, top, right, bottom = corner
    return (
        f'    <box frame="{frame}" keyframe="{is_key:d}" outside="{is_outside:d}" occluded="{is_occluded:d}" '
        f'xtl="{left!r}" ytl="{top!r}" xbr="{right!r}" ybr="{bottom!r}" z_order="0">{own}</box>\n'
    )


def keyframes(frame: Ints, corners: Floats, occluded: Bools, is_gap: Bools) -> Bools:
    """Mask the boxes (N,) of a track that linear interpolation needs: the others are within ``KEYFRAME_PX`` of it.

    ``frame`` (N,) rises; ``corners`` (N, 4) are in px; ``is_gap`` (N - 1,) is true between boxes that are not to be
    joined. The first and the last box of each run without gaps are keyframes, and so are those where ``occluded`` (N,)
    changes. Between these, the box that is farthest from the line
    is one, and so on (Ramer, 1972; Douglas and Peucker, 1973).
    """
    changes = np.diff(occluded.astype(int)) != 0
    key = np.zeros(len(frame), bool)
    key[0] = key[-1] = True
    key[:-1] |= is_gap
    key[1:] |= is_gap | changes
    fixed = np.flatnonzero(key)
    waiting = list(zip(fixed[:-1].tolist(), fixed[1:].tolist(), strict=True))
    while waiting:
        low, high = waiting.pop()
        if high - low < 2:
            continue
        share = (frame[low + 1 : high] - frame[low])[:, None] / (frame[high] - frame[low])
        line = corners[low] + share * (corners[high] - corners[low])
        off = np.abs(corners[low + 1 : high] - line).max(axis=1)
        worst = int(off.argmax())
        if off[worst] > KEYFRAME_PX:
            middle = low + 1 + worst
            key[middle] = True
            waiting += [(low, middle), (middle, high)]
    return key


def _plain(text: str) -> str:
    """A text without characters that XML can't hold."""
    return _NOT_XML.sub("?", text)
