"""What is odd about a channel that a stage made: that nothing came of it and why, or that it can't be relied on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mcaptrack import log
from mcaptrack.errors import command
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import Planes, is_assumed
from mcaptrack.notices import known_code, warn
from mcaptrack.schema import TRACKS, VIDEO, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import camera_at
from mcaptrack.transforms import Detect, Predict, Retrack, Sample, Sort, Transform

#: What stages take, measured with 2 to 20 people at 15 pictures a second, in bytes.
_BASE, _A_PICTURE, _A_BOX = 100_000_000, 3_000, 1_600


def warn_of_nothing(source: str, transform: Transform, given: Sequence[Frame], made: Sequence[Frame]) -> None:
    """Warn if no rows came of a stage's input though there were some, or if there were none; with the likely reason."""
    if any(len(frame.rows) for frame in made):
        return
    if transform.reads is not VIDEO and not any(len(frame.rows) for frame in given):
        warn(f"{source} holds nothing, so nothing was made of it", "nothing-found")
        return
    warn(f"{_what_is_missing(transform)} of {source}: {_reason(transform, given, made)}", "nothing-found")


def _what_is_missing(transform: Transform) -> str:
    what = {Detect: "boxes", Sort: "tracks", Sample: "samples", Predict: "forecasts", Retrack: "re-tracked tracks"}
    return "no " + next((words for kind, words in what.items() if isinstance(transform, kind)), "rows")


def _reason(transform: Transform, given: Sequence[Frame], made: Sequence[Frame]) -> str:
    if isinstance(transform, Detect):
        return f"nothing moves in its {len(made)} pictures that stands out by the threshold"
    if isinstance(transform, Sort):
        boxes = sum(len(frame.rows) for frame in given)
        return f"none of {boxes} boxes is followed for long enough (min_hits_s): too few pictures a second, perhaps"
    if isinstance(transform, Sample):
        return "no track is there at two ticks, or none stands on the ground plane"
    if isinstance(transform, Predict):
        needed_s = (transform.min_history - 1) / transform.rate_hz
        return f"no track is without a gap for the {needed_s:.3g} s that a forecast needs (min_history)"
    if isinstance(transform, Retrack):
        longest_s = longest_track_s(given)
        if longest_s < transform.min_track_s:
            least_s = f"{transform.min_track_s:g} s"
            return f"the longest track lasts {longest_s:.3g} s; those under {least_s} are left out (min_track_s)"
        return "no track is likely enough to be a person (min_certainty)"
    return "the stage gave none"


def longest_track_s(frames: Iterable[Frame]) -> float:
    """How long the longest track of some frames lasts."""
    members = list(frames)
    rows = TRACKS.joined([frame.rows for frame in members])
    t_ns = np.repeat(np.array([frame.t_ns for frame in members], np.int64), [len(frame.rows) for frame in members])
    order = np.lexsort((t_ns, rows["track_id"]))
    ids, t_ns = rows["track_id"][order], t_ns[order]
    first = np.flatnonzero(np.append(True, ids[1:] != ids[:-1]))
    last = np.append(first[1:], len(ids)) - 1
    return float((t_ns[last] - t_ns[first]).max()) / NS_PER_S


def warn_of_memory(pictures: int, boxes: int) -> None:
    """Warn if running stages on so many boxes in so many pictures takes more memory than there is."""
    needed, free = _BASE + pictures * _A_PICTURE + boxes * _A_BOX, free_memory()
    if free is not None and needed > free:
        warn(
            f"{boxes:,} boxes in {pictures:,} pictures take about {needed / 1e9:.1f} GB of memory, and "
            f"{free / 1e9:.1f} GB are free: what is computed stays in memory until all is written",
            "memory",
        )


def free_memory() -> int | None:
    """How many bytes of memory this process can still take, as Linux says; None where that isn't known."""
    found = []
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        found += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
        most, now = (Path(f"/sys/fs/cgroup/memory.{name}").read_text().strip() for name in ("max", "current"))
        found += [int(most) - int(now)] if most != "max" else []
    except (OSError, ValueError):
        pass  # no Linux, or no group of its own
    return min(found, default=None)


def warn_of_what_stands(
    opened: log.Log, prefix: str, made: Mapping[str, Provenance], planes: Planes, is_all: bool
) -> None:
    """Warn of what was odd when channels were made, and of a scale that was guessed.

    This is about channels that were ``made`` now and what these were made from, or, with ``is_all``, about all of the
    camera.
    """
    known = dict(made)
    for topic in sorted(camera_at(opened, prefix).topics):
        how = Provenance.from_metadata(opened.channels[topic].metadata)
        if how is not None:
            known.setdefault(topic, how)
    topics = list(known) if is_all else list(made)
    for topic in topics:
        if known[topic].input in known and known[topic].input not in topics:
            topics.append(known[topic].input)
    stages = {known[topic].transform for topic in topics}
    for topic in topics:
        for code, message in known[topic].warnings:
            warn(message, known_code(code))
    if is_assumed(planes) and stages & {"track", "sample", "predict", "retrack"}:
        metres = 1 / planes[0][1].homography[0]
        give = command("ingest", "INPUT", "--ground-plane", "HOMOGRAPHY")
        warn(
            f"no ground plane is known: taking {metres:.3g} px for a metre, since people are 1.7 m high; distances, "
            f"speeds and re-tracking go by it. Give one with {give}",
            "assumed-ground-plane",
        )
    if any(
        known[topic].parameters.get("poor_scale") and not known[topic].parameters.get("side_view") for topic in topics
    ):
        warn(
            "tracks were not re-tracked but passed on: without a ground plane that needs a camera that looks down, and "
            f"this one looks along the ground. To insist: {command('retrack', opened.path, '--side-view')}",
            "held-back",
        )
