"""Classes from detections to tables: associated each by itself, named everywhere, and unseen where there is only one."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import mcaptrack
from mcaptrack import foxglove, log, tables
from mcaptrack.errors import McaptrackError
from mcaptrack.pipeline.steps import settle_classes
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.schema.classes import COCO, ClassMap, class_names
from mcaptrack.transforms import PROFILES, ByteTrack, OcSort, Sort
from tests.worlds import assert_same_rows, noisy_tracks, ns, table_to_frames

TRACKERS = {"sort": Sort(), "metres apart": Sort(cost="pixels"), "bytetrack": ByteTrack(), "ocsort": OcSort()}
every_tracker = pytest.mark.parametrize("tracker", TRACKERS.values(), ids=TRACKERS)
every_method = pytest.mark.parametrize("method", PROFILES.values(), ids=PROFILES)


def crossing(seed, classes=(1, 2), count=6, frames=60):
    """Boxes of two classes that cross one another: of each frame the rows, and the object behind each row."""
    rng = np.random.default_rng(seed)
    start, speed = rng.uniform(0, 300, (count, 2)), rng.uniform(-5, 5, (count, 2))
    of = np.resize(classes, count)
    out, truth = [], []
    for t in range(frames):
        there = rng.permutation(np.flatnonzero(rng.random(count) > 0.1))
        x, y = (start + speed * t + rng.normal(0, 1.5, (count, 2)))[there].T
        size = np.full(len(there), 60.0)
        score = rng.uniform(0.2, 1.0, len(there))
        rows = DETECTIONS.rows(x_px=x, y_px=y, w_px=size, h_px=1.5 * size, score=score, class_id=of[there])
        out.append(Frame(t * 100_000_000, t, rows))
        truth.append(there)
    return out, truth


def of_class(frames, one):
    return [frame._replace(rows=frame.rows[frame.rows["class_id"] == one]) for frame in frames]


def joined(frames):
    """Rows with their frame, whatever their ids: ids become the first row of each track."""
    rows = np.concatenate([frame.rows for frame in frames])
    at = np.repeat(np.arange(len(frames)), [len(frame.rows) for frame in frames])
    order = np.lexsort((*(rows[name] for name in ("y_px", "x_px", "y_m", "x_m") if name in rows.dtype.names), at))
    rows, at = rows[order].copy(), at[order]
    _, first, which = np.unique(rows["track_id"], return_index=True, return_inverse=True)
    rows["track_id"] = first[which]
    return rows, at


def same_but_for_ids(found, wanted):
    (one, at), (other, there) = joined(found), joined(wanted)
    assert at.tolist() == there.tolist()
    for name in one.dtype.names:
        np.testing.assert_allclose(one[name], other[name], rtol=1e-9, err_msg=name)


def both(*parts):
    together = zip(*parts, strict=True)
    return [frames[0]._replace(rows=np.concatenate([frame.rows for frame in frames])) for frames in together]


def renamed(frames, places):
    out = []
    for frame in frames:
        rows = frame.rows.copy()
        rows["class_id"] = [places[one] for one in rows["class_id"].tolist()]
        out.append(frame._replace(rows=rows))
    return out


# Trackers


@every_tracker
def test_each_class_is_tracked_as_if_it_were_alone(tracker):
    for seed in range(2):
        frames, _ = crossing(seed)
        together = [made for (made,) in tracker(frames)]
        alone = [[made for (made,) in tracker(of_class(frames, one))] for one in (1, 2)]
        apart = [frame._replace(rows=frame.rows.copy()) for frame in alone[1]]
        for frame in apart:
            frame.rows["track_id"] += 1000
        same_but_for_ids(together, both(alone[0], apart))
        assert {1, 2} == {int(one) for frame in together for one in frame.rows["class_id"]}


@every_tracker
def test_numbers_of_classes_have_no_influence(tracker):
    frames, _ = crossing(5)
    places = {1: 4_000_000_000, 2: 0}
    found, wanted = ([made for (made,) in tracker(some)] for some in (renamed(frames, places), frames))
    for one, other in zip(found, renamed(wanted, places), strict=True):
        for name in one.rows.dtype.names:
            np.testing.assert_array_equal(one.rows[name], other.rows[name])


def test_across_classes_a_track_has_the_class_of_most_of_its_detections():
    box = {"x_px": [100.0], "y_px": [50.0], "w_px": [40.0], "h_px": [120.0]}
    of = [2, 1, 1, 2, 1, 1, 1, 2]
    frames = [Frame(t * 100_000_000, t, DETECTIONS.rows(class_id=[one], **box)) for t, one in enumerate(of)]
    tracker = Sort(min_hits_s=0.0, across_classes=True)
    raw = [made for (made,) in tracker(frames)]
    assert [int(frame.rows["class_id"][0]) for frame in raw] == of
    with pytest.warns(UserWarning, match="1 of 1 tracks have detections of several classes"):
        settled = settle_classes(raw)
    assert [frame.rows["class_id"].tolist() for frame in settled] == [[1]] * 8
    assert [frame.rows["x_px"].tolist() for frame in settled] == [frame.rows["x_px"].tolist() for frame in raw]
    tie = [frame._replace(rows=frame.rows.copy()) for frame in raw[:6]]
    for frame, one in zip(tie, [5, 3, 3, 5, 3, 5], strict=True):
        frame.rows["class_id"] = one
    with pytest.warns(UserWarning, match="several classes"):
        assert [frame.rows["class_id"].tolist() for frame in settle_classes(tie)] == [[5]] * 6  # it was the first
    apart = [made.rows["track_id"].tolist() for (made,) in Sort(min_hits_s=0.0)(frames)]
    assert {one for ids in apart for one in ids} == {1, 2}


# Re-tracking


def samples_of_two_classes(seed, numbers=(1, 2)):
    """Tracks of two crowds in one place, at the rate of samples, with gaps and swapped ids within each."""
    out = []
    for part, number in enumerate(numbers):
        frames = noisy_tracks(np.random.default_rng(seed + 100 * part), ticks=40, hidden=0.05)
        for frame in frames:
            frame.rows["class_id"] = number
            frame.rows["track_id"] += 1000 * part
        out.append([frame._replace(t_ns=time.t_ns) for frame, time in zip(frames, (out or [frames])[0], strict=True)])
    return out


@every_method
def test_each_class_is_retracked_as_if_it_were_alone(method):
    parts = samples_of_two_classes(3)
    together = list(zip(*method(both(*parts)), strict=True))
    alone = [list(zip(*method(part), strict=True)) for part in parts]
    last = max(int(frame.rows["track_id"].max(initial=0)) for output in alone[0] for frame in output)
    for found, first, second in zip(together, *alone, strict=True):
        for frame in second:
            frame.rows["track_id"] += np.where(frame.rows["track_id"] < 0, 0, last)  # those left out have none
        for frame, one, other in zip(found, first, second, strict=True):
            assert_same_rows(frame.rows, np.concatenate([one.rows, other.rows]))
    assert {1, 2} == {int(one) for frame in together[0] for one in frame.rows["class_id"]}


@every_method
def test_numbers_of_classes_have_no_influence_on_retracking(method):
    places = {1: 9, 2: 1}
    frames = both(*samples_of_two_classes(4))
    found, wanted = (list(zip(*method(some), strict=True)) for some in (renamed(frames, places), frames))
    for output, others in zip(found, wanted, strict=True):
        has_classes = "class_id" in output[0].rows.dtype.names
        for frame, other in zip(output, renamed(others, places) if has_classes else others, strict=True):
            assert_same_rows(frame.rows, other.rows)


def walk_in_two_pieces(second):
    """A walk with a new id, and perhaps another class, in its middle."""

    def row(t):
        ids, number = ([7], 1) if t < 10 else ([8], second)
        return TRACKS.rows(
            track_id=ids, x_m=[t / 2], y_m=[0.0], observed=[True], source_id=[-1], class_id=[number],
            x_px=[t * 5.0], y_px=[0.0], w_px=[10.0], h_px=[20.0],
        )  # fmt: skip

    return [Frame(ns(t / 2.5), t, row(t)) for t in range(24)]


def test_links_join_no_two_classes_but_across_classes():
    method = replace(PROFILES["default"], track_confidence=0.0)

    def ids(frames, **options):
        made = [found for found, *_ in replace(method, **options)(frames)]
        return {(int(row["track_id"]), int(row["class_id"])) for frame in made for row in frame.rows}

    assert {one for _, one in ids(walk_in_two_pieces(2))} == {1, 2}
    assert len(ids(walk_in_two_pieces(1))) == 1
    assert ids(walk_in_two_pieces(2), across_classes=True) == {(1, 2)}  # 14 of 24 samples


# Logs and tables


def written(path, number, names=None, other=None):
    """A log of one object, or of two, tracked; returns the metadata and messages of the tracks."""
    with mcaptrack.open(path, create=True) as opened:
        frames = []
        for t in range(12):
            boxes, classes = [[10 + 2 * t, 20, 30, 60]], [number]
            if other is not None:
                boxes, classes = [*boxes, [200 - 2 * t, 90, 30, 60]], [*classes, other]
            frames.append(mcaptrack.detections(boxes, None, classes, t * 100_000_000, box_format="xywh"))
        opened.write("/camera/detections", frames, classes=names)
    mcaptrack.track(path)
    with log.read(path) as opened:
        there = opened.channel("/camera/tracks").metadata
        return there, [message.payload for message in opened.messages("/camera/tracks")]


def test_rows_of_one_class_are_the_same_as_without_classes(tmp_path):
    """Without its later fields a schema is as it was: messages have the bytes that they had before there were classes."""
    without, plain = written(tmp_path / "plain.mcap", 0)
    assert "mcaptrack.class_id" not in without
    digests = {without["mcaptrack.digest"]}
    assert len(plain[-1]) == 81  # a row of ten fields, in bytes counted by hand
    for number in (1, 2, 4_000_000_000):
        metadata, payloads = written(tmp_path / f"{number}.mcap", number)
        assert payloads == plain
        assert metadata["mcaptrack.class_id"] == str(number)
        with log.read(tmp_path / f"{number}.mcap") as opened:
            assert np.unique(opened.rows("/camera/tracks", TRACKS).rows["class_id"]).tolist() == [number]
            assert {int(one) for f in opened.frames("/camera/tracks", TRACKS) for one in f.rows["class_id"]} == {number}
        digests.add(metadata["mcaptrack.digest"])
    assert len(digests) == 3  # that of people is the one from before; what is made from others is then out of date


def test_names_go_from_detections_to_tables(tmp_path):
    path = tmp_path / "a.mcap"
    metadata, payloads = written(path, 1, {1: "person", 7: "vélo \"quoted\" 'ß' 自転車"}, 7)
    name = class_names(metadata)[7]
    assert name.endswith("自転車")
    assert "mcaptrack.class_id" not in metadata
    assert len(payloads[-1]) == 2 * 86
    with mcaptrack.open(path) as opened:
        for table in ("detections", "tracks", "track_summary"):
            rows = opened.table(table).to_pylist()
            assert {(row["class_id"], row["class"]) for row in rows} == {(1, "person"), (7, name)}
        assert str(opened.table("tracks").schema.field("class").type).startswith("dictionary<values=string")
        table, array = opened.table("tracks"), opened.array("tracks")
    with mcaptrack.open(tmp_path / "b.mcap", create=True) as back:
        for topic, rows in (("/a/tracks", table), ("/b/tracks", array), ("/c/tracks", table.to_pandas())):
            back.write(topic, rows)
            with log.read(tmp_path / "b.mcap") as raw:
                assert json.loads(raw.channel(topic).metadata["mcaptrack.classes"]) == {"1": "person", "7": name}
    mcaptrack.export(path, tmp_path / "t", form="csv")
    assert "自転車" in next((tmp_path / "t").glob("tracks/*/*.csv")).read_text()


def two_tracks(path, first, second, names):
    """A log with two tracks of these classes, in boxes of pixels and in metres."""
    frames = [
        Frame(t * 100_000_000, t, TRACKS.rows(
            track_id=[3, 12], x_px=[9.0 + t, 60.0], y_px=[20.0, 5.0], w_px=[17.0] * 2, h_px=[28.0] * 2, x_m=[t / 9, 3.0],
            y_m=[0.0, 1.0], score=[0.5, 0.25], observed=[True] * 2, source_id=[-1] * 2, class_id=[first, second],
        ))
        for t in range(3)
    ]  # fmt: skip
    with mcaptrack.open(path, create=True) as opened:
        opened.write("/camera/tracks", frames, classes=names)
    return path


def texts_of(path, topic):
    """The texts of the views on the ground, by another reader of protobuf."""
    with log.read(path) as opened:
        channel = opened.channel(topic)
        message = foxglove.message_class(channel.schema_name)()
        for one in opened.messages(topic):
            message.ParseFromString(one.payload)
            yield sorted(text.text for entity in message.entities for text in entity.texts)


def test_labels_name_the_class_where_there_are_several(tmp_path):
    name = "motorcycle with a side car 自転車"
    two = two_tracks(tmp_path / "two.mcap", 1, 7, {7: name})
    assert list(texts_of(two, "/camera/tracks/view/scene"))[1] == [f"T12 {name[:19]}\u2026", "T3 person"]
    one = two_tracks(tmp_path / "one.mcap", 7, 7, {7: name})
    assert list(texts_of(one, "/camera/tracks/view/scene"))[1] == ["T12", "T3"]
    unnamed = two_tracks(tmp_path / "unnamed.mcap", 0, 9, None)
    assert list(texts_of(unnamed, "/camera/tracks/view/scene"))[1] == ["T12 class 9", "T3 unknown"]


def supervision(xyxy, **columns):
    """What supervision.Detections has, as far as it is read."""
    return SimpleNamespace(**{"xyxy": xyxy, "mask": None, "tracker_id": None, "data": {}} | columns)


def test_names_go_into_supervision_and_back(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", SimpleNamespace(Detections=supervision))
    path = two_tracks(tmp_path / "a.mcap", 1, 7, {7: "cart"})
    with mcaptrack.open(path) as opened:
        found = dict(opened.supervision("tracks"))
    assert found[0].data["class_name"].tolist() == ["person", "cart"]
    assert found[0].class_id.tolist() == [1, 7]
    with mcaptrack.open(tmp_path / "b.mcap", create=True) as back:
        for table in ("tracks", "detections"):
            with pytest.warns(UserWarning, match="name their classes"):
                back.write(f"/own/{table}", found)
            assert {row["class"] for row in back.table(table).to_pylist()} == {"person", "cart"}
    plain = two_tracks(tmp_path / "c.mcap", 1, 1, None)
    with mcaptrack.open(plain) as opened:
        assert all(boxes.data == {} for _, boxes in opened.supervision("tracks"))


def test_classes_of_detections_are_given_by_name():
    names = {1: "person", 6: "bus", 8: "bus"}
    boxes = [[1, 2, 3, 4]] * 3
    found = mcaptrack.detections(boxes, None, ["bus", "human", "bus"], box_format="xywh", class_names=names)
    assert found.rows["class_id"].tolist() == [6, 1, 6]
    found = mcaptrack.detections(boxes, None, [8, 1, 6], box_format="xywh", class_names=names)
    assert found.rows["class_id"].tolist() == [8, 1, 6]
    with pytest.raises(McaptrackError, match="`class_names=` has no class 'tram'; it has bus, person"):
        mcaptrack.detections(boxes, None, ["tram"] * 3, box_format="xywh", class_names=names)


def test_tables_without_a_class_column_are_read_as_before(tmp_path):
    rows = TRACKS.rows(track_id=[1], x_m=[1.0], y_m=[2.0], observed=[True], source_id=[-1], class_id=[3])
    frames = [Frame(1, 0, rows)]
    new = tables.rows_in_pieces(TRACKS, {"/a": frames}, {"/a": {3: "cart"}}).table()
    old = new.drop_columns(["class_id", "class"])
    assert new.to_pylist()[0]["class"] == "cart"
    places = tables.frames_table("/a", tables.Pointers("f", *(np.array([n]) for n in (1, 0, 1, 0, 0))))
    assert table_to_frames(TRACKS, old, places, "/a")[0].rows["class_id"].tolist() == [0]
    assert table_to_frames(TRACKS, new, places, "/a")[0].rows["class_id"].tolist() == [3]


def test_names_that_cant_be_are_refused(tmp_path):
    rows = [mcaptrack.detections([[1, 2, 3, 4]], t_ns=0, box_format="xywh")]
    cases = [({2: name}, "the name of class 2 is printable text") for name in ("", "a\nb", "\ud800", 3)]
    cases += [({number: "x"}, "a class is a whole number from 0") for number in (-1, 2**32, "2")]
    cases += [({1: "car"}, "class 1 is a person; give 'car' another number"), (["x"], "`classes=` is a mapping")]
    cases += [({2: "x" * 201}, "the name of class 2 is printable text of at most 200 characters")]
    with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
        for classes, words in cases:
            with pytest.raises(McaptrackError, match=words) as caught:
                opened.write("/a/detections", rows, classes=classes)
            assert "\n" not in str(caught.value)


def test_a_thousand_classes_of_one_name_and_strange_metadata_are_read(tmp_path):
    names = {number: "thing" if number % 2 else f"thing {number}" for number in range(2, 1002)}
    path = tmp_path / "a.mcap"
    boxes = np.stack([np.arange(1000) * 50.0, np.zeros(1000), np.full(1000, 20.0), np.full(1000, 30.0)], axis=-1)
    with mcaptrack.open(path, create=True) as opened:
        frames = [mcaptrack.detections(boxes, None, [*names], t * 100_000_000, box_format="xywh") for t in range(8)]
        opened.write("/camera/detections", frames, classes=names)
    mcaptrack.track(path)
    with mcaptrack.open(path) as opened:
        rows = opened.table("track_summary").to_pylist()
    assert {row["class_id"]: row["class"] for row in rows} == names
    strange = {"1": "human", "x": "a", "٣": "b", "9" * 5000: "c", "7": "", "8": 3, "9": "ok", "4294967296": "d"}
    assert class_names({"mcaptrack.classes": json.dumps(strange)}) == {1: "human", 9: "ok"}
    assert class_names({"mcaptrack.classes": '{"2": "\\ud800"}'})[2].encode() == b"\\ud800"
    for text in ("[1]", "{", "[" * 100_000, "null"):
        assert class_names({"mcaptrack.classes": text}) == {1: "person"}


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("0=person,2=car", {0: "person", 2: "car", "2": "car", "002": "car", 1: None}),
        ("ped = person, Auto=car,", {"ped": "person", "PED": "person", "auto": "car", "car": None}),
        ('{"a,b": "car=s"}', {"a,b": "car=s"}),
        ("coco", {0: "person", 2: "car", 79: "toothbrush", 80: None, 12: "parking meter", 58: "potted plant"}),
        ("names.txt", {0: "person", 1: None, 2: "car", 3: None}),
        ("names.txt@1", {0: None, 1: "person", 3: "car"}),
        ("numbers.txt", {0: None, 7: "person", 9: "big car"}),
    ],
)
def test_a_class_map_names_classes_and_its_text_names_the_same(tmp_path, monkeypatch, text, wanted):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "names.txt").write_bytes(b"\xef\xbb\xbfperson\r\n\r\n car \r\n\r\n")
    (tmp_path / "numbers.txt").write_text("7: person\n9 big car\n")
    read = ClassMap.parse(text)
    assert {own: read.name(own) for own in wanted} == wanted
    assert ClassMap.parse(str(read)) == read
    assert "txt" not in str(read)
    assert len(COCO) == len(set(COCO)) == 80


@pytest.mark.parametrize("text", ["", " ", "person", "0=", "=car", "0=car,0=bus", "A=x,a=y", "{", "{}", "[1]", "a\0b",
                                  "x" * 5000, "binary.txt", "zeros.txt", "empty.txt", ".", "twice.txt"])  # fmt: skip
def test_what_is_no_class_map_is_refused_in_a_line(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    contents = {"binary": b"\xff\xfe\0", "zeros": bytes(99), "empty": b"\n \n", "twice": b"0=car\n0=bus\n"}
    for name, content in contents.items():
        (tmp_path / f"{name}.txt").write_bytes(content)
    with pytest.raises(McaptrackError) as raised:
        ClassMap.parse(text)
    assert "\n" not in str(raised.value)
