"""Events of tracks: what is said of them, what they are compared with, and the channels in a log."""

from __future__ import annotations

import re
from itertools import chain, groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log as LogMessage
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack import log, notices, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate, sequence_of_log
from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.event_text import describe, log_messages
from mcaptrack.evaluation.events import EventOptions, MatchRule, find_events, lifecycle_of
from mcaptrack.evaluation.metrics import matches
from mcaptrack.pipeline.checks import describe_origin
from mcaptrack.schema import COUNTS, EVENT_KINDS, EVENTS, TRACKS, EventKind, Frame, framing
from mcaptrack.schema.proto import parse
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.transforms import PROFILES
from tests.logs import provenance_of
from tests.worlds import boxed, ns, replace_channel, tracks_at, walk, write_channels

BIRTH, END, MISS, FALSE, SWITCH = (
    EventKind.BIRTH, EventKind.END, EventKind.MISS, EventKind.FALSE_TRACK, EventKind.SWITCH,
)  # fmt: skip


def happened(found) -> list[tuple]:
    """(seconds, kind, track, person, previous) of all events."""
    return [
        (
            frame.t_ns / 1e9,
            EventKind(row["kind"]),
            *(int(row[name]) for name in ("track_id", "truth_id", "previous_id")),
        )
        for frame in found.events
        for row in frame.rows
    ]


def rows_of(found, kind):
    rows = np.concatenate([frame.rows for frame in found.events])
    return rows[rows["kind"] == kind]


def counted(found, name) -> list:
    return [frame.rows[name].item() for frame in found.counts]


def said(found, start_ns=0) -> list[tuple[str, str]]:
    """Level and words of the messages."""
    messages = [
        LogMessage.FromString(data) for *_, data in log_messages(found.events, "/t", start_ns, found.frame_interval_s)
    ]
    return [
        (LogMessage.DESCRIPTOR.fields_by_name["level"].enum_type.values_by_number[m.level].name, m.message)
        for m in messages
    ]


def follow(path, source, ticks, rate_hz=10.0) -> list[Frame]:
    """Frames of re-tracked tracks; ``source`` gives the source of each track at every tick, -1 for none."""
    frames = []
    for tick in range(ticks):
        rows = tracks_at(path(tick))
        rows["source_id"] = [source(tick)[who] for who in path(tick)]
        frames.append(Frame(ns(tick / rate_hz), tick, rows))
    return frames


# What is said; that events and counts are the right ones is tested at the end


TWO = walk(lambda n: {1: (n / 10, 0.0), 2: (n / 10, 4.0)}, 60, 10)
ONE = walk(lambda n: {4: (n / 10, 2.0)}, 80, 10)


def seen(*gone: int) -> list[Frame]:
    """Track 1 of person 4, but in some frames."""
    return walk(lambda n: {} if n in gone else {1: (n / 10, 2.0)}, 80, 10)


def in_place(source) -> list[Frame]:
    """Tracks 1 and 2, 2 m apart."""
    return follow(lambda n: {1: (n / 10, 0.0), 2: (n / 10, 2.0)}, source, 60)


def joined_and_parted() -> list[Frame]:
    """Track 1 continues from source 5 to 8 after a gap of 0.5 s; source 5 continues as the new track 2."""
    path = lambda n: {1: (n / 10, 0.0)} | ({2: (n / 10, 6.0)} if n >= 40 else {})  # noqa: E731
    return follow(path, lambda n: {1: 5 if n < 20 else -1 if n < 25 else 8, 2: 5}, 60)


