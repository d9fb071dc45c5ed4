"""Annotations of CVAT at the limits of what is read: sizes, steps of frames, ids and classes; expected by hand."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange import cvat
from mcaptrack.schema import TRACKS
from mcaptrack.schema.framing import join_frames
from mcaptrack.sources.ingest.label_job import with_new_ids
from mcaptrack.sources.ingest.labels import text as texts
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from tests.commands import done
from tests.label_cases import Row, Writer, by_frame, corners

ALL = WantedClasses("all")


def box(frame: int | str, left: float = 1, more: str = "", inner: str = "", width: float = 10) -> str:
    corners = f'xtl="{left}" ytl="10" xbr="{left + width}" ybr="30"'
    return f'<box frame="{frame}" {corners} keyframe="1" {more}>{inner}</box>\n'


def track(*boxes: str, more: str = 'id="0"', label: str = "person") -> str:
    return f'<track {more} label="{label}">\n{"".join(boxes)}</track>\n'


def own(number: object) -> str:
    return f'<attribute name="track_id">{number}</attribute>'


@pytest.fixture
def read(tmp_path):
    path = tmp_path / "a.xml"

    def read_one(*parts: str, meta: str = "", role: str = "tracks"):
        meta = f"<meta><task>{meta}</task></meta>" if meta else ""
        path.write_text(f"<annotations>\n{meta}{''.join(parts)}</annotations>")
        return read_labels(path, "cvat", role, wanted=ALL)

    return read_one


def refused(read, words: str, *parts: str, **options: str) -> None:
    with pytest.raises(McaptrackError) as error:
        read(*parts, **options)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_sizes_of_files_have_limits(read, monkeypatch, tmp_path):
    three = [track(box(0), more=f'id="{n}"') for n in range(3)]
    monkeypatch.setattr(cvat, "MAX_ROWS", 3)
    assert len(read(*three).id) == 3
    refused(read, "more than 3 boxes, interpolated ones among them; give it in parts", *three, track(box(0)))
    refused(read, "more than 3 boxes, interpolated ones among them", track(box(0), box(3)))
    assert read(track(box(0), box(2))).frame.tolist() == [0, 1, 2]
    monkeypatch.setattr(cvat, "MAX_ROWS", 2)
    refused(read, "more than 2 tracks; give it in parts", *[track() for _ in range(3)])
    size = len((tmp_path / "a.xml").read_bytes())
    monkeypatch.setattr(cvat, "_MAX_BYTES", size)
    blank = " " * (size - len("<annotations>\n</annotations>"))
    refused(read, "holds no boxes", *[track() for _ in range(2)], blank[2 * len(track()) :])
    refused(read, f"there are more than {size} bytes of XML", f"{blank} ")


def test_frames_and_classes_have_limits(read, monkeypatch):
    monkeypatch.setattr(cvat, "_MAX_FRAMES", 5)
    assert len(read(track(box(0), box(5))).id) == 6
    assert read(track(box(0)), track(box(4))).labelled.tolist() == [0, 1, 2, 3, 4]
    refused(read, "5 boxes would be interpolated; at most 5 are", track(box(0), box(6)))
    assert len(read(track(box(0, more='outside="1"'), box(60))).id) == 1
    monkeypatch.setattr(texts, "MAX_NAMES", 2)
    named = read(*(track(box(0), label=label) for label in ("a", " b  c ", "b c")))
    assert named.classes == {2: "a", 3: "b c"}
    refused(read, "more than 2 names", *[track(box(0), label=name) for name in "abc"])
    monkeypatch.setattr(cvat, "_MAX_DEPTH", 5)
    assert len(read(track(box(0, inner="<a><b></b></a>"))).id) == 1
    refused(read, ":3: nested deeper than annotations of CVAT are", track(box(0, inner="<a><b><c/></b></a>")))
    monkeypatch.setattr(cvat, "_MAX_TEXT", 4)
    assert read(track(box(0, inner=own("1234567")))).id.tolist() == [1234]


@pytest.mark.parametrize(
    ("frames", "wanted"),
    [((3, 4), [3, 4]), ((3, 5), [3, 4, 5]), ((0, 3), [0, 1, 2, 3]), ((9, 10, 12), [9, 10, 11, 12])],
)
def test_boxes_between_two_are_one_a_frame(read, frames, wanted):
    found = read(track(*(box(frame, left=10 * frame) for frame in frames)))
    assert found.frame.tolist() == wanted
    assert found.boxes_px[:, 0].tolist() == [10 * frame for frame in wanted]
    assert found.boxes_px[:, 2].tolist() == [10] * len(wanted)
    count = len(wanted) - len(frames)
    words = f"{count} boxes are interpolated between others of their tracks"
    assert [words in one for one in found.remarks] == [True] * bool(count)


STEP = "<frame_filter>step=3</frame_filter>"


@pytest.mark.parametrize(
    ("meta", "boxes", "frames", "labelled"),
    [
        # By the description of the task: the first and the last frame, and the step.
        ("<size>4</size>", (0, 1), [0, 1], [0, 1, 2, 3]),
        ("<start_frame>2</start_frame><size>4</size>", (2, 4), [2, 3, 4], [2, 3, 4, 5]),
        ("<start_frame>2</start_frame><stop_frame>4</stop_frame><size>9</size>", (2, 4), [2, 3, 4], [2, 3, 4]),
        (f"<size>3</size>{STEP}", (0, 6), [0, 3, 6], [0, 3, 6]),
        (f"<start_frame>1</start_frame><stop_frame>9</stop_frame>{STEP}", (1, 7), [1, 4, 7], [1, 4, 7]),
        # Boxes that aren't in its steps are interpolated in each frame.
        (f"<start_frame>1</start_frame><stop_frame>9</stop_frame>{STEP}", (1, 3), [1, 2, 3], None),
        (f"<start_frame>1</start_frame><stop_frame>9</stop_frame>{STEP}", (2, 4), [2, 3, 4], None),
        ("<frame_filter>step=0</frame_filter>", (0, 2), [0, 1, 2], [0, 1, 2]),
        ("<frame_filter>every=2</frame_filter>", (0, 2), [0, 1, 2], [0, 1, 2]),
        # Descriptions that can't be right are not used: frames are those up to the last box.
        ("<start_frame>5</start_frame><stop_frame>4</stop_frame>", (3, 6), [3, 4, 5, 6], [3, 4, 5, 6]),
        ("<start_frame>5</start_frame><stop_frame>5</stop_frame>", (5,), [5], [5]),
        ("<start_frame>0</start_frame><stop_frame>12345678901</stop_frame>", (3, 4), [3, 4], [3, 4]),
        ("<size>x</size>", (3, 4), [3, 4], [3, 4]),
        ("", (3, 5), [3, 4, 5], [3, 4, 5]),
    ],
)
def test_frames_of_a_task(read, meta, boxes, frames, labelled):
    found = read(track(*(box(frame) for frame in boxes)), meta=meta)
    assert (found.frame.tolist(), found.labelled.tolist()) == (frames, frames if labelled is None else labelled)
    said = [words for words, code in found.doubts if code == "clock"]
    assert len(said) == (labelled is None)
    words = "boxes are in frames that its task doesn't have (frames 1 to 9 in steps of 3), as in 2; frames"
    assert labelled or words in said[0]


def test_ids_of_tracks(read):
    numbered = [track(box(0), more=f'id="{n}"') for n in (7, 0, 3)]
    found = read(*numbered)
    assert (found.id.tolist(), found.facts.made_ids) == ([0, 3, 7], None)
    twice = read(*numbered, track(box(1), more='id="7"'))
    assert (twice.id.tolist(), twice.frame.tolist()) == ([0, 1, 2, 3], [0, 0, 0, 1])
    assert any("ids of tracks occur twice; its tracks are counted from 0" in one for one in twice.remarks)
    bare = read(track(box(0), more=""), track(box(0), more=""))
    assert bare.id.tolist() == [0, 1]
    # Of tracks that state one id, the one with most boxes keeps it; then the first. Others get the next ones.
    stated = [track(*(box(frame, inner=own(40)) for frame in range(n))) for n in (1, 2, 2, 1)]
    found = read(*stated, track(box(0, inner=own(50))), track(box(9)))
    rows = sorted(zip(found.id.tolist(), found.frame.tolist(), strict=True))
    assert rows == [(40, 0), (40, 1), (50, 0), (51, 0), (52, 0), (52, 1), (53, 0), (54, 9)]
    assert found.facts.made_ids.tolist() == [51, 52, 53, 54]
    assert any("several tracks state one track_id (40): 3 of them get new ids" in one for one in found.remarks)
    assert any("1 tracks state no track_id and get new ids" in one for one in found.remarks)
    changed = read(track(box(0, inner=own(4)), box(1, inner=own(5)), box(2, inner=own(4)), box(3, inner=own(""))))
    assert changed.id.tolist() == [4] * 4
    assert any("1 tracks change their track_id; the first of each is taken" in one for one in changed.remarks)
    same = read(track(box(0, inner=own(4)), box(1, inner=own(4))))
    assert not any("change their track_id" in one for one in same.remarks)


def test_ids_that_are_no_numbers(read):
    inner = ["1" * 15, "1" * 16, "-1", "1.0", "٣", "x"]
    found = read(*(track(box(0, inner=own(one)), more=f'id="{n}"') for n, one in enumerate(inner)))
    assert max(found.id.tolist()) == int("1" * 15) + 5
    (said,) = [words for words, _ in found.doubts]
    assert f"5 boxes have a track_id that is not a whole number ({inner[1]!r}, '-1', '1.0'); these are not read" in said
    for text in ("1" * 16, "-1", "", "٣"):
        refused(read, "the id of a track is a whole number from 0 on, not", track(box(0), more=f'id="{text}"'))
    refused(read, ":3: the frame of a box is a whole number from 0 on, not '1.5'", track(box("1.5")))
    refused(read, ":4: the frame of a box is 2, and that of the box before is 2", track(box(2), box(2)))
    refused(read, "a.xml:4: ", track(box(0), box(1, width=-3)))


def test_boxes_of_images_and_marks(read):
    words = ("1", "True", "0", "yes")
    boxes = [box(0, more=f'label="car" occluded="{word}"', inner=own(n)) for n, word in enumerate(words)]
    found = read(*(f'<image id="{3 * n}">{one}</image>' for n, one in enumerate(boxes)), '<image id="20"></image>')
    assert (found.frame.tolist(), found.id.tolist()) == ([0, 3, 6, 9], [0, 1, 2, 3])
    assert found.observed.tolist() == [False, False, True, True]
    assert found.labelled.tolist() == [0, 3, 6, 9, 20]
    assert found.classes == {2: "car"}
    refused(read, "holds both tracks and images; CVAT writes one of them", '<image id="0"></image>', track(box(0)))
    turned = [box(n, more=f'rotation="{angle}"') for n, angle in enumerate(("0", "0.0", "00.00", "0.5", "350"))]
    assert [words for words, _ in read(track(*turned)).doubts if "2 boxes are rotated" in words]


def test_classes_are_numbered_by_their_names(read):
    names = ["zebra", "Pedestrian", "unknown", "", "ant", "person"]
    found = read(*(track(box(0, left=n), more=f'id="{n}"', label=name) for n, name in enumerate(names)))
    assert found.class_id.tolist() == [3, 1, 0, 0, 2, 1]
    assert {number: found.classes[number] for number in (2, 3)} == {2: "ant", 3: "zebra"}
    assert found.classes[1] in ("Pedestrian", "person")


def test_the_second_task_of_a_project_is_refused(read):
    one = [track(box(n), more=f'id="{n}" task_id="5"') for n in range(2)]
    assert len(read(*one, track(box(2), more='id="2"')).id) == 3
    refused(read, "tasks 5 and 6 of a project; export each task", *one, track(box(2), more='id="2" task_id="6"'))


def annotations(folder: Path, rows: Sequence[Row]) -> Path:
    """Tracks, whose attribute is the id; a row without one is a track of its own."""
    frames = by_frame(rows)
    parts = ["<annotations><meta><task><size>99</size></task></meta>"]
    for frame, mine in frames.items():
        for row in mine:
            left, top, right, bottom = corners(row)
            own = "" if row.id is None else f'<attribute name="track_id">{row.id}</attribute>'
            parts.append(
                f'<image id="{frame}" width="640" height="480"><box label="{row.kind or ""}" xtl="{left}" ytl="{top}" xbr="{right}" '
                f'ybr="{bottom}">{own}</box></image>'
                if frame not in frames or len(mine) == 1
                else f'<box label="{row.kind or ""}" xtl="{left}" ytl="{top}" xbr="{right}" ybr="{bottom}">{own}</box>'
            )
        if len(mine) > 1:
            parts[-len(mine)] = f'<image id="{frame}" width="640" height="480">' + parts[-len(mine)]
            parts[-1] += "</image>"
    path = folder / "a.xml"
    path.write_text("".join(parts) + "</annotations>")
    return path


WRITERS = {
    "cvat": Writer(annotations, "score numbered", size=True, first="stated"),
}


def test_corrections_made_in_cvat_come_back_and_run_keeps_them(template, tmp_path):
    path = Path(shutil.copy(template, tmp_path / "a.mcap"))
    boxes = mcaptrack.export(path, tmp_path / "a.xml", form="cvat").folder
    text = boxes.read_text()
    unchanged = mcaptrack.ingest(boxes, role="corrections", into=path)
    assert list(unchanged.messages) == ["/camera/corrected"]
    assert unchanged.changes["of"] == "/camera/retracks/full"
    assert [unchanged.changes[name] for name in ("moved", "added", "removed")] == [0, 0, 0]
    # A person draws another one, who nobody found: there in the first 10 pictures, and again from the 21st to the 28th.
    corner = 'xtl="50" ytl="2" xbr="58" ybr="12" occluded="0"'
    drawn = f'<track id="9" label="person"><box frame="0" keyframe="1" outside="0" {corner}/>'
    drawn += "".join(f'<box frame="{k}" outside="{int(k != 20)}" {corner}/>' for k in (10, 20, 28)) + "</track>"
    boxes.write_text(text.replace("</annotations>", drawn + "</annotations>"))
    out = done("ingest", boxes, "--as", "corrections", "--into", path, "--force")
    assert "18 added, new tracks" in " ".join((out.out + out.err).split())
    (new,) = mcaptrack.ingest(boxes, role="corrections", into=path, force=True).changes["new_tracks"]
    assert mcaptrack.info(path).to_json()["channels"]
    with log.read(path) as opened:
        before = len(np.unique(opened.rows("/camera/retracks", TRACKS).rows["track_id"]))
    said = done("run", path, "--no-tables")
    told = said.out + said.err
    assert "corrections of /camera/tracks have changed: running sample again" in " ".join(told.split())
    assert re.search(r"corrected +\d+ boxes of \d+ tracks by people, in 30 pictures", told)
    assert re.search(r"re-tracked .* 0 left out", told)
    assert "/camera/samples  sample  with /camera/corrected" in done("info", path).out
    with log.read(path) as opened:
        topics = "/camera/corrected", "/camera/retracks/full"
        corrected, full = (join_frames(TRACKS, opened.frame_columns(topic, TRACKS)) for topic in topics)
        after = len(np.unique(opened.rows("/camera/retracks", TRACKS).rows["track_id"]))
    assert after == before + 1
    owner: dict[int, set[int]] = {}
    for row, t_ns in zip(corrected.rows, corrected.row_ns, strict=True):
        same = (full.row_ns == t_ns) & (np.abs(full.rows["x_px"] - row["x_px"]) < 1e-6)
        owner.setdefault(int(row["track_id"]), set()).update(full.rows["track_id"][same].tolist())
    assert len(owner[new]) == 1
    assert sorted(len(one) for one in owner.values()) == [1] * len(owner)
    assert len(full.rows) == len(corrected.rows)  # and nothing else
    assert mcaptrack.run(path, tables=False).stages == ()
    (tmp_path / "part.txt").write_text("3,1,2,3,4,5,1,1,1\n4,1,2,3,4,5,1,1,1\n")
    part = mcaptrack.ingest(tmp_path / "part.txt", role="corrections", into=path, force=True)
    assert ["/camera/corrected covered 28 pictures more" in one.message for one in part.warnings] == [True]
    mcaptrack.drop(path, ["/camera/corrected"])
    mcaptrack.run(path, tables=False)
    with log.read(path) as opened, log.read(template) as first:
        assert opened.rows("/camera/retracks", TRACKS).rows.tobytes() == (
            first.rows("/camera/retracks", TRACKS).rows.tobytes()
        )


def test_parts_of_tracks_get_ids_that_no_track_of_the_log_has(template, tmp_path):
    box = '<box frame="{}" xtl="1" ytl="1" xbr="9" ybr="9"><attribute name="track_id">0</attribute></box>'
    parts = "".join(f'<track label="person">{box.format(k)}</track>' for k in (3, 7, 9))
    (tmp_path / "a.xml").write_text(f"<annotations>{parts}</annotations>")
    labels = read_labels(tmp_path / "a.xml", role="corrections")
    assert sorted(labels.id.tolist()) == [0, 1, 2]
    with log.read(Path(template)) as opened:
        found = with_new_ids(opened, "/camera", labels)
        topics = "/camera/tracks", "/camera/retracks/full"
        used = {one for topic in topics for one in opened.rows(topic, TRACKS).rows["track_id"].tolist()}
    assert 1 in used
    assert (found.id[0], len(np.unique(found.id))) == (0, 3)
    assert not used & set(found.id[1:].tolist())
