"""What notebooks show of a log: a player that needs no other file, a still, tables and reports."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from google.protobuf import json_format
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.viewing.links import LinkedEvent
from tests.commands import done
from tests.reader import Reader

CLOSED, PAIRS = 0, 2


class Shown(NamedTuple):
    """What is in a player: the page in its frame, its data, and its pictures (height, width, 3)."""

    page: Reader
    data: dict[str, Any]
    pictures: list[np.ndarray]


def decoded(text: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)


def shown(player: mcaptrack.Player) -> Shown:
    (frame,) = Reader(player.html).of("iframe")
    assert frame["sandbox"] == "allow-scripts"
    page = Reader(frame["srcdoc"])
    texts = {one.get("id"): text for one, text in zip(page.of("script"), page.scripts, strict=True)}
    data = json.loads(zlib.decompress(base64.b64decode(texts["data"])))
    return Shown(page, data, [decoded(one) for one in texts.get("pictures", "").split()])


def stored(path: Path, topic: str) -> dict[int, Any]:
    """The messages of a channel by log time, as the stock MCAP library and the protobuf runtime read them."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return {message.log_time: decoded for _, _, message, decoded in reader.iter_decoded_messages([topic])}


def start_of(path: Path) -> int:
    with path.open("rb") as file:
        return make_reader(file).get_summary().statistics.message_start_time


@pytest.fixture(scope="module")
def player(finished) -> mcaptrack.Player:
    with mcaptrack.open(finished) as log:
        return log.show()


