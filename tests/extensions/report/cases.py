"""Cases of ``report`` for the tests of the core."""

import html
import re
from pathlib import Path

import mcaptrack
from tests.commands import done

READING = {"report": lambda log, out: [log, "-o", out / "report.html"]}
EFFECTS = {
    "report": (
        "report a.mcap",
        {"camera": "--camera other", "output": "-o b.html", "force": ("report a.mcap -o old.html", "--force")},
    )
}
REFUSED = {
    "no logs for a page": (lambda: mcaptrack.report([], "a.html"), "there is no log to report on"),
    "a folder for a page": (lambda: mcaptrack.report("."), ". is a folder, not an MCAP file"),
}
TOGETHER = {
    "report": lambda logs, folder: [log["name"] for log in mcaptrack.report(logs, folder / "page.html").data["logs"]]
}


def _topics(path: Path, folder: Path) -> list[str]:
    """The channels in the table of a page."""
    done("report", path, "-o", folder / "a.html")
    page = (folder / "a.html").read_text().replace("<wbr>", "")  # where names may be broken over lines
    return re.findall(r"<th scope=.row.[^>]*><bdi><code>(/[^<]+)<", page)


TOPICS_IN_ORDER = {"report": _topics}
WRITTEN = {"a.html": lambda path, output: mcaptrack.report(path, output=output)}


def _text(scene) -> str:
    """The text of the page of the log of a scene."""
    scene.says("report", "LOG", "-o", "page.html")
    return html.unescape(re.sub(r"<[^>]*>", "", re.sub(r"</?code>", "`", Path("page.html").read_text())))


PROPOSALS = {
    "extensions/report/figures.py:identity_events:view": _text,
    "extensions/report/contents.py:_score:ingest": lambda s: _text(s.without("/camera/truth*")),
    "extensions/report/page.py:_without_ground_truth:run": lambda s: _text(s.ingested("clip.mp4")),
    "extensions/report/sections.py:scores:run": lambda s: _text(s.ingested("clip.mp4")),
    "extensions/report/sections.py:forecasts:predict": lambda s: _text(s.without("*predictions*")),
}
#: Modules of the core that aren't public, and why it needs them.
DEEP = {
    "report": (
        "it shows all that is evaluated",
        "evaluation.aligned evaluation.events evaluation.forecasts evaluation.people "
        "foxglove.views.people schema.resampling tables.catalogue tables.export.contents "
        "viewing.charts",
    )
}
