"""Sections of the report of other packages, checked before they stand in a page."""

from __future__ import annotations

import json
from collections.abc import Mapping

from mcaptrack import log
from mcaptrack.contracts import ReportSection
from mcaptrack.registry import Entry, blamed, of_type
from mcaptrack.viewing.formatting import plain

__all__ = ["section_of"]


def section_of(entry: Entry, opened: log.Log, prefix: str, names: Mapping[str, str]) -> ReportSection | None:
    """Return what the function of a section gives of a camera; None if it has nothing to say.

    Raises McaptrackError, with the entry, if it fails, or gives what can't stand in a page or in its data.

    ``prefix`` is the camera, and ``names`` are those of tracks for people, by their role.
    """
    with blamed(entry, "failed"):
        given = entry.cls(opened, prefix, names)
    if given is None:
        return None
    section = of_type(entry, given, ReportSection, "its function")
    with blamed(entry, "gave what is no ReportSection"):
        _check(section)
    return section


def _check(section: ReportSection) -> None:
    """Raise an error for a section that can't stand in a page, or in its data."""
    texts = [section.short, section.title, section.note]
    for caption, columns, groups in section.tables:
        texts += [caption, *columns]
        for heading, rows in groups:
            texts += [heading, *(text for role, name, topic, cells in rows for text in (role, name, topic, *cells))]
    for figure in section.figures:
        texts += [figure["title"], figure["caption"], figure["chart"]["kind"]]
    json.dumps(plain(section.data))
    if wrong := [text for text in texts if not isinstance(text, str)]:
        raise TypeError(f"{wrong[0]!r:.40} is no text")