BEGINS = ("INFO", "track 1 begins at 0.00 s, (0.0, 2.0) m")
#: Ground truth, tracks, and all messages about them.
SAID = {
    "two people swap their tracks": (
        TWO,
        walk(lambda n: {(7 if n < 10 else 8): (n / 10, 0.0), (8 if n < 10 else 7): (n / 10, 4.0)}, 60, 10),
        [
            ("INFO", "track 7 begins at 0.00 s, (0.0, 0.0) m"),
            ("INFO", "track 8 begins at 0.00 s, (0.0, 4.0) m"),
            ("ERROR", "person 2: track 8 became track 7 at 1.00 s, (1.0, 4.0) m"),
            ("ERROR", "person 1: track 7 became track 8 at 1.00 s, (1.0, 0.0) m"),
        ],
    ),
    "a second is not brief": (
        ONE,
        seen(*range(20, 30)),
        [BEGINS, ("WARNING", "person 4 is missed for 1.0 s at 2.00 s, (2.0, 2.0) m, last tracked as 1")],
    ),
    "nine frames are": (
        ONE,
        seen(*range(20, 29)),
        [BEGINS, ("DEBUG", "person 4 is missed for 0.9 s at 2.00 s, (2.0, 2.0) m, last tracked as 1")],
    ),
    "a short interruption does not split a miss": (
        ONE,
        seen(20, 21, 22, 26, 27, 28, 50),
        [
            BEGINS,
            ("DEBUG", "person 4 is missed in 6 of 9 frames over 0.9 s at 2.00 s, (2.0, 2.0) m, last tracked as 1"),
            ("DEBUG", "person 4 is missed for 0.1 s at 5.00 s, (5.0, 2.0) m, last tracked as 1"),
        ],
    ),
    "a false track begins and ends without saying": (
        ONE,
        walk(lambda n: {1: (n / 10, 2.0)} | ({9: (3.0, 30.0)} if 10 <= n < 30 else {}), 80, 10),
        [BEGINS, ("WARNING", "track 9 matches no person while it exists, for 2.0 s at 1.00 s, (3.0, 30.0) m")],
    ),
    "a track that drifts off and comes back": (
        ONE,
        walk(lambda n: {1: (n / 10, 2.0 + 5 * (20 <= n < 40))}, 80, 10),
        [BEGINS, ("WARNING", "person 4 and track 1 are apart for 2.0 s at 2.00 s, (2.0, 2.0) m")],
    ),
    "a track alone": (
        None,
        walk(lambda n: {1: (n / 10, 2.0)} if 20 <= n < 30 else {}, 80, 10),
        [
            ("INFO", "track 1 begins at 2.00 s, (2.0, 2.0) m"),
            ("INFO", "track 1 ends at 2.90 s, (2.9, 2.0) m, after 1.0 s"),
        ],
    ),
    "a brief one": (
        None,
        walk(lambda n: {1: (n / 10, 2.0)} if 20 <= n < 29 else {}, 80, 10),
        [("DEBUG", "track 1 exists for 0.9 s at 2.00 s, (2.0, 2.0) m")],
    ),
    "boxes have positions in pixels": (
        None,
        [Frame(0, 0, boxed({3: (20.0, 40.0)})), Frame(ns(2), 1, boxed({3: (20.0, 40.0)}))],
        [("INFO", "track 3 begins at 0.00 s, (25, 50) px")],
    ),
    "repairs join and part tracks": (
        None,
        joined_and_parted(),
        [
            ("INFO", "track 1 begins at 0.00 s, (0.0, 0.0) m"),
            ("WARNING", "track 1 joins the tracker's 5 and 8 at 2.50 s, (2.5, 0.0) m, 0.5 s unseen"),
            ("INFO", "track 2 begins at 4.00 s, (4.0, 6.0) m"),
            ("WARNING", "track 2 takes over the tracker's 5, which was track 1, at 4.00 s, (4.0, 6.0) m"),
        ],
    ),
    "an undone swap is one message": (
        None,
        in_place(lambda n: {1: 5 if n < 30 else 6, 2: 6 if n < 30 else 5}),
        [
            ("INFO", "track 1 begins at 0.00 s, (0.0, 0.0) m"),
            ("INFO", "track 2 begins at 0.00 s, (0.0, 2.0) m"),
            ("WARNING", "tracks 1 and 2: the tracker swapped its 5 and 6 at 3.00 s, (3.0, 0.0) m"),
        ],
    ),
}


@pytest.mark.parametrize(("truth", "tracks", "messages"), SAID.values(), ids=SAID)
def test_what_is_said(truth, tracks, messages):
    assert said(find_events(tracks, truth)) == messages


# What is compared with what


def test_boxes_at_video_rate_match_by_overlap_and_others_by_metres():
    boxes = [Frame(ns(n / 10), n, boxed({1: (n * 1.0, 0.0)})) for n in range(30)]
    assert find_events(boxes, boxes).rule == MatchRule("iou", 0.5)
    metres = walk(lambda n: {1: (n / 10, 0.0)}, 30, 10)
    assert find_events(metres, metres).rule == MatchRule("metres", 1.0)
    both = [Frame(f.t_ns, f.index, g.rows.copy()) for f, g in zip(boxes, metres, strict=True)]
    for frame, other in zip(both, boxes, strict=True):
        for name in ("x_px", "y_px", "w_px", "h_px"):
            frame.rows[name] = other.rows[name]
    assert find_events(both, both).rule == MatchRule("iou", 0.5)
    slow = [Frame(frame.t_ns + 10_000_000, n, frame.rows) for n, frame in enumerate(both[::4])]
    assert find_events(slow, both).rule == MatchRule("metres", 1.0)
    assert find_events(both, both, EventOptions("metres", 0.3)).rule == MatchRule("metres", 0.3)


def test_tracks_at_more_times_than_the_truth_have_counts_there_and_no_scores():
    truth = walk(lambda n: {1: (float(n), 0.0)}, 10)
    tracks = [Frame(ns(n / 30), n, tracks_at({5: (n / 12, 0.0)})) for n in range(9 * 12 + 1)]
    found = find_events(tracks, truth)
    assert happened(found) == [(0.0, BIRTH, 5, -1, -1)]
    assert len(found.counts) == len(tracks)
    assert [n for n, value in enumerate(counted(found, "mota")) if not np.isnan(value)] == list(range(0, 109, 12))
    assert counted(found, "tracked") == [1] * 109


