"""The sections of a report on one log: scores, forecasts, scene, moments, speeds, and how it was made."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from mcaptrack.clock import NS_PER_S
from mcaptrack.evaluation import Result
from mcaptrack.metrics import summary
from mcaptrack.report.charts import Axis, Line, beside, clock, figure, line_chart, round_most
from mcaptrack.report.contents import LogReport, TrackSet, plane_of
from mcaptrack.report.headline import rule_words
from mcaptrack.report.markup import Markup, counted, data_uri, join, name, number, percent, table, tag
from mcaptrack.report.moments import BARS, SIDE_PX, Moment, Shot, Story
from mcaptrack.report.scenery import (
    COLOURS,
    ground_panel,
    ground_paths,
    ground_span,
    pixel_paths,
    scene_panel,
)

_SCORES: Final = {"IDF1": True, "MOTA": True, "HOTA": True, "IDSW": False, "Frag": False, "FP": False, "FN": False}
_LOWER: Final = ("IDSW", "Frag", "FP", "FN")
_MEANINGS: Final = (
    "IDF1: identities kept. MOTA: rows that are right, less misses, false rows and switches. HOTA: both, over many "
    "thresholds. IDSW: identity switches. Frag: fragments. FP: false rows. FN: missed rows. Best of a group in bold."
)


def lack(words: str) -> Markup:
    """What is missing in its place; what stands between backquotes is to be typed."""
    parts = words.split("`")
    return tag("p", *(tag("code", part) if k % 2 else part for k, part in enumerate(parts)), class_="lack")


def scores(report: LogReport) -> Markup:
    """All scores by rule, and what can be said of tracks without truth."""
    parts: list[Markup] = []
    if report.results:
        parts.append(score_table(report.results, report))
        parts.append(tag("p", _MEANINGS, class_="soft"))
    if "scores" in report.lacks:
        parts.append(lack(report.lacks["scores"]))
    parts.append(_track_table(report))
    return join(parts)


def score_table(results: Sequence[Result], report: LogReport) -> Markup:
    """Scores, a group of rows for each rule."""
    called = {one.topic: (one.name, one.role) for one in report.sets.values()}
    groups: dict[tuple[str, float], list[Result]] = {}
    for result in results:
        groups.setdefault((result.similarity, result.gate), []).append(result)
    body: list[Markup] = []
    for (similarity, gate), members in sorted(groups.items()):
        body.append(tag("tr", tag("th", rule_words(similarity, gate), colspan=2 + len(_SCORES), scope="rowgroup")))
        all_values = [summary(result.score) for result in members]
        for result, values in zip(members, all_values, strict=True):
            words, role = called.get(result.tracks, (result.tracks, "truth"))
            cells = [tag("th", tag("b", words, class_=f"s-{role}"), scope="row"), tag("td", name(result.tracks))]
            for key, is_share in _SCORES.items():
                among = [one[key] for one in all_values]
                is_best = len(members) > 1 and values[key] == (min if key in _LOWER else max)(among)
                said = percent(values[key]) if is_share else number(values[key])
                cells.append(tag("td", said, class_="n best" if is_best else "n"))
            body.append(tag("tr", *cells))
    head = [tag("th", "tracks", scope="col"), tag("th", "channel", scope="col")]
    head += [tag("th", key, scope="col", class_="n") for key in _SCORES]
    caption = tag("caption", "Scores against the truth, as ", tag("code", "mcaptrack evaluate"), " gives them")
    whole = tag("table", caption, tag("thead", tag("tr", *head)), tag("tbody", *body))
    return tag("div", whole, class_="wide", tabindex="0", role="region", aria_label="scores")


def _track_table(report: LogReport) -> Markup:
    if not report.sets:
        return lack(f"Nobody has been tracked here; `mcaptrack run {report.file}` finds, tracks and re-tracks people.")
    repairs = {story.topic: story.counts["joined"] + story.counts["parted"] for story in report.stories}
    rows = [
        (
            tag("b", one["name"], class_=f"s-{one['role']}"),
            name(one["topic"]),
            number(one["tracks"]),
            number(one["median_s"], 1, "s"),
            number(one["longest_s"], 1, "s"),
            percent(one["observed_share"], 0),
            number(repairs.get(one["topic"]) if one["role"] == "offline" else None),
        )
        for one in report.data["tracks"]
    ]
    columns = ("tracks", "channel", "how many", "median length", "longest", "rows seen", "repairs")
    caption = "Tracks as they are, whoever is right. Rows seen: a detection stands behind them; others were filled in."
    return table(caption, columns, rows, words=2)


def forecasts(report: LogReport) -> Markup:
    """Errors over recall, errors by horizon, calibration."""
    found = report.data["forecasts"]
    if not found:
        why = "There are no forecasts that could be scored"
        reason = "the log has no truth" if "truth" not in report.sets else "none have a known future"
        if not any(c["schema"] == "mcaptrack.Predictions" for c in report.data["channels"]):
            reason = f"the log holds none; `mcaptrack predict {report.file}` makes them"
        return lack(f"{why}: {reason}.")
    roles = {one.topic: one for one in report.sets.values()}

    def of(one: dict[str, Any]) -> tuple[str, str]:
        known = roles.get(one["tracks"])
        return (known.name, known.role) if known else (one["tracks"], "truth")

    lines = [Line(*of(one), np.array(one["curve_recall"]), np.array(one["curve_ADE_m"])) for one in found]
    lines = [Line(line.name.replace(", sampled", ""), line.role, line.x, line.y) for line in lines]
    y = Axis("mean displacement error, m", round_most([line.y for line in lines]))
    x = Axis("recall: share of people with a forecast", 1.0)
    figures = [
        figure(
            line_chart("Displacement error of forecasts over recall", lines, x, y),
            tag("b", "Error over recall. "),
            "From left to right, people whose past was tracked best come first. Lower and longer is better.",
        )
    ]
    most = round_most(
        [
            np.array(part[key], float)
            for one in found
            for part in (one["by_horizon"], one["constant_velocity"])
            if part
            for key in ("mean_m", "three_quarters_m")
        ]
    )
    figures += [_by_horizon(one, *of(one), most) for one in found if one["by_horizon"]["n"]]
    held = [one for one in found if all(part["held"] is not None for part in one["calibration"])]
    if held:
        figures.append(_calibration([(*of(one), one["calibration"]) for one in held]))
    else:
        figures.append(lack("How well the ellipses are calibrated can't be said: the forecasts have no covariance."))
    return beside(figures)


def _by_horizon(one: dict[str, Any], words: str, role: str, most: float) -> Markup:
    part, plain = one["by_horizon"], one["constant_velocity"]
    ahead = np.array([0.0, *part["ahead_s"]])

    def of(values: list[float]) -> Any:
        return np.array([0.0, *values])

    short = words.replace(", sampled", "")
    band = (of(part["quarter_m"]), of(part["three_quarters_m"]))
    lines = [Line(short, role, ahead, of(part["mean_m"]), *band)]
    said = f"{number(part['mean_m'][-1], 2, 'm')} after {number(float(ahead[-1]), 1, 's')}"
    if plain and plain["n"]:
        far = np.array([0.0, *plain["ahead_s"]])
        lines.append(Line("walking on", "truth", far, of(plain["mean_m"]), dashed=True))
        said += f"; walking on as before would be {number(plain['mean_m'][-1], 2, 'm')} off"
    chart = line_chart(
        f"Error of the forecasts of {words} by how far ahead they look",
        lines,
        Axis("seconds ahead", float(ahead[-1])),
        Axis("distance from the truth, m", most),
    )
    caption = f"{said}. Line: mean of {counted(part['n'], 'forecast')}; band: the middle half."
    return figure(chart, tag("b", f"Error by horizon, {words}. "), caption)


def _calibration(found: Sequence[tuple[str, str, list[dict[str, float]]]]) -> Markup:
    lines = [
        Line(
            words.replace(", sampled", ""),
            role,
            np.array([part["nominal"] for part in levels]),
            np.array([part["held"] for part in levels]),
        )
        for words, role, levels in found
    ]
    chart = line_chart(
        "Share of true futures inside the forecast ellipses, against what they promise",
        lines,
        Axis("promised, %", 1.0, percent=True),
        Axis("held, %", 1.0, percent=True),
        diagonal="as promised",
    )
    said = "; ".join(
        f"{words}: " + ", ".join(f"{percent(part['held'], 0)} in {percent(part['nominal'], 0)}" for part in levels)
        for words, _, levels in found
    )
    return figure(chart, tag("b", "Calibration. "), f"{said}. Below the dashed line forecasts are too sure.")


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
        where = f"`mcaptrack ingest FILE --ground-plane H.txt --into {report.file}` adds a ground plane"
        return lack(f"Tracks can't be drawn: there is no picture, and nobody knows where on the ground they are; {where}.")
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


def moments(report: LogReport) -> Markup:
    """The timeline of switches or repairs, and pictures of those that matter most."""
    if not report.stories:
        return lack("There are no tracks that anything could happen to.")
    parts: list[Markup] = []
    if not any(story.rule for story in report.stories):
        words = "Identity switches can't be told without truth; shown is where re-tracking joined or parted tracks"
        parts.append(lack(words + "."))
    parts += [_timeline(story, shown, report) for story, shown in zip(report.stories, report.shown, strict=True)]
    for story, shown in zip(report.stories, report.shown, strict=True):
        if not story.moments:
            continue
        called = _named(report, story)
        rest = len(story.moments) - len(shown)
        more = f", and {counted(rest, 'more')[:-1] if rest != 1 else 'one'} more" if rest else ""
        more = f", and {number(rest)} more" if rest else ""
        parts.append(tag("h3", f"{called}: the {counted(len(shown), 'moment')} that matter most{more}"))
        if not any(moment.before or moment.after for moment in shown):
            why = report.lacks.get("pictures", "These have no place in the picture")
            parts.append(lack(f"{why}; so there are words alone."))
        parts.append(tag("ol", *(tag("li", _moment(moment)) for moment in shown), class_="moments"))
    return join(parts)


def _named(report: LogReport, story: Story) -> str:
    return next(one.name for one in report.sets.values() if one.topic == story.topic)


def _what(story: Story) -> str:
    if story.rule:
        return counted(len(story.moments), "identity switch", "identity switches")
    return counted(len(story.moments), "repair")


def _timeline(story: Story, shown: Sequence[Moment], report: LogReport) -> Markup:
    role = next(one.role for one in report.sets.values() if one.topic == story.topic)
    most = max([1, *story.births, *story.ends])
    span = story.span_s
    chosen = {id(moment) for moment in shown}
    parts = [tag("title", f"{_named(report, story)}: {_what(story)} over {clock(span)}")]
    for k, (born, ended) in enumerate(zip(story.births, story.ends, strict=True)):
        x, wide = f"{100 * k / BARS:.2f}%", f"{80 / BARS:.2f}%"
        if born:
            high = 18 * born / most
            parts.append(tag("rect", x=x, width=wide, y=f"{52 - high:.1f}", height=f"{high:.1f}", class_="born"))
        if ended:
            parts.append(tag("rect", x=x, width=wide, y=53, height=f"{12 * ended / most:.1f}", class_="ended"))
    for moment in story.moments:
        x = f"{100 * (moment.t_ns - report.start_ns) / NS_PER_S / span:.2f}%"
        low, kind = (1, "tick") if id(moment) in chosen else (9, "tick minor")
        said = tag("title", moment.words)
        parts.append(tag("line", said, x1=x, x2=x, y1=low, y2=28, class_=f"{kind} s-{role}"))
    parts.append(tag("line", x1="0", x2="100%", y1=30, y2=30, class_="grid"))
    for k in range(5):
        anchor = {0: None, 4: "end"}.get(k, "mid")
        parts.append(tag("text", clock(span * k / 4), x=f"{25 * k}%", y=82, class_=anchor))
    drawing = tag("svg", *parts, role="img", class_="line")
    by = f", {rule_words(*story.rule)}" if story.rule else ""
    caption = (
        tag("b", f"{_named(report, story)}: {_what(story)}", class_=f"s-{role}"),
        f"{by}. Marks: when; long ones are shown below. Bars up: tracks that begin; down: that end, at most {most} in ",
        clock(span / BARS),
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


def motion(report: LogReport) -> Markup:
    """How fast people walk and how long they stay."""
    figures: list[Markup] = []
    speeds, dwell = report.data["speed_m_per_s"], report.data["dwell_s"]
    guessed = " Metres are guessed from the size of people: nobody measured the ground." if report.is_assumed else ""
    if speeds:
        note = f"Between rows on the clock of prediction; holes left out.{guessed}"
        figures.append(_histogram(report, speeds, "Speed. ", "speed, m/s", "share of steps, %", note, "m/s", "step"))
    elif report.sets:
        where = f"`mcaptrack ingest FILE --ground-plane H.txt --into {report.file}`"
        figures.append(lack(f"Speeds can't be said: nobody knows where on the ground people are. {where} adds a plane."))
    if dwell:
        note = "From the first row of a track to its last."
        figures.append(_histogram(report, dwell, "Dwell. ", "time there, s", "share of tracks, %", note, "s", "track"))
    return beside(figures) if figures else lack("Nobody is there, so nobody moves.")


def _histogram(
    report: LogReport, found: dict[str, Any], title: str, x: str, y: str, note: str, unit: str, of: str
) -> Markup:
    roles = {one.topic: one for one in report.sets.values()}
    edges = np.array(found["edges"])
    lines, said = [], []
    for part in found["series"]:
        one = roles[part["topic"]]
        if not part["n"]:
            continue
        shares = np.array(part["counts"]) / part["n"]
        short = one.name.replace(", sampled", "")
        lines.append(Line(short, one.role, edges, shares, steps=True, dashed=one.role == "truth"))
        beyond = f", {number(part['above'])} beyond" if part["above"] else ""
        said.append(f"{short}: median {number(part['median'], 2, unit)} of {counted(part['n'], of)}{beyond}")
    most = round_most([line.y for line in lines])
    axes = Axis(x, float(edges[-1])), Axis(y, most, percent=True)
    chart = line_chart(f"Histogram: {x}", lines, *axes)
    return figure(chart, tag("b", title), "; ".join(said) + ". " + note)


def provenance(report: LogReport) -> Markup:
    """What the log is and how everything in it was made."""
    data = report.data
    span = "no messages"
    if data["start_ns"] is not None:
        span = f"{data['start_ns'] / NS_PER_S:.3f} to {data['end_ns'] / NS_PER_S:.3f} s"
    ground = {"given": "measured", "assumed": "guessed from the size of people", None: "none"}[data["ground_plane"]]
    about = [
        ("file", name(data["log"])),
        ("results beside it", name(data["results_file"]) if data["results_file"] else None),
        ("size", number(data["bytes"] / 1e6, 2, "MB") + ", " + counted(data["messages"], "message")),
        ("log time", f"{span} ({number(data['duration_s'], 1, 's')})"),
        ("ground plane", ground),
        ("digest", tag("code", data["digest"])),
    ]
    listed = tag("dl", *(join([tag("dt", k), tag("dd", v)]) for k, v in about if v is not None), class_="about")
    shown = [c for c in data["channels"] if c["transform"] != "view"]
    if not shown:
        return join([listed, lack("The log has no channels.")])
    rows = [_made(channel) for channel in _by_lineage(shown)]
    columns = ("channel", "made by", "digest", "messages")
    caption = "How each channel was made; views are left out. Whole digests and all parameters are in the page's data."
    return join([listed, table(caption, columns, rows, words=3)])


def _by_lineage(channels: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Channels after what they were made from, with how deep they stand."""
    topics = {channel["topic"] for channel in channels}
    out: list[dict[str, Any]] = []

    def add(channel: dict[str, Any], depth: int) -> None:
        if any(done["topic"] == channel["topic"] for done in out):
            return
        out.append(channel | {"depth": depth})
        for other in channels:
            if other["input"] == channel["topic"]:
                add(other, depth + 1)

    for channel in channels:
        if channel["input"] not in topics:
            add(channel, 0)
    for channel in channels:  # those that say they were made from each other
        add(channel, 0)
    return out


def _made(channel: dict[str, Any]) -> tuple[object, ...]:
    how: list[object] = [channel["schema"] or "no schema"]
    if channel["transform"]:
        how = [tag("b", channel["transform"]), f", mcaptrack {channel['version'] or '?'}"]
        if channel["input"]:
            how += [", from ", name(channel["input"])]
        if channel["reference"]:
            how += [", compared with ", name(channel["reference"])]
    if channel["stale"]:
        how.append(tag("span", " out of date", class_="stale"))
    said = {key: value for key, value in (channel["parameters"] or {}).items() if key != "ground_planes"}
    if said:
        words = ", ".join(f"{key} {_parameter(value)}" for key, value in sorted(said.items()))
        how.append(tag("details", tag("summary", counted(len(said), "parameter")), words, class_="made"))
    deep = Markup("&emsp;" * min(channel["depth"], 6))
    digest = channel["digest"]
    short = tag("code", digest[:12], title=digest) if digest else "–"
    return join([deep, name(channel["topic"])]), join(how), short, number(channel["messages"])


def _parameter(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
