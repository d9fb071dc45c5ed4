"""Assign the columns of a table with a header: named by the user, or guessed from common headers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

from mcaptrack.errors import McaptrackError

#: What a column may hold: corners, size and centre of a box in pixels, and more.
KEYS: Final = ("x", "y", "w", "h", "x2", "y2", "cx", "cy", "frame", "t", "score", "class", "name", "id")
#: What columns of 3D boxes may hold, beside frame, t, score, class, name and id.
KEYS_3D: Final = (
    *("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "heading_deg"),
    *("qw", "qx", "qy", "qz", "vx_m_per_s", "vy_m_per_s"),
)
#: The ways to give a box along x and y. The one is read that the user named most of, else the first that is complete:
#: beside two corners, a width and a height are often those of the picture.
_SPANS: Final = ((("x", "x2"), ("x", "w"), ("cx", "w")), (("y", "y2"), ("y", "h"), ("cy", "h")))
_WITH_UNITS: Final = tuple(f"{what}{unit}" for what in ("t", "time", "timestamp") for unit in ("s", "ms", "us", "ns"))
#: Headers by key, without blanks, "_", "-", "." and brackets, and in lower case.
HEADERS: Final[Mapping[str, tuple[str, ...]]] = {
    "x": ("x", "x1", "xmin", "minx", "left", "bbleft", "bboxleft", "bboxx", "bboxx1", "bboxxmin", "xtl", "xleft"),
    "y": ("y", "y1", "ymin", "miny", "top", "bbtop", "bboxtop", "bboxy", "bboxy1", "bboxymin", "ytl", "ytop"),
    "w": ("w", "width", "bbwidth", "bboxwidth", "bboxw"),
    "h": ("h", "height", "bbheight", "bboxheight", "bboxh"),
    "x2": ("x2", "xmax", "maxx", "right", "bbright", "bboxright", "bboxx2", "bboxxmax", "xbr", "xright"),
    "y2": ("y2", "ymax", "maxy", "bottom", "bbbottom", "bboxbottom", "bboxy2", "bboxymax", "ybr", "ybottom"),
    "cx": ("cx", "xc", "xcenter", "xcentre", "centerx", "centrex"),
    "cy": ("cy", "yc", "ycenter", "ycentre", "centery", "centrey"),
    "frame": ("frame", "frameindex", "frameidx", "framenumber", "frameno", "framenum", "frameid", "image", "imageid",
              "imagename", "filename", "file"),
    "t": ("t", "time", "timestamp", "seconds", "stamp", *_WITH_UNITS),
    "score": ("score", "confidence", "conf", "probability", "prob"),
    "class": ("class", "classid", "cls", "label", "category", "categoryid", "labelid", "objectclass"),
    "name": ("classname", "categoryname", "labelname", "name"),
    "id": ("trackid", "trackerid", "id", "track", "objectid", "targetid", "tid", "trackuuid", "uuid"),
}  # fmt: skip
#: Keys of which several columns may fit; the first header of the list above is read.
_RANKED: Final = ("frame", "t", "class", "id")
IGNORED: Final = re.compile(r"[\s_\-.()\[\]/:]+|px$|pixels$")


def parse_columns(text: str) -> dict[str, str]:
    """Columns by key from "x=left,y=top". Raises McaptrackError if it isn't of this form."""
    out: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        key, equals, column = (word.strip() for word in part.partition("="))
        if not equals or not column:
            raise McaptrackError(f"`columns=` is like x=left,y=top,w=width,h=height,frame=frame, not {part!r:.60}")
        if key in out:
            raise McaptrackError(f"`columns=` names {key} twice")
        if column in out.values():
            raise McaptrackError(f"`columns=` names {column} for {key} and for another key")
        out[key] = column
    return check_keys(out)


def check_keys(columns: Mapping[str, str]) -> dict[str, str]:
    """Check the keys of columns. Raises McaptrackError, with the known ones."""
    allowed = (*KEYS, *KEYS_3D)
    unknown = [key for key in columns if key not in allowed]
    if unknown:
        raise McaptrackError(f"`columns=` knows no {str(unknown[0])!r:.40}; it knows {', '.join(allowed)}")
    return dict(columns)


def choose_columns(where: str, header: Sequence[str], chosen: Mapping[str, str]) -> dict[str, int]:
    """The index of the column for each key: those ``chosen`` by name, and guesses for the other keys.

    Raises McaptrackError if a column doesn't exist, if guesses are ambiguous, or if no box or frame can be made.
    """
    shown = f"its columns are {', '.join(header)}"[:300]
    out = {key: _named(where, header, key, column, shown) for key, column in chosen.items()}
    plain = [IGNORED.sub("", name.strip().lower()) for name in header]
    skipped = _superseded(out)
    for key, names in HEADERS.items():
        fits = [at for name in names for at, cell in enumerate(plain) if cell == name and at not in out.values()]
        if key in out or key in skipped or not fits:
            continue
        # In headers of MOTChallenge (bb_left, ..., conf, x, y, z), x and y are a place in the world.
        fits = [at for at in fits if plain[at].startswith("bb")] or fits
        if len(fits) > 1 and key not in _RANKED:
            if len({header[at] for at in fits}) < len(fits):
                raise McaptrackError(f"{where}: several columns are named {header[fits[0]]}; {shown}")
            text = " and ".join(header[at] for at in fits)
            raise McaptrackError(
                f"{where}: {text} could both be {key}; choose with `columns={key + '=' + header[fits[0]]!r}`"
            )
        out[key] = fits[0]
    for axis in _SPANS:
        complete = [pair for pair in axis if all(key in out for key in pair)]
        complete.sort(key=lambda pair: -len(chosen.keys() & pair))
        if not complete:
            raise McaptrackError(
                f"{where}: no columns for {' and '.join(axis[0])} (or {' and '.join(axis[1])}) of boxes; {shown}; name "
                "them with `columns='x=left,y=top,w=width,h=height,frame=frame'`"
            )
        for key in {key for pair in axis for key in pair} - set(complete[0]):
            out.pop(key, None)
    if "name" not in chosen and "class" not in out and "name" in out and plain[out["name"]] == "name":
        out.pop("name")  # of anything: beside a number of a class it is that of the class
    if "frame" in out:
        out.pop("t", None)
    elif "t" not in out:
        raise McaptrackError(
            f"{where}: no column for the frame or the time of boxes; {shown}; name it with `columns='frame=NAME'` or "
            "`columns='t=NAME'` (in seconds)"
        )
    if unread := [key for key in chosen if key not in out]:
        read = ", ".join(key for key in chosen if key in out)
        raise McaptrackError(f"{where}: {unread[0]} is not read beside {read}, which `columns=` names; leave it out")
    return out


def _named(where: str, header: Sequence[str], key: str, column: str, shown: str) -> int:
    places = [at for at, name in enumerate(header) if name.strip() == column.strip()]
    if len(places) != 1:
        what = f"{len(places)} columns are named {column}" if places else f"no column is named {column}"
        raise McaptrackError(f"{where}: {what}, as `columns=` says for {key}; {shown}")
    return places[0]


def _superseded(chosen: Mapping[str, int]) -> set[str]:
    """Keys that aren't guessed, because others that the user named say the same."""
    out = {key for key, other in (("frame", "t"), ("t", "frame")) if other in chosen}
    for axis in _SPANS:
        if any(all(key in chosen for key in pair) for pair in axis):
            out |= {key for pair in axis for key in pair} - chosen.keys()
    return out
