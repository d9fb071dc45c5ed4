"""What pictures say in a report: where people walked, and the moments in which identities changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from mcaptrack.foxglove.colours import COUNT as COLOURS
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.viewing.report.charts import beside, clock, figure, time_ticks
from mcaptrack.viewing.report.contents import LogReport, TrackSet, plane_of
from mcaptrack.viewing.report.headline import rule_words
from mcaptrack.viewing.report.markup import Markup, counted, data_uri, join, lack, number, tag
from mcaptrack.viewing.report.moments import BARS, SIDE_PX, Moment, Shot, Story
from mcaptrack.viewing.report.scenery import (
    ground_panel,
    ground_paths,
    ground_span,
    pixel_paths,
    scene_panel,
)


def scene(report: LogReport, number_of: int) -> Markup:
    """Tracks over the picture, or on the ground."""
    sets = [report.sets[role] for role in ("tracks", "offline", "truth") if role in report.sets]
    sets = [one for one in sets if any(len(frame.rows) for frame in one.frames)]
    parts: list[Markup] = []
    if not sets:
        return lack("There are no tracks to draw.")
    if report.behind is not None:
        plane = plane_of(report)
        drawn = [(one, pixel_paths(one.frames, plane)) for one in sets]
        drawn = [(one, paths) for one, paths in drawn if paths]
        panels = [
            figure(
                scene_panel(
                    _title(one), paths, report.behind, report.start_s, f"scene-{number_of}", holds_picture=k == 0
                ),
                *_caption(one, len(paths)),
            )
            for k, (one, paths) in enumerate(drawn)
        ]
        if panels:
            return join([beside(panels), tag("p", _COLOURS_SAY, class_="soft")])
        parts.append(lack("No track has a place in the picture; here is the ground instead."))
    else:
        parts.append(lack(report.lacks.get("pictures", "There are no pictures") + "; here is the ground instead."))
    on_ground = [(one, ground_paths(one.frames)) for one in sets]
    on_ground = [(one, paths) for one, paths in on_ground if paths]
    if not on_ground:
        return lack(
            "Tracks can't be drawn: there is no picture, and nothing says where on the ground they are; a ground plane "
            "does."
        )
    span = ground_span([points for _, paths in on_ground for _, points, _ in paths])
    panels = [
        figure(ground_panel(_title(one), paths, span, report.start_s), *_caption(one, len(paths)))
        for one, paths in on_ground
    ]
    return join([*parts, beside(panels), tag("p", _COLOURS_SAY, class_="soft")])


_COLOURS_SAY: Final = (
    "Each identity has a colour, the same as in viewers; there are fewer colours than identities, so they come again."
)


def _title(one: TrackSet) -> str:
    return f"Tracks of {one.name}"


def _caption(one: TrackSet, count: int) -> tuple[Markup, str]:
    return tag("b", one.name, class_=f"s-{one.role}"), f": {counted(count, 'track')}"


def moments(report: LogReport, level: int = 3) -> Markup:
    """The timeline of switches or repairs, and pictures of those that matter most, below headings of this level."""
    if not report.stories:
        return lack("There are no tracks that anything could happen to.")
    parts: list[Markup] = []
    if not any(story.rule for story in report.stories):
        words = "Identity switches can't be told without truth; shown is where re-tracking joined or parted tracks"
        parts.append(lack(words + "."))
    if "samples" in report.sets and any(story.rule for story in report.stories):
        parts.append(tag("p", _OTHER_CLOCK, class_="soft"))
    parts += [_timeline(story, shown, report) for story, shown in zip(report.stories, report.shown, strict=True)]
    for story, shown in zip(report.stories, report.shown, strict=True):
        if not story.moments:
            continue
        called = _named(report, story)
        rest = len(story.moments) - len(shown)
        most = "the moment that matters most" if len(shown) == 1 else f"the {len(shown)} moments that matter most"
        more = f", and {number(rest)} more" if rest else ""
        parts.append(tag(f"h{level}", f"{called}: {most}{more}"))
        if not any(moment.before or moment.after for moment in shown):
            why = report.lacks.get("pictures", "These have no place in the picture")
            parts.append(lack(f"{why}; so there are words alone."))
        parts.append(tag("ol", *(tag("li", _moment(moment)) for moment in shown), class_="moments"))
    return join(parts)


_OTHER_CLOCK: Final = (
    "These are the events of the log: what the tracker made at every picture, and what re-tracking made on the clock "
    "of prediction. The headline counts both on the same clock, so its number for the tracker is another."
)


def _named(report: LogReport, story: Story) -> str:
    return next(one.name for one in report.sets.values() if one.topic == story.topic)


def _what(story: Story) -> str:
    if story.rule:
        return ": " + counted(len(story.moments), "identity switch", "identity switches")
    return ": " + counted(len(story.moments), "repair") if story.moments else ""


def _timeline(story: Story, shown: Sequence[Moment], report: LogReport) -> Markup:
    role = next(one.role for one in report.sets.values() if one.topic == story.topic)
    most = max([1, *story.births, *story.ends])
    span = story.span_s
    chosen = {id(moment) for moment in shown}
    parts = [tag("title", f"{_named(report, story)}{_what(story)} over {clock(span)}")]
    for k, (born, ended) in enumerate(zip(story.births, story.ends, strict=True)):
        x, wide = f"{100 * k / BARS:.2f}%", f"{80 / BARS:.2f}%"
        if born:
            high = 18 * born / most
            parts.append(tag("rect", x=x, width=wide, y=f"{52 - high:.1f}", height=f"{high:.1f}", class_="born"))
        if ended:
            parts.append(tag("rect", x=x, width=wide, y=53, height=f"{12 * ended / most:.1f}", class_="ended"))
    places = [f"{100 * (moment.t_ns - report.start_ns) / NS_PER_S / span:.1f}%" for moment in story.moments]
    minor = f"tick minor s-{role}"
    parts += [tag("line", x1=x, x2=x, y1=9, y2=28, class_=minor) for x in dict.fromkeys(places)]
    for moment, x in zip(story.moments, places, strict=True):
        if id(moment) in chosen:
            said = tag("title", moment.words)
            parts.append(tag("line", said, x1=x, x2=x, y1=1, y2=28, class_=f"tick s-{role}"))
    parts.append(tag("line", x1="0", x2="100%", y1=30, y2=30, class_="rule"))
    for tick in time_ticks(span).tolist():
        x = f"{100 * tick / span:.2f}%"
        anchor = "end" if tick > 0.97 * span else "mid" if tick else None
        parts.append(tag("line", x1=x, x2=x, y1=66, y2=70, class_="axis"))
        parts.append(tag("text", clock(tick, span), x=x, y=83, class_=anchor))
    drawing = tag("svg", *parts, role="img", class_="line")
    by = f", {rule_words(*story.rule)}" if story.rule else ""
    caption = (
        tag("b", f"{_named(report, story)}{_what(story)}", class_=f"s-{role}"),
        f"{by}. Marks: when; long ones are shown below. Bars up: tracks that begin; down: that end, at most {most} in ",
        number(span / BARS, 2, "s"),
        ".",
    )
    return figure(drawing, *caption)


def _moment(moment: Moment) -> Markup:
    shots = [(shot, words) for shot, words in ((moment.before, "before"), (moment.after, "after")) if shot]
    drawn = tag("div", *(_shot(shot, words) for shot, words in shots), class_="shots") if shots else ""
    return figure(drawn, f"{moment.words[:1].upper()}{moment.words[1:]}.")


def _shot(shot: Shot, when: str) -> Markup:
    parts: list[Markup] = [tag("image", href=data_uri(shot.jpeg), width=SIDE_PX, height=SIDE_PX)]
    said = f"{when}, at {number(shot.at_s, 1, 's')}"
    if shot.box:
        x, y, w, h = (f"{value:.1f}" for value in shot.box.xywh)
        parts.append(tag("rect", x=x, y=y, width=w, height=h, class_="under"))
        parts.append(tag("rect", x=x, y=y, width=w, height=h, class_=f"mark c{shot.box.identity % COLOURS}"))
        top = max(shot.box.xywh[1] - 4, 14)
        parts.append(tag("text", shot.box.label, x=f"{max(shot.box.xywh[0], 2):.1f}", y=f"{top:.1f}", class_="tag"))
        said += f": track {shot.box.label}"
    parts.append(tag("text", f"{when} {number(shot.at_s, 1, 's')}", x=4, y=SIDE_PX - 6, class_="when"))
    return tag("svg", tag("title", said), *parts, viewBox=f"0 0 {SIDE_PX} {SIDE_PX}", role="img")
