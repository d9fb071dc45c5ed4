"""Views that a log lacks are drawn for those who look at it, in a temporary file, and the log stays as it is."""

from __future__ import annotations

import resource
import shutil
import tempfile
from contextlib import nullcontext
from pathlib import Path

import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.pipeline import with_views
from mcaptrack.pipeline.staleness import is_finished
from mcaptrack.schema import TRACKS
from mcaptrack.schema.provenance import VIEW, Provenance
from tests.bounded import limited
from tests.logs import our_messages


@pytest.fixture(scope="module")
def without_views(template, tmp_path_factory) -> Path:
    """A log as stages that run alone leave it: nothing is drawn, and no events are found."""
    path = tmp_path_factory.mktemp("stages") / "walk.mcap"
    with log.read(template) as opened:
        hows = {topic: Provenance.from_metadata(channel.metadata) for topic, channel in opened.channels.items()}
    finished = [topic for topic, how in hows.items() if how and (how.transform == VIEW or is_finished(topic, how))]
    assert finished
    mcaptrack.drop(template, finished, output=path)
    return path


@pytest.fixture
def temporary(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_views_are_those_that_run_writes(without_views, temporary, tmp_path):
    mcaptrack.run(without_views, output=tmp_path / "run.mcap", events=False, tables=False)
    kept = our_messages(tmp_path / "run.mcap")
    with log.read(without_views) as opened, with_views(opened) as (shown, layouts):
        drawn = {topic: [(m.t_ns, m.sequence, m.payload) for m in shown.messages(topic)] for topic in shown.channels}
        assert layouts
    assert drawn == kept
    assert list(temporary.iterdir()) == []


def test_logs_of_the_longest_names_are_shown_where_their_tracks_are(without_views, temporary, tmp_path):
    path = tmp_path / ("a" * 250 + ".mcap")
    content = Path(shutil.copyfile(without_views, path)).read_bytes()
    with log.read(path) as opened:
        most = max(len(frame.rows) for frame in opened.frames("/camera/retracks", TRACKS))
    with mcaptrack.view(path) as server:
        assert any(f"of at most {most} tracks" in note for note in server.notes)
        assert len(server.logs) == 2
        assert len(list(temporary.iterdir())) == 1
    assert path.read_bytes() == content
    assert list(temporary.iterdir()) == []


def test_pictures_that_come_later_are_drawn_on_once(template, tmp_path):
    """Of a log without image views, as one has that was run before it had pictures, run makes what it makes of others."""
    path = tmp_path / "a.mcap"
    images = [topic for topic in our_messages(template) if topic.endswith("/view/image")]
    mcaptrack.drop(template, images, output=path)
    assert len(images) > 2
    mcaptrack.run(path, tables=False)
    assert our_messages(path) == our_messages(template)
    content = path.read_bytes()
    assert mcaptrack.run(path, tables=False).is_up_to_date
    assert path.read_bytes() == content


def test_no_file_is_served_for_a_view_that_others_recorded(template, temporary, tmp_path):
    path, topic = tmp_path / "a.mcap", "/camera/detections/view/image"
    mcaptrack.drop(template, [topic], output=path)
    with log.read(path) as opened, log.extend(opened) as writer:
        number = writer.add_channel(topic, ("of.Others", "jsonschema", b'{"type": "object"}'), "json", {})
        writer.add_message(number, opened.start_ns, 0, b"{}")
    with mcaptrack.view(path) as server:
        assert len(server.logs) == 1
        assert [str(warning) for warning in server.warnings] == [
            f"no view at {topic}, which was recorded by others (of.Others)"
        ]


@pytest.mark.parametrize("lacks", ["a folder", "room"])
def test_no_room_for_temporary_files_is_said_in_one_line(without_views, temporary, lacks):
    if lacks == "a folder":
        temporary.rmdir()
    with (
        limited(resource.RLIMIT_FSIZE, 1000) if lacks == "room" else nullcontext(),
        pytest.raises(McaptrackError, match=r"walk\.mcap lacks can't be drawn .* TMPDIR names another") as refused,
    ):
        mcaptrack.view(without_views)
    assert "\n" not in str(refused.value)
    assert not temporary.exists() or list(temporary.iterdir()) == []