@pytest.mark.parametrize(
    ("truth", "options", "words"),
    [
        ([Frame(ns(n), n, tracks_at({})) for n in range(5)], EventOptions(), "the ground truth is empty"),
        (
            [Frame(ns(900 + n), n, tracks_at({1: (0.0, 0.0)})) for n in range(5)],
            EventOptions(),
            "the ground truth (900.000 to 904.000 s) and /t (0.000 to 3.900 s) never overlap in time",
        ),
        (
            [Frame(ns(n / 10), n, boxed({1: (0.0, 0.0)})) for n in range(40)],
            EventOptions(),
            "/t and the ground truth share neither boxes nor positions in metres",
        ),
        ([Frame(ns(n / 10), n, tracks_at({1: (0.0, 0.0)})) for n in range(40)], EventOptions("iou"), "have no boxes"),
        (
            [Frame(ns(n / 10), n, tracks_at({1: (5000.0 * n, 900.0)})) for n in range(40)],
            EventOptions(),
            "they are not in the same unit",
        ),
    ],
)
def test_ground_truth_that_cannot_be_compared_is_reported_and_left_out(truth, options, words):
    tracks = walk(lambda n: {1: (n / 10, 0.0)}, 40, 10)
    found = find_events(tracks, truth, options, "a", "/t")
    (note,) = found.notes
    assert words in note
    assert found.rule is None
    assert {kind for _, kind, *_ in happened(found)} == {BIRTH}
    assert len(found.counts) == 40


def test_who_stands_far_from_all_tracks_is_missed_and_not_in_another_unit():
    standing = walk(lambda n: {1: (50 + n / 1000, 0.0)}, 40, 10)
    found = find_events(walk(lambda n: {1: (n / 10, 0.0)}, 40, 10), standing, EventOptions(), "a", "/t")
    assert list(found.notes) == ["a: /t and the ground truth never come near each other"]
    assert MISS in {kind for _, kind, *_ in happened(found)}


@pytest.mark.parametrize("truth", [None, []])
def test_no_tracks_have_no_events(truth):
    found = find_events([], truth)
    assert (found.events, found.counts) == ([], [])
    empty = find_events(walk(lambda _: {}, 3), truth)
    assert [len(frame.rows) for frame in empty.events] == [0, 0, 0]
    assert counted(empty, "tracked") == [0, 0, 0]


def test_names_of_event_kinds_equal_the_schema():
    path = Path(__file__).parent.parent / "schemas" / "Events.proto"
    (kind,) = [column for column in parse(path.read_text(), path.name).columns if column.name == "kind"]
    assert dict(re.findall(r"(\d+) ([a-z ]+)", kind.doc)) == {str(int(k)): words for k, words in EVENT_KINDS.items()}
    assert set(EVENT_KINDS) == set(EventKind)
    numbers = {"MISS": 2, "FALSE_TRACK": 3, "SWITCH": 4, "BIRTH": 5, "END": 6, "JOINED": 7, "PARTED": 8}
    assert {kind.name: int(kind) for kind in EventKind} == numbers  # as logs have them


# Laws

PEOPLE = st.dictionaries(st.integers(1, 4), st.tuples(st.integers(0, 4), st.integers(0, 2)), max_size=4)