class TestPlayer:
    def test_its_boxes_are_the_rows_of_the_log(self, finished, player):
        data, start_ns = shown(player).data, start_of(finished)
        rows = {round((t - start_ns) / 1e9, 3): m for t, m in stored(finished, "/camera/retracks/full").items()}
        layer = data["layers"].index("/camera/retracks/full/view/image")
        compared = 0
        for second, drawn in zip(data["seconds"], data["drawn"], strict=True):
            lines, texts = drawn[layer]
            boxes = sorted(line[4] for line in lines if line[0] == CLOSED and len(line[4]) == 8)
            message = rows.get(second)
            expected = sorted(
                [r.x_px, r.y_px, r.x_px + r.w_px, r.y_px, r.x_px + r.w_px, r.y_px + r.h_px, r.x_px, r.y_px + r.h_px]
                for r in (message.rows if message else ())
            )
            assert len(boxes) == len(expected)
            if boxes:
                np.testing.assert_allclose(boxes, expected, atol=0.126)
                assert sorted(text[5] for text in texts) == sorted(str(r.track_id) for r in message.rows)
            compared += len(boxes)
        assert compared > 60

    def test_each_drawing_is_that_of_the_view_in_its_colours(self, finished, player):
        data, start_ns = shown(player).data, start_of(finished)
        assert data["layers"] == list(player.views)
        for layer, topic in enumerate(player.views):
            views = {round((t - start_ns) / 1e9, 3): m for t, m in stored(finished, topic).items()}
            for second, drawn in zip(data["seconds"], data["drawn"], strict=True):
                lines, texts = drawn[layer]
                view = views[second]
                assert [text[5] for text in texts] == [text.text for text in view.texts]
                visible = [part for part in view.points if part.type in (2, 4)]
                points = sum(len(part.points) for part in visible)
                assert sum(len(line[4]) // 2 for line in lines) == points
                colours = {
                    "#" + bytes(round(255 * c) for c in (o.r, o.g, o.b, o.a)).hex()
                    for part in visible
                    for o in (part.outline_colors or [part.outline_color])
                }
                assert {data["colours"][line[2]] for line in lines} == colours

    def test_its_pictures_are_those_of_the_video(self, finished, player):
        found = shown(player)
        assert (player.pictures, player.of, player.every) == (60, 60, 1)
        with mcaptrack.open(finished) as log:
            for frame, picture in zip(log.frames("video"), found.pictures, strict=True):
                assert np.abs(picture.astype(int) - frame.rows).mean() < 8
        assert found.data["sizes"] == [[320, 180]] * 60
        assert found.data["numbers"] == list(range(60))

    def test_it_opens_where_viewers_do_and_names_events_of_its_period_and_tracks(self, finished, monkeypatch):
        start_ns = start_of(finished)
        at = [("retracks", 1.0), ("retracks", 3.0), ("tracks", 3.1), ("retracks", 5.0)]
        moments = [
            LinkedEvent(k, start_ns + round(s * 1e9), f"/camera/{name}", "joined", f"{name} {s}")
            for k, (name, s) in enumerate(at)
        ]
        monkeypatch.setattr("mcaptrack.extensions.notebook.api.find_moments", lambda _: moments)
        monkeypatch.setattr(
            "mcaptrack.extensions.notebook.api.opening_moment", lambda *_: (start_ns + 2_960_000_000, "")
        )
        with mcaptrack.open(finished) as log:
            data = shown(log.show(start_s=2.0, end_s=4.0, width=64)).data
        assert data["events"] == [[3.0, "retracks 3.0", data["layers"].index("/camera/retracks/full/view/image")]]
        assert data["seconds"][data["open"]] == 2.9

    def test_pictures_are_left_out_evenly_where_their_size_was_estimated_too_small(self, finished, monkeypatch):
        monkeypatch.setattr("mcaptrack.extensions.notebook.pictures.PictureSource.step", lambda *_: 1)
        with mcaptrack.open(finished) as log:
            small = log.show(max_mb=0.2)
        data = shown(small).data
        assert small.every in (2, 4, 8)
        assert data["numbers"] == list(range(0, 60, small.every))
        assert data["seconds"] == [round(number / 10, 3) for number in data["numbers"]]
        assert len(shown(small).pictures) == len(data["drawn"]) == small.pictures

    def test_it_opens_no_connection_and_runs_only_its_own_script(self, player):
        page = shown(player).page
        (policy,) = (one["content"] for one in page.of("meta") if one.get("http-equiv") == "Content-Security-Policy")
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        assert rules["default-src"] == "'none'"
        assert rules["img-src"] == "data:"
        scripts = [one for one in page.of("script") if one.get("type") != "text/plain"]
        own = base64.b64encode(hashlib.sha256(page.scripts[-1].encode()).digest()).decode()
        assert (scripts, rules["script-src"]) == ([{}], f"'sha256-{own}'")
        assert "http:" not in player.html
        assert "https:" not in player.html
        for part in (Reader(player.html), page):
            for _, attributes in part.elements:
                assert not any(name.startswith("on") for name in attributes)
                assert attributes.get("src", "data:").startswith("data:image/jpeg;base64,") or "src" not in attributes

    def test_notebooks_get_html_a_picture_and_text(self, player):
        bundle = player._repr_mimebundle_(include=None, exclude=None)
        assert bundle == {"text/html": player.html, "image/jpeg": player.still, "text/plain": repr(player)}
        assert "all 60 pictures" in repr(player)

    def test_a_player_is_no_larger_than_asked_for_and_says_what_it_leaves_out(self, finished):
        with mcaptrack.open(finished) as log:
            small = log.show(max_mb=0.2)
            assert len(small.html) <= 200_000
            assert small.pictures == len(shown(small).pictures) == -(-60 // small.every)
            assert small.of == 60
            assert f"{small.pictures} of 60 pictures (every " in small.caption
            numbers = shown(small).data["numbers"]
            assert numbers == list(range(0, 60, small.every))
            with pytest.raises(McaptrackError, match=r"60 pictures make a player of .* MB, and `max_mb=0.2` is the"):
                log.show(max_mb=0.2, every=1)

    def test_a_period_every_picture_and_the_width_are_chosen(self, finished):
        with mcaptrack.open(finished) as log:
            part = log.show(start_s=1.0, end_s=3.0, every=5, width=160, topic="/camera/tracks")
        found = shown(part)
        assert found.data["seconds"] == [1.0, 1.5, 2.0, 2.5, 3.0]
        assert {picture.shape for picture in found.pictures} == {(90, 160, 3)}
        assert part.views == ("/camera/tracks/view/image",)
        assert (part.first_s, part.last_s, part.of) == (1.0, 3.0, 21)

    def test_it_is_saved_as_a_page(self, player, tmp_path):
        target = player.save(tmp_path / "walk.html")
        assert target.read_text(encoding="utf-8") == player.page
        with pytest.raises(McaptrackError, match="exists"):
            player.save(target)
        assert player.save(target, force=True) == target


class TestStill:
    def test_it_shows_the_picture_of_a_time_with_its_boxes(self, finished):
        with mcaptrack.open(finished) as log:
            still = log.show(2.04, width=320)
            (plain,) = log.frames("video", times=[start_of(finished) + 2_000_000_000])
        assert (still.pictures, still.first_s) == (1, 2.0)
        assert Reader(still.html).of("iframe") == []
        image = cv2.imdecode(np.frombuffer(still.still, np.uint8), cv2.IMREAD_COLOR)
        (message,) = [m for t, m in stored(finished, "/camera/retracks/full").items() if t - start_of(finished) == 2e9]
        changed = np.abs(image.astype(int) - plain.rows).max(axis=2)
        for row in message.rows:
            edge = changed[round(row.y_px) + 3 : round(row.y_px + row.h_px) - 3, round(row.x_px)]
            assert np.median(edge) > 40

    @pytest.mark.parametrize("at_s", [6.2, 100.0])
    def test_a_time_without_a_picture_is_refused(self, finished, at_s):
        with (
            mcaptrack.open(finished) as log,
            pytest.raises(McaptrackError, match=r"its pictures are from 0.000 to 5.9"),
        ):
            log.show(at_s)


class TestOtherLogs:
    def test_a_log_without_pictures_is_seen_from_above(self, finished, tmp_path):
        path = tmp_path / "none.mcap"
        rows = [f"{f + 1},{p},{30 + 4 * f + 60 * p},{60 + 9 * p},20,60,1" for f in range(30) for p in (1, 2)]
        (tmp_path / "boxes.txt").write_text("\n".join(rows))
        (tmp_path / "plane.txt").write_text("0.02 0 0\n0 0.02 0\n0 0 1")
        done("ingest", tmp_path / "boxes.txt", "--fps", "10", "--as", "tracks",
             "--ground-plane", tmp_path / "plane.txt", "-o", path)  # fmt: skip
        with mcaptrack.open(path) as log:
            above = log.show()
            still = log.show(1.0)
            tracks = log.array("tracks", "/camera/tracks")
        data = shown(above).data
        assert shown(above).pictures == []
        assert data["layers"][0] == ""
        assert "from above" in above.caption
        assert data["sizes"][0] == [640, 480]
        # Both discs of a scene are as far apart as the people, by the scale that the bar of the grid shows.
        ground, (lines, _) = data["drawn"][10]
        (bar,) = (line for line in ground[0] if line[1] == 3.0)
        (words,) = (text[5] for text in ground[1])
        px_per_m = (bar[4][2] - bar[4][0]) / float(words.removesuffix(" m"))
        places = np.array([np.reshape(line[4], (-1, 2)).mean(axis=0) for line in lines if line[0] == CLOSED])
        at = tracks[tracks["t_ns"] == np.unique(tracks["t_ns"])[10]]
        metres = np.hypot(*(at["x_m"][1] - at["x_m"][0], at["y_m"][1] - at["y_m"][0]))
        assert np.hypot(*(places[1] - places[0])) == pytest.approx(metres * px_per_m, abs=1.0)
        assert still.still[:2] == b"\xff\xd8"

    def test_rows_without_a_view_are_drawn(self, fresh):
        with mcaptrack.open(fresh) as log:
            labels = log.show(end_s=1.0)
            assert labels.views == ("/camera/truth",)
            assert log.show(end_s=0.2, topic="truth").views == ("/camera/truth/view/image",)
            with pytest.raises(
                McaptrackError, match="/camera/ground_plane has no boxes, tracks or predictions to draw"
            ):
                log.show(topic="ground_plane")
        data, start_ns = shown(labels).data, start_of(fresh)
        rows = stored(fresh, "/camera/truth")
        for second, drawn in zip(data["seconds"], data["drawn"], strict=True):
            expected = sorted((r.x_px, r.y_px) for r in rows[start_ns + round(second * 1e9)].rows)
            found = sorted(tuple(line[4][:2]) for line in drawn[0][0] if line[0] == CLOSED and len(line[4]) == 8)
            np.testing.assert_allclose(found, expected, atol=0.126)

    def test_pictures_alone_are_shown_and_it_is_said(self, footage, tmp_path):
        path = tmp_path / "plain.mcap"
        done("ingest", footage.video, "-o", path)
        with mcaptrack.open(path) as log:
            with pytest.warns(mcaptrack.McaptrackWarning, match="nothing is drawn on the pictures: .* no views"):
                plain = log.show(end_s=0.5)
            assert (plain.views, plain.pictures) == ((), 6)
            assert [one.code for one in plain.warnings] == ["nothing-found"]
            alone = log.show(topic="video", end_s=0.5)
            assert (alone.views, alone.pictures, alone.warnings) == ((), 6, ())

    def test_a_log_with_nothing_to_see_is_refused(self, tmp_path):
        with mcaptrack.open(tmp_path / "new.mcap", create=True) as log, pytest.raises(McaptrackError) as refused:
            log.show()
        assert "\n" not in str(refused.value)

    def test_names_in_a_log_are_text(self, finished, tmp_path):
        name = "<script>alert(1)</script>&\"'.mcap"
        path = Path(shutil.copy(finished, tmp_path / name.replace("/", "_")))
        with mcaptrack.open(path) as log:
            log.write("/a<img src=x>/tracks", log.array("tracks", "/camera/tracks")[:20])
            made = log.show(camera="camera", end_s=0.3)
        page = shown(made).page
        assert [one for one in page.of("script") if one.get("type") != "text/plain"] == page.of("script")[-1:]
        assert page.of("title") == [{}]
        assert "<script>alert" not in made.html


class TestTables:
    @pytest.fixture
    def shell(self, monkeypatch):
        """A running IPython, as in a notebook."""
        import IPython
        from IPython.core.formatters import DisplayFormatter

        class Shell:
            display_formatter = DisplayFormatter()

        monkeypatch.setattr(IPython, "get_ipython", lambda: Shell)
        return Shell.display_formatter

    def test_a_table_shows_units_rows_and_what_it_leaves_out(self, finished, shell):
        with mcaptrack.open(finished) as log:
            table = log.table("tracks", "/camera/tracks")
        html = Reader(shell.format(table)[0]["text/html"])
        text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", shell.format(table)[0]["text/html"]))
        assert len(html.of("th")) == len(table.column_names)
        titles = {title["title"] for title in html.of("th")}
        assert table.schema.field("x_m").metadata[b"description"].decode() in titles
        assert f"{table.num_rows:,} rows, {len(table.column_names)} columns; the first 8 and the last 2 rows" in text
        assert len(html.of("tr")) == 1 + 8 + 1 + 2
        assert " t t_ns ns row " in text  # a time is shown with its unit, a number is not
        rows = table.slice(0, 8).to_pylist() + table.slice(table.num_rows - 2).to_pylist()
        assert all(f" {row['t_ns']} " in text for row in rows)

    def test_a_small_table_is_whole_and_what_is_missing_is_a_dash(self, finished, shell):
        with mcaptrack.open(finished) as log:
            table = log.table("tracks", "/camera/truth").slice(0, 10)
        html = shell.format(table)[0]["text/html"]
        assert "10 rows" in html
        assert "first" not in re.sub(r'title="[^"]*"', "", html)
        missing = sum(column.null_count for column in table.columns)
        assert html.count("&ndash;") == missing > 0

    def test_tables_of_others_and_printers_of_the_user_stay(self, finished, shell):
        import pyarrow as pa

        with mcaptrack.open(finished) as log:
            assert "text/html" not in shell.format(pa.table({"a": [1]}))[0]
            shell.formatters["text/html"].for_type(pa.Table, lambda table: "mine")
            mcaptrack.open(finished).close()
            assert shell.format(log.table("tracks"))[0]["text/html"] == "mine"

    def test_names_and_texts_are_escaped(self, shell, finished):
        import pyarrow as pa

        mcaptrack.open(finished).close()
        about = {"unit": "<u>", "description": '"><script>'}
        table = pa.table([["<img src=x>" + 80 * "a"]], pa.schema([pa.field("<b>", pa.string(), metadata=about)]))
        html = Reader(shell.format(table)[0]["text/html"])
        known = {"div", "table", "thead", "tbody", "tr", "th", "td", "br", "span", "p"}
        assert {tag for tag, _ in html.elements} <= known


class TestReport:
    def test_a_report_is_shown_as_it_is_without_an_origin(self, finished, tmp_path):
        made = mcaptrack.report(finished, tmp_path / "page.html")
        (frame,) = Reader(made._repr_html_()).of("iframe")
        assert frame["srcdoc"] == made.page.read_text(encoding="utf-8")
        assert frame["sandbox"] == "allow-scripts allow-downloads"
        made.page.write_bytes(b" " * 8_000_001)
        assert "too large to show here" in made._repr_html_()
        made.page.unlink()
        assert Reader(made._repr_html_()).of("iframe") == []
        assert "can&#39;t be read: No such file" in made._repr_html_()


def test_the_result_of_a_run_is_a_line_in_a_notebook(finished, tmp_path):
    path = Path(shutil.copy(finished, tmp_path / "walk.mcap"))
    result = mcaptrack.run(path, tables=False)
    tracks, repaired = result.summary.tracks, result.summary.repair.tracks
    assert repr(result).startswith(f"RunResult('{path}': up to date; {tracks} tracks, {repaired} after re-tracking; ")


def test_the_strokes_of_any_annotations_can_be_written_as_json():
    from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations

    from mcaptrack.extensions.notebook.pictures import Strokes

    black, clear = {"a": 1.0}, {"a": 0.0}
    message = json_format.ParseDict(
        {
            "points": [
                {"type": 2, "points": [{"x": "NaN", "y": 1}], "outlineColor": black},
                {"type": 2, "points": [{"x": 1, "y": 1}], "outlineColor": clear},
                {"type": 3, "points": [{"x": k, "y": 0} for k in range(3)], "outlineColors": [black, black, clear]},
                {"type": 4, "points": [{"x": k, "y": 0} for k in range(3)], "outlineColor": {"a": "NaN"}},
                {"type": 1, "points": [{"x": 1, "y": 1}], "outlineColor": black},
            ],
            "texts": [{"position": {"x": "Infinity"}, "text": "a"}, {"position": {}, "text": "b", "textColor": black}],
        },
        ImageAnnotations(),
    )
    strokes = Strokes()
    lines, texts = strokes.of(message)
    assert lines == [[PAIRS, 0.0, 0, -1, [0.0, 0.0, 1.0, 0.0]]]
    assert texts == [[0.0, 0.0, 0.0, 0, -1, "b"]]
    assert strokes.colours == ["#000000ff"]
