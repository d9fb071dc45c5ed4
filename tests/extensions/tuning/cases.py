"""Cases of ``tune`` for the tests of the core."""

from pathlib import Path
from typing import Any

import mcaptrack

READING = {"tune": lambda log, out: [log, "--trials", "1", "-o", out / "tuned.json"]}
DEEDS = {"tune": ["read", "write"]}
_TALL = "tune tall.txt --truth truth.txt --set fps=10"
EFFECTS = {
    "tune": (
        "tune a.mcap --trials 2 --search min-iou",
        {
            "truth": ("tune truth.txt --set fps=10 --trials 1", "--truth truth.txt"),
            "stage": "--stage sample --search max-gap-s",
            "tracker": "--tracker bytetrack",
            "metric": "--metric mota",
            "trials": (f"{_TALL} --search min-iou", "--trials 1"),
            "search": "--search max-age-s",
            "set": "--set seed=3",
            "study": "--study b.jsonl",
            "similarity": "--similarity metres",
            "topic": "--topic /none",
            "camera": "--camera other",
            "output": "-o b.toml",
            "force": ("tune a.mcap --trials 1 --study query.sql", "--force"),
        },
    )
}
USES = {"tune": ["tune a.mcap --trials 1", f"{_TALL} --trials 1"]}
TOPICS = {
    "tune": (
        "detections",
        lambda p, t, f: mcaptrack.tune(p, stage="track", topic=t, trials=1, study=f / "a.jsonl").scores,
    )
}
REFUSED = {
    "a tracker of a stage without one": (
        lambda: mcaptrack.tune("log.mcap", stage="sample", tracker="sort"),
        "the stage sample has no tracker; leave `tracker=` out",
    ),
    "a range that ends before it begins": (
        lambda: mcaptrack.tune("log.mcap", search={"min_iou": (0.5, 0.1)}),
        "`search=` needs a range from low to high for min_iou, not 0.5 to 0.1",
    ),
    "a parameter that can't be searched": (
        lambda: mcaptrack.tune("log.mcap", search=["min_ious"]),
        "`search=` has min_ious, which can't be searched; did you mean min_iou? there are max_age_s",
    ),
}
#: What the function gets of words on the command line.
GIVEN = {
    ("tune", "x.mcap", *words): values
    for words, values in {
        ("--search=min-iou",): {"search": {"min_iou": None}},
        ("--search=--min-iou",): {"search": {"min_iou": None}},
        ("--search=min-iou=0.1:0.5",): {"search": {"min_iou": (0.1, 0.5)}},
        ("--search= max-age-s =1:2",): {"search": {"max_age_s": (1.0, 2.0)}},
        (): {"study": Path("mcaptrack.sort.trials.jsonl"), "tracker": None},
        ("--tracker", "own:It"): {"study": Path("mcaptrack.own.It.trials.jsonl"), "tracker": "own:It"},
        ("--stage", "retrack", "-o", "to/b.toml"): {"study": Path("to/b.retrack.trials.jsonl"), "tracker": None},
        ("--study", "mine"): {"study": Path("mine"), "tracker": None},
    }.items()
}
WRITTEN = {"a.trials.jsonl": lambda path, output: mcaptrack.tune(path, study=output, trials=3)}
_SCORES = {"IDF1": 0.75, "MOTA": 0.5, "HOTA": 0.25, "IDSW": 1, "FP": 2, "FN": 3}


def _tuned(best: int = 3, similarity: str = "iou", **changed: Any) -> mcaptrack.TuneResult:
    given = {"stage": "track", "metric": "IDF1", "settings": {"max_age_s": 2.5}, "scores": _SCORES, "trials": 7}
    return mcaptrack.TuneResult(
        **given | changed,
        default_scores=_SCORES | {"IDF1": 0.5},
        best=best,
        similarity=similarity,
        notes=(),
        warnings=(),
    )


def _printed(to: Any) -> None:
    to.run("tune x.mcap", tune=_tuned())
    to.run("tune x.mcap -o b.toml --metric mota --stage sample", tune=_tuned(metric="MOTA", stage="sample"))
    to.lines += Path("mcaptrack.toml").read_text().splitlines() + Path("b.toml").read_text().splitlines()
    to.run("tune x.mcap -o c.toml --json", tune=_tuned(best=0))
    for words, similarity in (
        ("--set gate_m=1 --set min_iou=0.4", "iou"),
        ("--set gate_m=1 --set min_iou=0.4", "metres"),
        ("--tracker sort --stage sample", "iou"),
        ("--set fps=5 --camera c", "iou"),
        ("--truth t.txt --set fps=5 --camera c --topic /t", "iou"),
    ):
        to.run(f"tune x.mcap -o c.toml -q {words}", shows_answer=False, tune=_tuned(best=0, similarity=similarity))
    for search in ("min-iou=0.1", "min-iou=1:2:3", "min-iou=", "min-iou=a:b"):
        to.run(f"tune x.mcap --search {search}")


PRINTED = {"tuning": _printed}
#: Modules of the core that aren't public, and why it needs them.
DEEP = {
    "tuning": (
        "it makes transforms with other settings, and writes these",
        "api.running cli.chosen cli.settings tables.compared transforms.guarded",
    )
}
