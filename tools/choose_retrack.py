"""How the settings of re-tracking are chosen: scores on true tracks that are corrupted in many ways.

Prints IDF1 / MOTA / switches at 1 m for every candidate and every kind of corruption (`corruptions.py`). The truth are
synthetic crowds (`crowds` there), or those of a folder of TrajNet text files (frame id x y, in metres, annotated at
2.5 Hz). Settings that ship are chosen on synthetic crowds; recordings only measure.

    .venv/bin/python tools/choose_retrack.py [FOLDER] [--scenes 6] [--steps 900] [--seeds 1] [--online]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from corruptions import CORRUPTIONS
from score_retrack import Retracker, Scores, cell, mean_of, measure

from mcaptrack.transforms import PROFILES
from mcaptrack.transforms.retrack import Retracking

DEFAULT = PROFILES["default"]
CANDIDATES: dict[str, Retracking] = {
    **PROFILES,
    **{f"same source {bonus:g}": replace(DEFAULT, same_id_bonus=bonus) for bonus in (0.0, 6.0, 18.0)},
    **{f"age {age:g} s": replace(DEFAULT, max_age_s=age) for age in (1.2, 3.2)},
    **{f"noise {noise:g} m": replace(DEFAULT, noise_m=noise) for noise in (0.1, 0.2, 0.3)},
    **{f"drift {drift:g}": replace(DEFAULT, drift_m_per_s=drift) for drift in (0.1, 0.18)},
    **{f"links within {most:g} s": replace(DEFAULT, link_s=most) for most in (0.0, 8.0, 14.0, 30.0)},
    "swaps not resolved": replace(DEFAULT, resolve_swaps=False),
    **{f"certainty {least:g}": replace(DEFAULT, track_confidence=least) for least in (0.0, 0.3, 0.7)},
    "not smoothed": replace(DEFAULT, smooth=False),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="TrajNet files; by default synthetic crowds")
    parser.add_argument("--scenes", type=int, default=6, help="how many scenes")
    parser.add_argument("--steps", type=int, default=900, help="how many steps of each scene")
    parser.add_argument("--seeds", type=int, default=1, help="how many seeds")
    parser.add_argument("--online", action="store_true", help="score online tracks")
    given = parser.parse_args()
    retrackers: dict[str, Retracker | None] = {"input": None, **CANDIDATES}
    kinds: dict[str, dict[str, Scores]] = {name: {} for name in retrackers}
    for kind in CORRUPTIONS:
        shape = given.seeds, given.scenes, given.steps, int(given.online)
        for name, scores in measure(retrackers, given.folder, kind, *shape)[0].items():
            kinds[name][kind] = scores
        print(f"{kind} is done", file=sys.stderr, flush=True)
    print(f"{'IDF1 / MOTA / switches':24}" + "".join(f"{kind:>22}" for kind in (*CORRUPTIONS, "mean")))
    for name, found in kinds.items():
        print(f"{name:24}" + "".join(f"{cell(one):>22}" for one in (*found.values(), mean_of(found))))


if __name__ == "__main__":
    main()
