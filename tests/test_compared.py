"""Files of tracks against files of ground truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from fractions import Fraction
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, tables
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import EvaluateOptions, evaluate, sequence_of_files
from mcaptrack.notices import collected
from mcaptrack.registry import own
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.sources.ingest import IngestOptions
from mcaptrack.sources.ingest.labels.frames import Frames
from mcaptrack.tables.compared import compare_files, pair_files
from tests.commands import call, done, printed
from tests.worlds import boxed, ns, replace_channel, tracks_at, walk, write_channels


def write(path: Path, *rows) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


def scores(tracks: Path, truth: Path, topics=(), **options) -> tuple[dict, list[str]]:
    both = compare_files(tracks, truth, IngestOptions(**options), topics)
    outcome = evaluate([sequence_of_files("x", tracks, both.ground_truth, both.tracks, 1)], EvaluateOptions(("iou",)))
    return outcome.results[0].to_json(), both.notes + outcome.notes


def line(frame, who, x, *more, y=10):
    return frame, who, x, y, 20, 50, *more


WALK = [line(n, 1, 10 + n, 1, -1, -1, -1) for n in range(1, 11)]
FOUND = [line(n, 5, 10 + n, 0.9) for n in range(1, 11)]


def test_mot15_and_its_positions_are_no_classes(tmp_path):
    """The last three of ten columns are a position in the world, whatever numbers stand there."""
    truth = write(tmp_path / "gt.txt", *(line(n, 1, 10 + n, 1, 4.48, 5.5, 0) for n in range(1, 11)))
    row, _ = scores(write(tmp_path / "t.txt", *FOUND), truth)
    assert (row["MOTA"], row["GT"], row["FN"]) == (1.0, 1, 0)


def test_frames_outside_of_the_truth_count_as_trackeval_counts_them_where_it_is_of_the_whole_sequence(tmp_path):
    early = [line(n, 9, 300, 0.9) for n in range(1, 4)]
    truth, found = write(tmp_path / "gt.txt", *WALK[4:]), write(tmp_path / "t.txt", *FOUND, *early)
    with collected() as warnings:
        row, _ = scores(found, truth)
        assert (row["FP"], row["FN"]) == (0, 0)
    assert [notice.code for notice in warnings] == ["labelled"]
    assert "frames='5:11'" in warnings[0].message
    with collected() as warnings:
        row, _ = scores(found, truth, frame_ranges=Frames.parse(":").ranges)
        (tmp_path / "seqinfo.ini").write_text("[Sequence]\nseqLength=10\n")
        other, _ = scores(found, truth)
    assert (row["FP"], row["FN"]) == (7, 0)  # four of the walker before he is labelled, three of a ghost
    assert other == row
    assert not warnings


def test_frames_that_count_from_0_meet_those_that_count_from_1(tmp_path):
    early = write(tmp_path / "t.txt", *((n - 1, *rest) for n, *rest in FOUND))
    with collected() as warnings:
        row, _ = scores(early, write(tmp_path / "gt.txt", *WALK))
    assert (row["FP"], row["FN"], row["MOTA"]) == (0, 0, 1.0)
    assert [notice.code for notice in warnings] == ["clock"]
    assert "are assumed to be the same picture" in warnings[0].message


def test_exported_tables_are_scored(tmp_path):
    truth = [Frame(ns(n / 10), n, boxed({1: (10 + n, 10)})) for n in range(10)]
    tracks = [Frame(ns(n / 10), n, boxed({7: (11 + n, 10)})) for n in range(10)]
    path = tmp_path / "part-0.parquet"
    tables.write(path, tables.rows_in_pieces(TRACKS, {"/camera/truth": truth, "/camera/tracks": tracks}).table(), {})
    row, _ = scores(path, path)
    assert (row["MOTA"], row["GT"]) == (1.0, 1)
    gt = write(tmp_path / "gt.txt", *((n + 1, 1, 10 + n, 10, 10, 20, 1, -1, -1, -1) for n in range(10)))
    row, _ = scores(path, gt)  # a table counts frames from 0, MOTChallenge from 1
    assert row["MOTA"] == 1.0
    more = {"/camera/tracks": tracks, "/camera/samples": tracks[::4]}
    tables.write(path, tables.rows_in_pieces(TRACKS, more).table(), {})
    with pytest.raises(McaptrackError, match=r"holds /camera/samples, /camera/tracks; choose one with `topic=`"):
        scores(path, gt)
    assert scores(path, gt, topics=("/camera/tracks",))[0]["MOTA"] == 1.0
    alone = tmp_path / "alone.parquet"  # ground truth may have any name where it is all there is
    tables.write(alone, tables.rows_in_pieces(TRACKS, {"/lidar/people": truth}).table(), {})
    assert scores(path, alone, topics=("/camera/tracks",))[0]["MOTA"] == 1.0
    tables.write(alone, tables.rows_in_pieces(TRACKS, {"/lidar/people": truth, "/lidar/dogs": truth}).table(), {})
    with pytest.raises(McaptrackError, match="holds /lidar/dogs, /lidar/people; none of them is truth"):
        scores(path, alone, topics=("/camera/tracks",))
    (tmp_path / "points.txt").write_text("0 7 1.5 2.5\n12 7 1.6 2.5\n24 7 1.7 2.5\n")
    with pytest.raises(McaptrackError, match="share no clock: one counts frames, the other does not"):
        scores(path, tmp_path / "points.txt", topics=("/camera/tracks",))
    (tmp_path / "no.parquet").write_bytes(b"PAR1 but not really")
    with pytest.raises(McaptrackError, match="can't be read as Parquet"):
        scores(tmp_path / "no.parquet", gt)


def test_a_file_without_tracks_is_scored(tmp_path):
    row, _ = scores(write(tmp_path / "t.txt"), write(tmp_path / "gt.txt", *WALK))
    assert (row["FN"], row["FP"], row["ML"], row["MOTA"]) == (10, 0, 1, 0.0)


def test_files_that_cannot_be_scored_are_refused(tmp_path):
    for found, truth, said in (
        (FOUND, [line(n, 1, 10, 0, 1, 1) for n in range(1, 9)], "holds no people, only 8 boxes that don't count"),
        (FOUND, [line(501, 1, 5, 1), line(502, 1, 5, 1)], r"gt.txt \(500 to 501\) and .*t.txt"),
        ([(n, 5, 0.1, 0.1, 0.02, 0.05) for n in range(1, 9)], WALK, "t.txt has boxes in shares of the picture's size"),
        ([line(1, 5, 10), line(1, 5, 90)], WALK, "id 5 appears twice in frame 1"),
        ([line(1, -1, 10)], WALK, "has no ids"),
        (FOUND, [], "gt.txt holds no boxes"),
    ):
        with pytest.raises(McaptrackError, match=said):
            scores(write(tmp_path / "t.txt", *found), write(tmp_path / "gt.txt", *truth))


def test_positions_in_metres_are_no_boxes(tmp_path):
    truth = tmp_path / "gt.txt"
    truth.write_text("".join(f"{n} 1 {n / 10} 2.0\n" for n in range(1, 11)))
    code, _, err = call("evaluate", write(tmp_path / "t.txt", *FOUND), "--truth", truth)
    assert code == 1
    assert "share neither boxes nor positions in metres" in err


def test_tracks_without_any_match_are_scored_with_a_note(tmp_path):
    far = write(tmp_path / "t.txt", *(line(n, 5, 800) for n in range(1, 11)))
    row, notes = scores(far, write(tmp_path / "gt.txt", *WALK))
    assert (row["FP"], row["FN"]) == (10, 10)
    assert notes == ["x: t.txt and the ground truth never come near each other"]


def test_files_are_paired_by_name_or_in_order(tmp_path):
    made = [tmp_path / "b.txt", tmp_path / "a.txt"]
    truth = [tmp_path / name / "gt" / "gt.txt" for name in ("a", "b")]
    assert [(n, t.parent.parent.name) for n, _, t in pair_files(made, truth)[0]] == [("b", "b"), ("a", "a")]
    pairs, words = pair_files(made, [tmp_path / "x.txt", tmp_path / "y.txt"])
    assert [(n, t.name) for n, _, t in pairs] == [("b", "x.txt"), ("a", "y.txt")]
    assert "taken in the order given" in words
    assert pair_files(made[:1], truth[:1]) == ([("b", made[0], truth[0])], "")  # one of each belong together
    with pytest.raises(McaptrackError, match="2 files of tracks and 1 of ground truth"):
        pair_files(made, truth[:1])


def test_several_files_at_the_command_line(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / name / "gt" / "gt.txt", *WALK)
        write(tmp_path / f"{name}.txt", *(FOUND if name == "a" else FOUND[:5]))
    words = ("evaluate", tmp_path / "[ab].txt", "--truth", tmp_path / "*/gt/gt.txt", "--json")
    out, _ = printed(*words)
    rows = json.loads(out)["results"]
    assert [(row["sequence"], row["FN"]) for row in rows] == [("a", 0), ("b", 5), ("COMBINED", 5)]
    assert rows[-1]["tracks"] == "2 files"
    code, _, err = call(*words, "--fail-under", "mota=0.8")
    assert code == 4
    assert "MOTA 0.7500 is under 0.8" in err


def by_trackeval(data) -> dict:
    from trackeval.metrics import CLEAR, HOTA, Identity

    metrics = CLEAR({"PRINT_CONFIG": False}), Identity({"PRINT_CONFIG": False}), HOTA()
    return {name: float(np.mean(value)) for metric in metrics for name, value in metric.eval_sequence(data).items()}


def same_as_trackeval(row: dict, theirs: dict) -> None:
    for name, other in {"FP": "CLR_FP", "FN": "CLR_FN"}.items():
        assert row[name] == theirs[other]
    for name in ("MOTA", "IDF1", "HOTA", "DetA", "AssA", "LocA", "IDSW", "Frag", "MT", "ML"):
        assert row[name] == pytest.approx(theirs[name], abs=1e-9), name


def crowd(seed: int, kinds: list, frames: int = 30):
    """Labelled boxes of several kinds and tracks near them: (frame, id, kind, box), (frame, id, box)."""
    rng = np.random.default_rng(seed)
    place, kind = rng.uniform(0, 300, (14, 2)), rng.choice(len(kinds), 14)
    labels, found = [], []
    for number in range(1, frames + 1):
        place = place + rng.normal(0, 3, place.shape)
        for who in range(14):
            size = (20.0, 50.0) if who % 5 else (9.0, 20.0)
            labels.append((number, who + 1, kinds[kind[who]], (*place[who].round(2), *size)))
            if rng.random() < 0.8:
                found.append((number, who + 101, (*(place[who] + rng.normal(0, 3, 2)).round(2), *size)))
    return labels, found


@pytest.mark.parametrize("seed", range(3))
def test_mot17_is_scored_as_by_trackeval(seed, tmp_path, capsys):
    datasets = pytest.importorskip("trackeval.datasets")
    labels, found = crowd(seed, [(1, 1), (1, 1), (1, 1), (0, 1), (0, 2), (0, 3), (0, 7), (0, 8), (0, 12)])
    name = "MOT17-01"
    truth = write(
        tmp_path / "gt/MOT17-train" / name / "gt/gt.txt",
        *((n, who, *box, counts, kind, 1.0) for n, who, (counts, kind), box in labels),
    )
    tracks = write(
        tmp_path / f"tr/MOT17-train/us/data/{name}.txt", *((n, who, *box, 1, -1, -1, -1) for n, who, box in found)
    )
    (tmp_path / "gt/MOT17-train" / name / "seqinfo.ini").write_text(f"[Sequence]\nname={name}\nseqLength=30\n")
    (tmp_path / "gt/seqmaps").mkdir()
    (tmp_path / "gt/seqmaps/MOT17-train.txt").write_text(f"name\n{name}\n")
    folders = {"GT_FOLDER": str(tmp_path / "gt"), "TRACKERS_FOLDER": str(tmp_path / "tr"), "PRINT_CONFIG": False}
    theirs = datasets.MotChallenge2DBox(folders | {"BENCHMARK": "MOT17", "SPLIT_TO_EVAL": "train"})
    data = theirs.get_preprocessed_seq_data(theirs.get_raw_seq_data("us", name), "pedestrian")
    row, notes = scores(tracks, truth)
    same_as_trackeval(row, by_trackeval(data))
    ignored = (
        f"{len(found) - data['num_tracker_dets']} boxes of {tracks} match labels that don't count; they are ignored"
    )
    assert ignored in notes


#: A file of each format with a person at frames 0 and 10 from the first, and what counts them.
FORMATS = {
    "mot": "1,1,1,1,9,40\n11,1,1,1,9,40\n",
    "kitti": "".join(f"{n} 1 Pedestrian 0 0 0 1 1 10 41 1 1 1 1 1 1 0\n" for n in (0, 10)),
    "sdd": "".join(f'1 1 1 5 9 {n} 0 0 0 "Pedestrian"\n' for n in (0, 10)),
    "trajnet": "0 1 1 1\n10 1 1 1\n",
}
FORMATS = {name: text for name, text in FORMATS.items() if name in own("label_format")}


@pytest.mark.parametrize(("found", "truth"), [*product(FORMATS, FORMATS)])
def test_files_of_one_format_or_that_count_frames_are_compared_by_frame(found, truth, tmp_path):
    paths = [tmp_path / "found.txt", tmp_path / "truth.txt"]
    for path, name in zip(paths, (found, truth), strict=True):
        path.write_text(FORMATS[name])
    counts = {"mot", "kitti"}
    if found == truth or {found, truth} <= counts:
        with collected() as warnings:
            both = compare_files(*paths)
        for frames in (both.tracks, both.ground_truth):
            assert [len(frame.rows) for frame in frames] == [1, 1]
        assert [frame.t_ns for frame in both.tracks] == [frame.t_ns for frame in both.ground_truth]
        a, b = (f"frame {int(name == 'mot')} of {path}" for path, name in zip(paths, (found, truth), strict=True))
        text = f"{b} and {a} are assumed to be the same picture; `first_frame=` sets the number"
        assert [notice.message for notice in warnings] == [text] * (found != truth)
        words = "frames are compared by their numbers, whatever the frames per second"
        assert compare_files(*paths, IngestOptions(fps=Fraction(3))).notes == [words]
    elif "trajnet" in (found, truth) and "sdd" in (found, truth):
        words = r"25 by trajnet.* Stanford Drone|30 by Stanford Drone.* 25 by trajnet"
        with pytest.raises(McaptrackError, match=words):
            compare_files(*paths)
        both = compare_files(*paths, IngestOptions(fps=Fraction(5)))
        ends = {frames[-1].t_ns for frames in (both.tracks, both.ground_truth)}
        assert (ends, both.notes) == ({ns(2)}, [])


# Trackers compared without ground truth: signs are those that the truth gives, and no trick makes a tracker better


PEOPLE, TICKS = 14, 100


def tracked(seed: int, broken: float, missed: float = 0.05, noise_m: float = 0.08) -> list[Frame]:
    """People on parallel lines as a tracker sees them, which gives new ids at each sample with a probability."""
    rng = np.random.default_rng(seed)
    names, free, out = list(range(1, PEOPLE + 1)), PEOPLE + 1, []
    for tick in range(TICKS):
        places = {}
        for person in range(PEOPLE):
            if rng.random() < broken:
                names[person], free = free, free + 1
            if rng.random() > missed:
                x, y = rng.normal((0.5 * tick * (-1) ** person, 3.0 * person), noise_m)
                places[names[person]] = (x, y)
        out.append(Frame(ns(tick / 2.5), tick, tracks_at(places)))
    return out


def changed(frames: list[Frame], change: Callable[[np.ndarray, int], np.ndarray]) -> list[Frame]:
    return [frame._replace(rows=change(frame.rows.copy(), frame.index)) for frame in frames]


def renamed(rows: np.ndarray, ids: np.ndarray) -> np.ndarray:
    rows["track_id"] = ids
    return rows[np.unique(ids, return_index=True)[1]] if len(rows) else rows


def moved(rows: np.ndarray, sigma_m: float, seed: int) -> np.ndarray:
    for name in ("x_m", "y_m"):
        rows[name] += np.random.default_rng([seed, len(name)]).normal(0, sigma_m, len(rows))
    return rows


#: What a tracker may do to come out better: it loses half of the people, and so on.
TRICKS = {
    "half": lambda rows, tick: rows[rows["track_id"] % 2 == 0],
    "merged": lambda rows, tick: renamed(rows, np.ones(len(rows), int)),
    "pairs": lambda rows, tick: renamed(rows, rows["track_id"] // 2),
    "split": lambda rows, tick: renamed(rows, rows["track_id"] * 1000 + tick // 5),
    "moved": lambda rows, tick: moved(rows, 0.7, tick),
    "twice": lambda rows, tick: np.concatenate([rows, renamed(moved(rows.copy(), 0.3, tick), rows["track_id"] + 5000)]),
}


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> Path:
    """A log of several trackers, with re-tracking of one, and copies of it, or of its source, under other ids."""
    path = tmp_path_factory.mktemp("against") / "log.mcap"
    good, truth = tracked(2, 0.005), walk(lambda n: {p: (0.5 * n * (-1) ** p, 3.0 * p) for p in range(PEOPLE)}, TICKS)
    others = {name: changed(good, trick) for name, trick in TRICKS.items()}
    write_channels(path, samples=tracked(1, 0.03), good=good, poor=tracked(3, 0.15), truth=truth, **others)
    done("retrack", path, "-q")
    with log.read(path) as opened:
        reference = list(opened.frames("/camera/retracks", TRACKS))
    copy = changed(reference, lambda rows, tick: renamed(rows, rows["track_id"] + 700))
    nudged = changed(copy, lambda rows, tick: moved(rows, 0.05, tick))
    sources = changed(tracked(1, 0.03), lambda rows, tick: moved(renamed(rows, rows["track_id"] + 700), 0.3, tick))
    copies = {"copy": copy, "part": changed(copy, TRICKS["half"]), "nudged": nudged, "sources": sources}
    for name, frames in copies.items():
        replace_channel(path, f"/camera/{name}", frames)
    return path


def difference(path: Path, before: str, after: str):
    (row,) = mcaptrack.evaluate(path, against="/camera/retracks", topic=[before, after]).differences
    assert (row.before, row.after) == (f"/camera/{before}", f"/camera/{after}")
    return row


def test_the_sign_is_that_of_the_truth(compared):
    scores = mcaptrack.evaluate(compared, topic=["poor", "good"], gate_m=1.0, similarity="metres")
    wanted = scores.score("IDF1", "good") - scores.score("IDF1", "poor")
    forth, back = difference(compared, "poor", "good"), difference(compared, "good", "poor")
    assert (forth.verdict, back.verdict, wanted > 0.05) == ("better", "worse", True)
    assert forth.idf1 == pytest.approx(-back.idf1)
    assert forth.low <= forth.idf1 <= forth.high


@pytest.mark.parametrize("trick", TRICKS)
def test_no_trick_makes_a_tracker_better(compared, trick):
    row = difference(compared, "good", trick)
    # Rows that the reference lacks may be of people that it misses.
    assert row.verdict == ("undecided" if trick == "twice" else "worse"), row


@pytest.mark.parametrize("name", ["samples", "retracks/online", "copy", "part", "nudged", "sources"])
def test_relatives_of_the_reference_and_copies_of_it_are_never_better(compared, name):
    row = difference(compared, "split", name)
    assert row.idf1 > 0.05
    assert (row.verdict, f"/camera/{name}" in row.why) == ("undecided", True)


def test_several_logs_are_compared_together(compared, tmp_path):
    one, both = (
        mcaptrack.evaluate(paths, against="retracks", topic=["poor", "good"]).differences[0]
        for paths in (compared, [compared, compared])
    )
    assert one.idf1 == pytest.approx(both.idf1)
    assert both.high - both.low < one.high - one.low


def test_levels_are_not_printed(compared):
    outcome = call("evaluate", compared, "--against", "retracks", "--topic", "poor", "--topic", "good", "--json")
    printed = json.loads(outcome.out)
    assert (printed["against"], printed["results"]) == ("retracks", [])
    assert [row["verdict"] for row in printed["differences"]] == ["better"]
    assert "no ground truth" in call("evaluate", compared, "--against", "retracks").out
    with pytest.raises(McaptrackError, match="no ground truth"):
        mcaptrack.evaluate(compared, against="retracks").score("IDF1")


@pytest.mark.parametrize("topic", ["retracks/online", "good", "truth"])
def test_only_offline_retracking_is_a_reference(compared, topic):
    with pytest.raises(McaptrackError, match="can't be a reference"):
        mcaptrack.evaluate(compared, against=topic)


def test_without_metres_there_is_no_comparison(tmp_path):
    path = write_channels(tmp_path / "log.mcap", a=walk(lambda n: {1: (n, 0)}, 20))
    replace_channel(
        path, "/camera/retracks", [f._replace(rows=boxed({1: (2.0, 3.0)})) for f in walk(lambda n: {}, 20)], "retrack"
    )
    with pytest.raises(McaptrackError, match="metres"):
        mcaptrack.evaluate(path, against="retracks")


def test_retracking_is_not_scored_against_itself(compared, tmp_path):
    path = tmp_path / "own.mcap"
    path.write_bytes(compared.read_bytes())
    with log.read(path) as opened:
        own = list(opened.frames("/camera/retracks", TRACKS))
    replace_channel(path, "/camera/truth", changed(own, lambda rows, tick: renamed(rows, rows["track_id"] + 9)))
    for words in ((), ("--json",)):
        outcome = call("evaluate", path, *words)
        assert (outcome.code, len(outcome.err.splitlines()), "--against" in outcome.err) == (1, 1, True)
