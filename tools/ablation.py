"""What each part of re-tracking gives: scores with parts off and on, over several sets of data, with their spread.

    .venv/bin/python tools/ablation.py
    .venv/bin/python tools/ablation.py --corrupted sdd/train --scenes sdd-noisy --scenes sdd-detections \
        --homographies sdd/homography -o docs/method.md

The first table has the profiles and the default without one part each, the second the way from the paper to the
default, one step a row.
`--corrupted` are true tracks with all kinds of `corruptions.py`: their scores are means over seeds, with the standard
deviation. Without a folder they are synthetic crowds. `--scenes` are folders as of `reproduce.py`, drawn once: their
spread is that of 200 choices of as many scenes with replacement. IDF1 / MOTA / identity switches within 1 m, by
motmetrics' rules. Tables are printed, and with -o they replace those between the marks of a page.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import CORRUPTIONS
from reproduce import scenes
from score_retrack import GATE_M, NAMES, Retracker, Scores, measure

from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import Score, combine, score, summary
from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack import Retracking

PAPER, AUTHORS, DEFAULT = PROFILES["paper"], PROFILES["authors"], PROFILES["default"]
#: Nothing done after the fact.
_PLAIN = {"link_s": 0.0, "resolve_swaps": False, "smooth": False, "track_confidence": 0.0}
#: The way from the paper to the default, one step a row; each row's options are those of `mcaptrack retrack`.
STEPS: dict[str, tuple[str, Retracking]] = {
    "paper": ("--profile paper", PAPER),
    "authors": ("--profile authors", AUTHORS),
    "computed covariance": (
        "--profile authors --set covariance=predictor --predictor kalman --set gate_m=3 --set alpha=1 --set beta=0",
        replace(AUTHORS, covariance="predictor", predictor="kalman", gate_m=3.0, alpha=1.0, beta=0.0),
    ),
    "likelihood, estimated noise": (
        "--set link_s=0 --set resolve_swaps=false --no-smooth --set track_confidence=0",
        replace(DEFAULT, **_PLAIN),
    ),
    "+ false-track removal": (
        "--set link_s=0 --set resolve_swaps=false --no-smooth",
        replace(DEFAULT, **_PLAIN | {"track_confidence": 0.5}),
    ),
    "+ offline linking": ("--set resolve_swaps=false --no-smooth", replace(DEFAULT, resolve_swaps=False, smooth=False)),
    "+ identity swaps at encounters": ("--no-smooth", replace(DEFAULT, smooth=False)),
    "+ smoothing (the default)": ("", DEFAULT),
}


#: Numbers that switch a part off.
_OFF = {"track_confidence": 0.0, "link_s": 0.0, "merge_distance_m": 0.0, "same_id_bonus": 0.0, "noise_m": 0.2}
_NAMES = {
    "track_confidence": "false-track removal",
    "link_s": "offline linking",
    "merge_distance_m": "merged detections",
    "same_id_bonus": "input ids",
    "noise_m": "estimated noise",
    "resolve_swaps": "identity swaps at encounters",
    "smooth": "smoothing",
}


def _parts() -> dict[str, tuple[str, Retracking]]:
    """The profiles, and the default without one part each, with the options of `mcaptrack retrack` for it."""
    out: dict[str, tuple[str, Retracking]] = {name: STEPS[name] for name in ("paper", "authors")}
    out["the default"] = ("", DEFAULT)
    for field in fields(DEFAULT):
        flag = field.name.replace("_", "-")
        has_flag = field.metadata.get("flag", True)
        name = f"no {_NAMES.get(field.name, field.name.replace('_', ' '))}"
        if field.name in _OFF:
            out[name] = (
                (f"--{flag} " if has_flag else f"--set {field.name}=") + f"{_OFF[field.name]:g}",
                replace(DEFAULT, **{field.name: _OFF[field.name]}),
            )
        elif field.name in _NAMES and getattr(DEFAULT, field.name) is True:  # others don't concern tracks
            out[name] = (
                f"--no-{flag}" if has_flag else f"--set {field.name}=false",
                replace(DEFAULT, **{field.name: False}),
            )
    return out


PARTS = _parts()
TABLES = {"Without one part": PARTS, "From the paper to the default": STEPS}
INPUT = "the input"
CHOICES = 200


def corrupted(
    retrackers: Mapping[str, Retracker | None], folder: Path | None, seeds: int, count: int, steps: int
) -> dict[str, Scores]:
    """The scores of each re-tracker on all kinds of corruption: for each seed the mean over kinds."""
    out: dict[str, list[Scores]] = {name: [] for name in retrackers}
    for kind in CORRUPTIONS:
        found, _ = measure(retrackers, folder, kind, seeds, count, steps)
        for name, one in found.items():
            out[name].append(one)
        print(f"{kind} is done", file=sys.stderr, flush=True)
    return {
        name: {key: np.mean([one[key] for one in kinds], axis=0).tolist() for key in NAMES}
        for name, kinds in out.items()
    }


def drawn_once(
    retrackers: Mapping[str, Retracker | None], folder: Path, homographies: Path | None
) -> dict[str, Scores]:
    """The scores of each re-tracker on all scenes of a folder, and then on ``CHOICES`` random choices of them."""
    parts: dict[str, list[Score]] = {name: [] for name in retrackers}
    for scene, true, samples in scenes(folder, homographies, 30.0):
        for name, retrack in retrackers.items():
            found = samples if retrack is None else [result[0] for result in retrack(samples)]
            parts[name].append(score(make_matchup(true, found, "metres", GATE_M), "motmetrics"))
        print(f"{scene} is done", file=sys.stderr, flush=True)
    count = len(parts[INPUT])
    choices = [range(count), *np.random.default_rng(0).integers(0, count, (CHOICES, count)).tolist()]
    return {name: _scores(members, choices) for name, members in parts.items()}


def _scores(members: list[Score], choices: Iterable[Iterable[int]]) -> Scores:
    rows = [summary(combine([members[k] for k in choice])) for choice in choices]
    return {name: [float(row[name]) * (1 if name == "IDSW" else 100) for row in rows] for name in NAMES}


def cell(scores: Scores, is_seeded: bool) -> str:
    """IDF1 / MOTA / switches with their spread: the mean over seeds, or the scores of all scenes, which come first."""
    texts = []
    for name in NAMES:
        values = np.array(scores[name])
        mean, rest = (values.mean(), values) if is_seeded else (values[0], values[1:])
        texts.append(f"{mean:.1f}" + (f" ({rest.std(ddof=1):.1f})" if len(rest) > 1 else ""))
    return " / ".join(texts)


def tables(columns: Mapping[str, tuple[dict[str, Scores], bool]]) -> dict[str, str]:
    """The tables in Markdown, by heading."""
    out = {}
    for heading, rows in TABLES.items():
        lines = [
            "| | options of `mcaptrack retrack` | " + " | ".join(columns) + " |",
            "|---" * (2 + len(columns)) + "|",
        ]
        for name, flags in {INPUT: "", **{name: flags for name, (flags, _) in rows.items()}}.items():
            cells = [cell(found[name], is_seeded) for found, is_seeded in columns.values()]
            lines.append(f"| {name} | {f'`{flags}`' if flags else ''} | " + " | ".join(cells) + " |")
        out[heading] = "\n".join(lines)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--corrupted", type=Path, action="append", help="true tracks: TrajNet files")
    parser.add_argument("--scenes", type=Path, action="append", default=[], help="scenes as of reproduce.py")
    parser.add_argument("--homographies", type=Path, help="folder with the homographies of scenes with detections")
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds of corruptions")
    parser.add_argument("--count", type=int, default=6, help="how many scenes of each seed")
    parser.add_argument("--steps", type=int, default=900, help="how many steps of each of these scenes")
    parser.add_argument("-o", "--output", type=Path, help="a page with marks <!-- HEADING --> around each table")
    given = parser.parse_args()
    retrackers: dict[str, Retracker | None] = {INPUT: None}
    retrackers |= {name: options for rows in TABLES.values() for name, (_, options) in rows.items()}
    columns: dict[str, tuple[dict[str, Scores], bool]] = {}
    for folder in given.corrupted or [None]:
        name = f"{'synthetic crowds' if folder is None else folder}, corrupted, {given.seeds} seeds"
        columns[name] = corrupted(retrackers, folder, given.seeds, given.count, given.steps), True
    for folder in given.scenes:
        columns[folder.name] = drawn_once(retrackers, folder, given.homographies), False
    text = given.output.read_text() if given.output and given.output.exists() else ""
    for heading, table in tables(columns).items():
        print(f"\n{heading}\n\n{table}")
        mark = f"<!-- {heading} -->"
        before, here, rest = text.partition(mark)
        if not here:
            continue
        after = rest.partition(mark)[2]
        text = before.rstrip("\n") + f"\n\n{mark}\n\n{table}\n\n{mark}" + after
    if given.output:
        given.output.write_text(text.lstrip("\n"))


if __name__ == "__main__":
    main()
