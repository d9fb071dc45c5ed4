"""Score re-tracking on true tracks that are corrupted in many ways: kinds of corruption x seeds, mean and spread.

    .venv/bin/python tools/score_retrack.py
    .venv/bin/python tools/score_retrack.py FOLDER --seeds 3 --save before.json
    .venv/bin/python tools/score_retrack.py FOLDER --seeds 3 --baseline before.json
    .venv/bin/python tools/score_retrack.py --kind mixed --retracker my_module:retracker --set max_age_s=3

The truth are synthetic crowds, or the scenes of FOLDER: TrajNet text files (frame id x y, in metres, annotated at
2.5 Hz). `corruptions.py` makes tracks of it. Prints IDF1 / MOTA / switches at 1 m by motmetrics' rules for each kind,
as the mean over seeds and the standard deviation, beside those of the input. `--save` keeps the scores with a digest of
what was drawn, so that `--baseline` compares another version on the same draws, or says that they are not the same.
Scenes that are reported on must not be looked at here.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import CORRUPTIONS, Rows, corrupt, crowds, whole_people
from reproduce import on_clock

from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import combine, score, summary
from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES, Sample

GATE_M = 1.0
NAMES = ("IDF1", "MOTA", "IDSW")
#: The scenes of SDD that choose settings; of other folders all are taken.
SCENES = ("coupa_3", "gates_1", "hyang_5", "nexus_2", "bookstore_2", "deathCircle_3")
Retracker = Callable[[list[Frame]], Any]
#: IDF1 and MOTA in percent and switches, one for each seed.
Scores = dict[str, list[float]]


def truths(folder: Path | None, count: int, steps: int, seed: int) -> dict[str, Rows]:
    """The true tracks of each scene: of a folder they are the same for every seed."""
    if folder is None:
        return {f"crowd {number}": rows for number, rows in enumerate(crowds(count, steps, seed))}
    files = sorted(folder.glob("*.txt"))
    chosen = [path for path in files if path.stem in SCENES] or files
    out = {}
    for path in chosen[:count]:
        rows = whole_people(path)
        out[path.stem] = rows[rows[:, 0] < rows[:, 0].min() + steps]
    return out


def drawn(
    folder: Path | None, kind: str, count: int, steps: int, seed: int
) -> Iterator[tuple[list[Frame], list[Frame], bytes]]:
    """Truth and samples of each scene, and the bytes of the corrupted rows."""
    for number, rows in enumerate(truths(folder, count, steps, seed).values()):
        made = corrupt(rows, CORRUPTIONS[kind], np.random.default_rng([seed, number]))
        clock = np.arange(int(rows[:, 0].min()), int(rows[:, 0].max()) + 1)
        true = on_clock(rows, clock)
        samples = [frame for (frame,) in Sample(start_ns=true[0].t_ns)(on_clock(made, clock))]
        yield true, samples, np.ascontiguousarray(np.round(made, 6)).tobytes()


def measure(
    retrackers: Mapping[str, Retracker | None],
    folder: Path | None,
    kind: str,
    seeds: int,
    count: int,
    steps: int,
    output: int = 0,
) -> tuple[dict[str, Scores], str]:
    """The scores of each re-tracker (None: of its input) for one kind of corruption, and a digest of the draws."""
    out: dict[str, Scores] = {name: {one: [] for one in NAMES} for name in retrackers}
    digest = hashlib.sha256()
    for seed in range(seeds):
        parts: dict[str, list] = {name: [] for name in retrackers}
        for true, samples, content in drawn(folder, kind, count, steps, seed):
            digest.update(content)
            for name, retrack in retrackers.items():
                found = samples if retrack is None else [result[output] for result in retrack(samples)]
                parts[name].append(score(make_matchup(true, found, "metres", GATE_M), "motmetrics"))
        for name, members in parts.items():
            row = summary(combine(members))
            for one in NAMES:
                out[name][one].append(float(row[one]) * (1 if one == "IDSW" else 100))
    return out, digest.hexdigest()[:16]


def spread(values: list[float]) -> str:
    """The mean, and the standard deviation over seeds if there are several."""
    mean = f"{np.mean(values):.1f}"
    return f"{mean} ({np.std(values, ddof=1):.1f})" if len(values) > 1 else mean


def cell(scores: Scores) -> str:
    """IDF1 / MOTA / switches, each with its spread."""
    return " / ".join(spread(scores[name]) for name in NAMES)


def mean_of(kinds: Mapping[str, Scores]) -> Scores:
    """The mean over kinds for each seed."""
    return {name: np.mean([scores[name] for scores in kinds.values()], axis=0).tolist() for name in NAMES}


def difference(after: Scores, before: Scores) -> str:
    """The differences of the means, as IDF1 / MOTA / switches."""
    return " / ".join(f"{np.mean(after[name]) - np.mean(before[name]):+.1f}" for name in NAMES)


def retracker_of(name: str, given: list[str]) -> Retracker:
    """A profile or ``module:name``, with options as ``name=value``."""
    if ":" in name:
        module, _, attribute = name.partition(":")
        sys.path.insert(0, str(Path.cwd()))
        found = getattr(importlib.import_module(module), attribute)
    else:
        found = PROFILES[name]
    changes: dict[str, Any] = {}
    for text in given:
        key, _, value = text.partition("=")
        if key not in {field.name for field in fields(found)}:
            raise SystemExit(f"{name} has no option {key}")
        try:
            changes[key] = json.loads(value.lower() if value in ("True", "False", "None") else value)
        except ValueError:
            changes[key] = value
    return replace(found, **changes) if changes else found


def compared(kind: str, scores: Scores, digest: str, baseline: dict[str, Any]) -> str:
    """The difference from a baseline, if it was drawn alike."""
    had = baseline["kinds"].get(kind)
    if had is None:
        return "not in the baseline"
    return difference(scores, had["scores"]) if had["draws"] == digest else "drawn differently"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="TrajNet files; by default synthetic crowds")
    parser.add_argument("--kind", action="append", choices=tuple(CORRUPTIONS), help="only these kinds")
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds")
    parser.add_argument("--scenes", type=int, default=6, help="how many scenes")
    parser.add_argument("--steps", type=int, default=900, help="how many steps of each scene")
    parser.add_argument("--retracker", default="default", help="a profile, or module:name")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="an option of the re-tracker")
    parser.add_argument("--online", action="store_true", help="score online tracks")
    parser.add_argument("--baseline", type=Path, help="compare with these scores")
    parser.add_argument("--save", type=Path, help="write the scores into this file")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    given = parser.parse_args()
    retrackers = {"input": None, "scores": retracker_of(given.retracker, given.set)}
    baseline = json.loads(given.baseline.read_text()) if given.baseline else None
    out: dict[str, Any] = {"retracker": given.retracker, "set": given.set, "online": given.online, "kinds": {}}
    show = (lambda *_: None) if given.json else (lambda *cells: print("".join(cells), flush=True))
    heads = ("input", "re-tracked", "against the baseline" if baseline else "")
    show(f"{'IDF1 / MOTA / switches':22}", *(f"{head:>40}" for head in heads[:2]), f"{heads[2]:>26}")
    began = time.process_time()
    for kind in given.kind or CORRUPTIONS:
        found, digest = measure(
            retrackers, given.folder, kind, given.seeds, given.scenes, given.steps, int(given.online)
        )
        out["kinds"][kind] = {"draws": digest} | found
        words = compared(kind, found["scores"], digest, baseline) if baseline else ""
        show(f"{kind:22}", *(f"{cell(one):>40}" for one in found.values()), f"{words:>26}")
        if given.save:
            given.save.write_text(json.dumps(out, indent=1) + "\n")
    out["mean"] = {name: mean_of({kind: one[name] for kind, one in out["kinds"].items()}) for name in retrackers}
    words = ""
    if baseline:
        same = [k for k, one in out["kinds"].items() if baseline["kinds"].get(k, {}).get("draws") == one["draws"]]
        now, had = ({k: side["kinds"][k]["scores"] for k in same} for side in (out, baseline))
        if same:
            out["against_baseline"] = {
                k: {n: float(np.mean(now[k][n]) - np.mean(had[k][n])) for n in NAMES} for k in same
            }
            words = difference(mean_of(now), mean_of(had))
    show(f"{'mean of kinds':22}", *(f"{cell(one):>40}" for one in out["mean"].values()), f"{words:>26}")
    show(f"{time.process_time() - began:.0f} s of processor time")
    if given.save:
        given.save.write_text(json.dumps(out, indent=1) + "\n")
    if given.json:
        print(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