@st.composite
def scenes(draw) -> tuple[list[Frame], list[Frame]]:
    """Truth and tracks that come, go and swap as they like, in boxes and metres, each person in a place of their own."""

    def frames(count: int) -> list[Frame]:
        out = []
        for number in range(count):
            people = {who: (10.0 * x, 20.0 * y) for who, (x, y) in draw(PEOPLE).items()}
            rows = boxed(people)
            rows["x_m"], rows["y_m"] = rows["x_px"] / 10 + 0.01 * rows["track_id"], rows["y_px"] / 20
            out.append(Frame(ns(number * 0.4), number, rows))
        return out

    count = draw(st.integers(1, 12))
    return frames(count), frames(draw(st.integers(count // 2 + 1, count)))


@pytest.mark.parametrize("similarity", ["iou", "metres"])
@given(scene=scenes())
def test_events_and_counts_add_up_to_the_scores(similarity, scene):
    truth, tracks = scene
    if not any(len(frame.rows) for frame in truth):
        return
    gate = 0.5 if similarity == "iou" else 1.0
    found = find_events(tracks, truth, EventOptions(similarity, gate, gate))
    options = EvaluateOptions(similarities=(similarity,), gates_m=(gate,), min_iou=gate)
    (result,) = evaluate([EvaluationInput("x", truth, [Candidate("t", None, tracks)])], options).results
    score = result.to_json()
    assert len(rows_of(found, SWITCH)) == counted(found, "switches")[-1] == score["IDSW"]
    assert rows_of(found, MISS)["frames"].sum() == sum(counted(found, "misses")) == score["FN"]
    assert rows_of(found, FALSE)["frames"].sum() == sum(counted(found, "false_tracks")) == score["FP"]
    assert sum(counted(found, "matches")) + score["FN"] == sum(counted(found, "people"))
    assert counted(found, "mota")[-1] == pytest.approx(score["MOTA"], abs=1e-12)
    ids = {who for frame in tracks for who in frame.rows["track_id"].tolist()}
    assert len(rows_of(found, BIRTH)) == counted(found, "born")[-1] == len(ids)
    assert sum(counted(found, "tracked")) == sum(len(frame.rows) for frame in tracks)
    assert len(said(found)) <= len(np.concatenate([frame.rows for frame in found.events]))


# In a log


def watched(path: Path, *topics: str, again: bool = False, output: Path | None = None, **options):
    """What ``run`` does at the end, and ``mcaptrack events`` with ``again``."""
    heard: list[notices.Notice] = []
    with log.read(path) as opened, notices.listening(heard.append):
        watch = pipeline.Watch(EventOptions(**options), topics, again)
        report = pipeline.run(opened, "/camera", [], output, finishing=[watch])
    assert report.warnings == heard
    return report, [notice.message for notice in heard]


TRUTH = walk(lambda n: {1: (n / 10, 0.0), 2: (n / 10, 4.0)}, 60, 10)
SWAPPED = walk(lambda n: {(7 if n < 30 else 8): (n / 10, 0.0), (8 if n < 30 else 7): (n / 10, 4.0)}, 60, 10)
#: The topics of the events of /camera/tracks.
TOPICS = {"/camera/tracks/events", "/camera/tracks/events/view/log", "/camera/tracks/counts"}


@pytest.fixture
def place(tmp_path) -> Path:
    return write_channels(tmp_path / "a.mcap", tracks=SWAPPED, truth=TRUTH)


def without_views(opened) -> set[str]:
    return {topic for topic in opened.channels if not topic.endswith(("/view/scene", "/view/tf"))}


def test_events_texts_and_counts_are_channels_beside_the_tracks(place):
    report, notes = watched(place)
    assert (report.stages, notes) == (["events"], [])
    assert report.events == {
        "/camera/tracks": dict.fromkeys(EVENT_KINDS.values(), 0) | {"birth": 2, "identity switch": 2}
    }
    assert log.check(place).is_sound
    with log.read(place) as opened:
        assert without_views(opened) == TOPICS | {"/camera/tracks", "/camera/truth"}
        events, counts = opened.frames("/camera/tracks/events", EVENTS), opened.frames("/camera/tracks/counts", COUNTS)
        assert [f.t_ns for f in events] == [f.t_ns for f in counts] == [f.t_ns for f in SWAPPED]
        (result,) = evaluate(
            [sequence_of_log(opened, "/camera", ["/camera/tracks"])], EvaluateOptions(("metres",), (1.0,))
        ).results
        assert counts[-1].rows["mota"].item() == result.to_json()["MOTA"]
        messages = list(opened.messages("/camera/tracks/events/view/log"))
        parsed = [LogMessage.FromString(message.payload) for message in messages]
        assert [m.t_ns for m in messages] == [p.timestamp.seconds * 10**9 + p.timestamp.nanos for p in parsed]
        assert {p.name for p in parsed} == {"/camera/tracks"}
        assert parsed[-1].message == "person 1: track 7 became track 8 at 3.00 s, (3.0, 0.0) m"
        made = Provenance.from_metadata(opened.channel("/camera/tracks/events").metadata)
        assert (made.transform, made.input, set(made.references)) == ("events", "/camera/tracks", {"/camera/truth"})
        now = {topic: Provenance.from_metadata(opened.channel(topic).metadata).digest for topic in opened.channels}
        assert made.made_from() == {topic: now[topic] for topic in ("/camera/tracks", "/camera/truth")}
        assert made.parameters == {
            "asked": {"similarity": None, "gate_m": None, "min_iou": None},
            "similarity": "metres",
            "gate": 1.0,
        }


def test_options_of_events_are_kept_until_changed(place):
    def rule():
        made = provenance_of(place, "/camera/tracks/counts").parameters
        return made["similarity"], made["gate"]

    watched(place, again=True, similarity="metres", gate_m=0.25)
    assert rule() == ("metres", 0.25)
    assert watched(place)[0].stages == []
    assert watched(place, similarity="metres")[0].stages == ["events"]
    assert rule() == ("metres", 1.0)


@pytest.mark.parametrize("topic", ["/camera/tracks", "/camera/truth"])
def test_changed_tracks_or_ground_truth_make_events_out_of_date(place, topic):
    watched(place)
    replace_channel(place, topic, walk(lambda n: {1: (n / 10, 0.0), 2: (n / 10, 4.0)}, 50, 10))
    with log.read(place) as opened:
        assert {name for name in without_views(opened) if pipeline.is_stale(opened, name)} == TOPICS - {
            "/camera/tracks/events/view/log"
        }
    assert watched(place)[0].stages == ["events"]
    assert watched(place)[0].stages == []


def test_added_or_removed_ground_truth_remakes_events(tmp_path):
    path = write_channels(tmp_path / "a.mcap", tracks=SWAPPED)
    report, notes = watched(path)
    assert (report.events["/camera/tracks"]["identity switch"], notes) == (0, [])
    assert watched(path)[0].stages == []
    replace_channel(path, "/camera/truth", TRUTH)
    assert watched(path)[0].events["/camera/tracks"]["identity switch"] == 2
    with log.read(path) as opened, log.extend(opened, drop=["/camera/truth"]):
        pass
    assert watched(path)[0].events["/camera/tracks"]["identity switch"] == 0
    assert watched(path)[0].stages == []


def test_ground_truth_that_cannot_be_compared_is_reported_once(tmp_path):
    late = [Frame(frame.t_ns + ns(900), frame.index, frame.rows) for frame in TRUTH]
    path = write_channels(tmp_path / "a.mcap", tracks=SWAPPED, truth=late)
    report, notes = watched(path)
    assert report.events["/camera/tracks"]["birth"] == 2
    assert ["never overlap in time" in note for note in notes] == [True]
    assert report.warnings[0].code == "not-compared"
    assert watched(path)[1] == []


def test_named_channels_stay_watched(tmp_path):
    path = write_channels(tmp_path / "a.mcap", retracks_online=SWAPPED, truth=TRUTH)
    with pytest.raises(McaptrackError, match=r"has no tracks of /camera; `mcaptrack\.run\('.*a\.mcap'\)` makes them"):
        watched(path, again=True)
    with log.read(path) as opened:
        assert pipeline.find_camera(opened, None, "/camera/retracks/online") == "/camera"
    assert watched(path)[0].stages == []
    watched(path, "/camera/retracks/online", again=True)
    replace_channel(path, "/camera/retracks/online", TRUTH)
    assert watched(path)[0].events["/camera/retracks/online"]["identity switch"] == 0


def test_remade_tracks_make_events_out_of_date_until_run(tmp_path):
    """The samples of true tracks, re-tracked in two ways."""
    path = write_channels(tmp_path / "a.mcap", samples=walk(lambda n: {5 + n // 40: (n / 4, 0.0)}, 80), truth=[])

    def retrack(profile, watch=None):
        with log.read(path) as opened:
            jobs = pipeline.plan_stage(opened, "/camera", "retrack", PROFILES[profile], keep=("",))
            return pipeline.run(opened, "/camera", jobs, finishing=[watch] if watch else [])

    assert retrack("default", pipeline.Watch()).stages == ["retrack", "events"]
    assert retrack("default").stale == []
    assert retrack("paper").stale == ["/camera/retracks/counts", "/camera/retracks/events"]
    with log.read(path) as opened:
        report = pipeline.run(opened, "/camera", [], finishing=[pipeline.Watch()])
    assert (report.stages, report.stale) == (["events"], [])


def test_a_log_of_tracks_without_rows(tmp_path):
    path = write_channels(tmp_path / "a.mcap", tracks=[], truth=TRUTH)
    report, _ = watched(path)
    assert report.events == {"/camera/tracks": dict.fromkeys(EVENT_KINDS.values(), 0)}
    assert watched(path)[0].stages == []
    assert log.check(path).is_sound


def test_of_the_life_of_tracks_only_ends_of_tracks_and_of_sources_are_kept():
    def rows(n: int):
        found = tracks_at({1: (n, 0.0), 2: (n, 5.0)})
        found["source_id"] = [7 if n < 20 else 8, -1]
        return found

    life = lifecycle_of([Frame(ns(n / 10), n, rows(n)) for n in range(50)])
    found = sorted(zip(life.rows["track_id"].tolist(), life.rows["x_m"].tolist(), strict=True))
    assert found == [(1, 0), (1, 19), (1, 20), (1, 49), (2, 0), (2, 49)]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"kind": END, "duration_s": 0.1}, "track 7 ends here, after 0.1 s"),
        ({"kind": END, "duration_s": 0.09}, "track 7 ends here, after 0.09 s"),
        ({"kind": MISS, "frames": 4, "duration_s": 0.5, "previous_id": -1}, "person 9 is missed in 4 of 5 frames over 0.5 s here"),
        ({"kind": SWITCH, "duration_s": 1.25}, "person 9: track 0 became track 7 here, 1.2 s unseen"),
        ({"kind": FALSE, "frames": 1, "duration_s": 0.1}, "track 7 matches no person for 0.1 s here, before it was person 0"),
        ({"kind": EventKind.JOINED}, "track 7 joins the tracker's 0 and 3 here"),
    ],
)  # fmt: skip
def test_events_as_text_that_no_scene_shows(values, text):
    event = {"track_id": 7, "previous_id": 0, "truth_id": 9, "source_id": 3, "frames": 0, "duration_s": 0.0} | values
    assert describe(event, "here", 0.1) == text


# Which channels of tracks get events, by which options, and what is said where they get none


WALK = walk(lambda n: {1: (n / 10, 0.0), 2: (n / 10, 4.0)}, 10, 10)


def written(path: Path, *channels: tuple[str, Provenance | None, list[Frame]], encoding: str = "protobuf") -> Path:
    """A log of channels of tracks."""
    with log.create(path) as writer:
        for topic, made, frames in channels:
            metadata = made.to_metadata() if made else {}
            kind = (TRACKS.name, "protobuf", TRACKS.descriptor)
            number = writer.add_channel(topic, kind, encoding, metadata, another=True)
            for frame in frames:
                writer.add_message(number, frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows))
    return path


def run_watch(path: Path, **options: Any) -> pipeline.Report:
    with log.read(path) as opened, notices.listening(lambda _: None):
        return pipeline.run(opened, "/camera", [], finishing=[pipeline.Watch(**options)])


TRACKED = ("/camera/tracks", Provenance(INGEST, {}, digest="y"), WALK)


@pytest.mark.parametrize("end", ["events", "events/view/log", "counts"])
def test_events_that_would_replace_something_are_left_out_with_a_warning_or_refused_if_asked_for(tmp_path, end):
    path = written(tmp_path / "a.mcap", TRACKED, (f"/camera/tracks/{end}", None, WALK))
    taken = f"would replace /camera/tracks/{end}, which was recorded by others (mcaptrack.Tracks)"
    report = run_watch(path)
    assert [(one.message, one.code) for one in report.warnings] == [
        (f"no events of /camera/tracks: they {taken}", "left-out")
    ]
    assert (report.stages, report.events, report.frames) == ([], {}, {})
    with pytest.raises(McaptrackError) as error:
        run_watch(path, topics=("/camera/tracks",), again=True)
    assert str(error.value) == f"{path}: no events of /camera/tracks: they {taken}"


def test_of_two_channels_of_a_topic_the_recorded_one_is_named(tmp_path):
    ours, theirs = (("/camera/retracks", made, WALK) for made in (TRACKED[1], None))
    for number, channels in enumerate([(ours, theirs), (theirs, ours)]):
        path = written(tmp_path / f"{number}.mcap", TRACKED, *channels)
        with log.read(path) as opened:
            assert describe_origin(opened, "/camera/retracks") == "was recorded by others (mcaptrack.Tracks)"
            assert describe_origin(opened, "/camera/tracks") == "was ingested"


def test_the_usual_tracks_and_those_with_events_are_watched(tmp_path):
    made = Provenance("events", {}, "/camera/other")
    some = [
        (f"/camera/{name}", Provenance(INGEST, {}), WALK[:1])
        for name in ("zebra", "retracks", "other", "third", "tracks")
    ]
    beside = [
        ("/camera/zebra/events", made, []),
        ("/camera/other/events", made, []),
        ("/camera/third/events", None, []),
        ("/camera/gone/events", made, []),
    ]
    report = run_watch(written(tmp_path / "a.mcap", *some, *beside))
    assert [*report.events] == ["/camera/tracks", "/camera/retracks", "/camera/other", "/camera/zebra"]
    assert run_watch(written(tmp_path / "b.mcap", some[-1], encoding="json")).events == {}


#: What the provenance of events says, and the options that they are made again with.
ASKED: list[tuple[Any, tuple[Any, Any, Any]]] = [
    ({"similarity": "iou", "min_iou": 0.4}, ("iou", None, 0.4)),
    ({"similarity": "metres", "gate_m": 2, "min_iou": 0.5}, ("metres", 2, 0.5)),
    ({"similarity": "iou", "min_iou": 0.4}, ("iou", None, 0.4)),
    ({"similarity": "strange", "gate_m": 2.0}, (None, 2.0, None)),
    ({"gate_m": True, "min_iou": 0}, (None, None, None)),
    ({"gate_m": 0.001, "min_iou": -1.0}, (None, 0.001, None)),
    ({"gate_m": "1"}, (None, None, None)),
    (["iou"], (None, None, None)),
    (None, (None, None, None)),
]


@pytest.mark.parametrize(("asked", "wanted"), ASKED)
def test_events_are_made_again_as_they_were_asked_for_unless_something_else_is(tmp_path, asked, wanted):
    names = ("similarity", "gate_m", "min_iou")
    for stage, options, asked_now in (
        ("events", EventOptions(), wanted),
        ("events", EventOptions("iou"), ("iou", None, None)),
    ):
        made = Provenance(stage, {"asked": asked})
        path = written(tmp_path / "a.mcap", TRACKED, ("/camera/tracks/events", made, []))
        run_watch(path, options=options)
        found = provenance_of(path, "/camera/tracks/events").parameters["asked"]
        assert found == dict(zip(names, asked_now, strict=True))


# Misses, false tracks and switches against a second, slow way to find them, on random tracks.


def random_world(rng: np.random.Generator) -> tuple[list[Frame], list[Frame]]:
    """People who come and go, and tracks of them: missed now and then for longer, ids that break, and ghosts."""
    start, speed = rng.uniform(-5, 5, (4, 2)), rng.normal(0, 0.1, (4, 2))
    since, until = rng.integers(0, 15, 4), rng.integers(25, 60, 4)
    names, lost, truth, tracks, now = [10, 20, 30, 40], np.zeros(4), [], [], 0.0
    slower = rng.choice([1.0, 9.0])  # ten frames a second, or about one
    for number in range(50):
        now += slower * rng.choice([0.1, 0.1, 0.1, 0.1, 0.2, 0.7])
        people, found = {}, {}
        for who in range(4):
            here = start[who] + number * speed[who]
            if not since[who] <= number < until[who]:
                continue
            people[who + 1] = tuple(here)
            if rng.random() < 0.1:
                lost[who] = number + rng.integers(1, 15)
            if rng.random() < 0.08:
                names[who] += 1
            if lost[who] <= number:
                found[names[who]] = tuple(here + rng.normal(0, 0.35, 2))
        if rng.random() < 0.3:
            found[int(rng.integers(90, 93))] = tuple(rng.uniform(-20, 20, 2))
        for frames, places in ((truth, people), (tracks, found)):  # in any order
            frames.append(
                Frame(ns(now), number, tracks_at({who: places[who] for who in rng.permutation(list(places))}))
            )
    return truth, tracks


Event = tuple[int, int, int, int, int, int, float]


def spells(kind: EventKind, here: dict, matched: dict, times: list[int], usual: int) -> list[Event]:
    """Times without a match of each id; ``here`` maps ids to frames in which they are, ``matched`` to others by frame."""
    pause, out = max(1_000_000_000, round(1.5 * usual)), []
    for who, frames in here.items():
        alone = [frame for frame in frames if frame not in matched.get(who, {})]
        while alone:
            end = 1
            while end < len(alone) and times[alone[end]] - times[alone[end - 1]] <= pause:
                end += 1
            spell, alone = alone[:end], alone[end:]
            before = [frame for frame in matched.get(who, {}) if frame < spell[0]]
            had = matched[who][max(before)] if before else -1
            lasts = (times[spell[-1]] - times[spell[0]] + usual) / 1e9
            ids = (-1, who) if kind is EventKind.MISS else (who, -1)
            out.append((times[spell[0]], kind, *ids, had, len(spell), lasts))
    return out


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_misses_false_tracks_and_switches_equal_the_reference(seed):
    truth, tracks = random_world(np.random.default_rng(seed))
    times = [frame.t_ns for frame in truth]
    usual = int(np.median(np.diff(times)))
    compared = make_matchup(truth, tracks, "metres", 1.0)
    pairs = matches(compared)  # compared with other evaluators elsewhere
    people, names = (sorted({w for f in side for w in f.rows["track_id"].tolist()}) for side in (truth, tracks))
    by_person: dict[int, dict[int, int]] = {}
    by_track: dict[int, dict[int, int]] = {}
    for frame, who, by in zip(pairs.frame.tolist(), pairs.person.tolist(), pairs.track.tolist(), strict=True):
        by_person.setdefault(people[who], {})[frame] = names[by]
        by_track.setdefault(names[by], {})[frame] = people[who]
    wanted: list[Event] = []
    for who, found in by_person.items():
        frames = sorted(found)
        for last, frame in pairwise(frames):
            if found[last] != found[frame]:
                unseen = (times[frame] - times[last + 1]) / 1e9
                wanted.append((times[frame], EventKind.SWITCH, found[frame], who, found[last], 0, unseen))
    here = [{}, {}]
    for side, frames in zip(here, (truth, tracks), strict=True):
        for number, frame in enumerate(frames):
            for who in frame.rows["track_id"].tolist():
                side.setdefault(who, []).append(number)
    wanted += spells(EventKind.MISS, here[0], by_person, times, usual)
    wanted += spells(EventKind.FALSE_TRACK, here[1], by_track, times, usual)
    kinds = (EventKind.SWITCH, EventKind.MISS, EventKind.FALSE_TRACK)
    columns = ("kind", "track_id", "truth_id", "previous_id", "frames", "duration_s")
    made = find_events(tracks, truth)
    found = [
        (frame.t_ns, *(row[name].item() for name in columns))
        for frame in made.events
        for row in frame.rows
        if row["kind"] in kinds
    ]
    right = people_so_far = 0
    counts = made.counts
    assert [(frame.t_ns, frame.index) for frame in counts] == [(frame.t_ns, frame.index) for frame in truth]
    for number, frame in enumerate(counts):
        (row,) = frame.rows
        there, here, hits = len(truth[number].rows), len(tracks[number].rows), int((pairs.frame == number).sum())
        switches = sum(event[1] == EventKind.SWITCH and event[0] <= frame.t_ns for event in wanted)
        right, people_so_far = right + 2 * hits - here, people_so_far + there
        names = ("people", "matches", "misses", "false_tracks", "switches", "tracked")
        assert [row[name] for name in names] == [there, hits, there - hits, here - hits, switches, here]
        mota = (right - switches) / people_so_far if people_so_far else np.nan
        assert row["mota"] == pytest.approx(mota, nan_ok=True)
    assert [event[:-1] for event in sorted(found)] == [event[:-1] for event in sorted(wanted)]
    np.testing.assert_allclose([e[-1] for e in sorted(found)], [e[-1] for e in sorted(wanted)], atol=1e-9)


def repaired_world(rng: np.random.Generator) -> list[Frame]:
    """Tracks that come and go, of sources that change now and then, for a moment or for longer; some rows have none."""
    frames, now, source = [], 0.0, {one: int(rng.integers(0, 4)) for one in (3, 5, 8, 11)}
    until = dict.fromkeys(source, 0)
    for number in range(40):
        now += float(rng.choice([0.25, 0.25, 0.25, 0.5, 1.25]))
        rows = []
        for one in rng.permutation(list(source)).tolist():
            if rng.random() < 0.1:
                until[one] = number + int(rng.integers(1, 12))
            if until[one] > number:
                continue
            if rng.random() < 0.2:
                source[one] = int(rng.integers(0, 4))
            rows.append((one, -1 if rng.random() < 0.15 else source[one]))
        ids = [one for one, _ in rows]
        made = tracks_at({one: (number / 7, one / 3) for one in ids})
        made["source_id"] = [from_ for _, from_ in rows]
        made["observed"] = rng.random(len(rows)) < 0.8
        frames.append(Frame(ns(now) + 9, number, made))
    return frames


def lives(frames: list[Frame]) -> list[Event]:
    """Births, ends and repairs, track by track."""
    times = [frame.t_ns for frame in frames]
    usual = int(np.median(np.diff(times)))
    rows: dict[int, list[tuple[int, int]]] = {}
    for frame in frames:
        for row in frame.rows:
            rows.setdefault(int(row["track_id"]), []).append((frame.t_ns, int(row["source_id"])))
    out: list[Event] = []
    runs: list[tuple[int, int, int, int]] = []  # time, track, source and last time of each run
    joined = set()
    for track, own in sorted(rows.items()):
        out.append((own[0][0], EventKind.BIRTH, track, -1, -1, 0, np.nan))
        if own[-1][0] < times[-1]:
            lasted = (own[-1][0] - own[0][0] + usual) / 1e9
            out.append((own[-1][0], EventKind.END, track, -1, -1, len(own), lasted))
        known = [row for row in own if row[1] >= 0]
        parts = [list(group) for _, group in groupby(known, key=lambda row: row[1])]
        brief = [
            0 < k < len(parts) - 1
            and parts[k - 1][0][1] == parts[k + 1][0][1]
            and parts[k + 1][0][0] - parts[k][0][0] < 1_000_000_000
            for k in range(len(parts))
        ]
        parts = [part for part, is_brief in zip(parts, brief, strict=True) if not is_brief]
        parts = [[*chain(*group)] for _, group in groupby(parts, key=lambda part: part[0][1])]
        for before, part in pairwise(parts):
            after = next(t for t in times if t > before[-1][0])
            unseen = max(part[0][0] - after, 0) / 1e9
            out.append((part[0][0], EventKind.JOINED, track, before[0][1], part[0][1], 0, unseen))
            joined.add((part[0][0], track))
        runs += [(part[0][0], track, part[0][1], part[-1][0]) for part in parts]
    for t_ns, track, source, _ in runs:
        before = [run for run in runs if run[2] == source and run[:2] < (t_ns, track)]
        if before and max(before)[1] != track and (t_ns, track) not in joined:
            out.append((t_ns, EventKind.PARTED, track, max(before)[1], source, 0, np.nan))
    return sorted(out, key=lambda event: event[:-1])


@pytest.mark.parametrize("part_rows", [1 << 16, 11])
@pytest.mark.parametrize("seed", range(6))
def test_births_ends_and_repairs_equal_the_reference(seed, part_rows, monkeypatch):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    frames = repaired_world(np.random.default_rng(seed))
    columns = ("kind", "track_id", "previous_id", "source_id", "frames", "duration_s")
    found = sorted(
        (
            (frame.t_ns, *(row[name].item() for name in columns))
            for frame in find_events(frames, None).events
            for row in frame.rows
        ),
        key=lambda event: event[:-1],
    )
    wanted = lives(frames)
    assert {event[1] for event in wanted} == {EventKind.BIRTH, EventKind.END, EventKind.JOINED, EventKind.PARTED}
    assert [event[:-1] for event in found] == [event[:-1] for event in wanted]
    np.testing.assert_allclose([e[-1] for e in found], [e[-1] for e in wanted], atol=1e-9)
    for frame, counts in zip(frames, find_events(frames, None).counts, strict=True):
        (row,) = counts.rows
        past = [event[1] for event in wanted if event[0] <= frame.t_ns]
        repaired = past.count(EventKind.JOINED) + past.count(EventKind.PARTED)
        names, ends = ("born", "ended", "repaired"), (past.count(EventKind.BIRTH), past.count(EventKind.END), repaired)
        assert (counts.t_ns, tuple(row[name] for name in names)) == (frame.t_ns, ends)
        assert (row["tracked"], row["observed"]) == (len(frame.rows), frame.rows["observed"].sum())
        assert np.isnan([row["people"], row["matches"], row["mota"]]).all()
    for frame in find_events(frames, None).events:
        assert all(row["x_m"] == pytest.approx(frame.index / 7) for row in frame.rows)
        assert all(row["y_m"] == pytest.approx(row["track_id"] / 3) for row in frame.rows)
