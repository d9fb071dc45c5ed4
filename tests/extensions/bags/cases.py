"""Cases of bags for the tests of the core."""

from functools import partial
from pathlib import Path

import mcaptrack


def _export(folder: Path) -> None:
    mcaptrack.export(folder / "a.mcap", folder / "bag", form="rosbag2", force=True)


def _prepare(folder: Path) -> None:
    lines = [f"{12 * n} {who} {0.4 * n + who} {who * 5.0}" for n in range(12) for who in (1, 2)]
    (folder / "world.txt").write_text("\n".join(lines))
    mcaptrack.ingest(folder / "world.txt", folder / "a.mcap")
    mcaptrack.run(folder / "a.mcap")
    _export(folder)


NAMED = {"rosbag2": ["export", "--format", "rosbag2"]}
WORKS = {"export to a bag": (_prepare, _export, _export, 5)}
WRITTEN = {
    name: partial(mcaptrack.export, form=form) for name, form in (("bag", "rosbag2"), ("old bag", "rosbag2-sqlite3"))
}
DEEP = {
    "bags": (
        "it reads recordings within the limits of `ingest`, and writes what views draw",
        "foxglove.views.ground foxglove.views.people log.recording_files schema.encodings sources.fixed_frame "
        "sources.foreign.definitions sources.ingest.decompression sources.ingest.plain_yaml sources.ingest.recording",
    )
}
