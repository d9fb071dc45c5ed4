"""What `train` passes to the training and prints of it; the training, which needs torch, is replaced by a stand-in."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mcaptrack import __version__
from mcaptrack.api import training
from mcaptrack.training.recipe import RECIPES
from mcaptrack.training.sources import SourceOptions, read_scenes, split, windows_of
from tests.commands import call, done

#: Scores of two predictors, all numbers different.
SCORES = {
    kind: {
        predictor: {
            name: round(0.1 * at + 0.01 * number + 0.001 * row, 6)
            for number, name in enumerate(
                ("ADE_m", "FDE_m", "ADE_squared_m2", "NLL", "coverage_50", "coverage_90", "coverage_95"), 1
            )
        }
        for row, predictor in enumerate(("red", "cv"))
    }
    for at, kind in enumerate(("clean", "noisy"))
}


def written(path: Path, people: int, start: float) -> Path:
    """Write a file of labels in metres, in which people walk straight."""
    rows = [f"{12 * n} {who} {start + 0.4 * n} {2.0 * who}" for n in range(26) for who in range(people)]
    path.write_text("\n".join(rows))
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A working folder with label files."""
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "a.txt", 3, 0.0)
    written(tmp_path / "b.txt", 2, 50.0)
    return tmp_path


@pytest.fixture
def given(monkeypatch) -> list[tuple]:
    """The arguments of each call of the training, which is replaced by a stand-in."""
    calls: list[tuple] = []

    def train(*words):
        calls.append(words)
        words[-1]("one line")
        return SimpleNamespace(
            weights=words[3] / f"{words[0].network}.safetensors",
            epochs=7,
            kept_epoch=5,
            windows=len(words[1]),
            validation_windows=len(words[2]),
            seconds=125.4,
            scores=SCORES,
        )

    stand_in = SimpleNamespace(train=train, find_device=lambda name: f"on {name}")
    monkeypatch.setitem(sys.modules, "mcaptrack.training.loop", stand_in)
    return calls


def same(one, other) -> bool:
    """Whether two sets of windows are the same."""
    return all(np.array_equal(getattr(one, f), getattr(other, f), equal_nan=True) for f in ("past", "future", "scene"))


def windows(recipe, *paths: Path):
    return windows_of(read_scenes(paths, SourceOptions(), recipe.step_s), recipe)


def test_by_default_a_tenth_is_kept_for_validation(folder, given):
    outcome = done("train", "a.txt", "b.txt")
    ((recipe, training, validation, output, card, device, threads, resume, _, _),) = given
    assert recipe == RECIPES["red"]
    every = windows(recipe, Path("a.txt"), Path("b.txt"))
    wanted = split(every, 0.1, recipe.seed)
    assert same(training, wanted[0])
    assert same(validation, wanted[1])
    assert (output, device, threads, resume) == (Path("trained"), "on auto", 1, False)
    assert output.is_dir()
    assert card == {
        "data": "2 scenes: a, b",
        "licence": "that of the data it was trained on",
        "made_by": f"mcaptrack {__version__}",
    }
    assert f"training on {len(training)} windows, validating on {len(validation)}" in outcome.err.splitlines()
    assert "one line" in outcome.err.splitlines()


def test_files_to_validate_on_take_nothing_from_the_training(folder, given):
    done("train", "a.txt", "--validate", "b.txt")
    ((recipe, training, validation, *_),) = given
    assert same(training, windows(recipe, Path("a.txt")))
    assert same(validation, windows(recipe, Path("b.txt")))


def test_synthetic_walks_and_files_are_other_scenes(folder, given, monkeypatch):
    def synthetic(recipe, walks, seed):
        assert (recipe.seed, walks, seed) == (5, 1234, 5)
        return windows(recipe, Path("b.txt"))

    monkeypatch.setattr(training, "synthetic", synthetic)
    done("train", "synthetic", "--walks", 1234, "--seed", 5, "--validate", "b.txt", "-o", "one")
    done("train", "a.txt", "synthetic", "--walks", 1234, "--seed", 5, "--validate", "b.txt", "-o", "two")
    (recipe, made, *_, card, _, _, _, _, _), (_, both, *_, mixed, _, _, _, _, _) = given
    assert same(made, windows(recipe, Path("b.txt")))
    walks = f"1234 synthetic walks of mcaptrack {__version__}, seed 5"
    assert (card["data"], card["licence"]) == (walks, "Apache-2.0")
    assert (mixed["data"], mixed["licence"]) == (f"{walks}; 1 scenes: a", "that of the data it was trained on")
    files = windows(recipe, Path("a.txt"))
    assert len(both) == len(made) + len(files)
    assert (made.scene == both.scene[: len(made)]).all()
    assert (both.scene[len(made) :] == files.scene + made.scene.max() + 1).all()


@pytest.mark.parametrize(
    ("words", "changed", "corrupted"),
    [
        ("--recipe paper", {}, {}),
        ("--epochs 3 --batch 9 --rate 0.01", {"epochs": 3, "batch": 9, "rate": 0.01}, {}),
        ("--patience 4 --seed 6", {"patience": 4, "seed": 6}, {}),
        ("--consistency-weight 2", {"consistency_weight": 2.0}, {}),
        ("--noise-m 0.2 --gaps 0.1 --scale 0.3", {}, {"noise_m": 0.2, "gaps": 0.1, "scale": 0.3}),
        ("--noise-m 0 --gaps 0 --scale 0", {}, {"noise_m": 0.0, "gaps": 0.0, "scale": 0.0}),
        ("--recipe paper --epochs 1 --gaps 0.9", {"epochs": 1}, {"gaps": 0.9}),
    ],
)
def test_options_change_the_recipe(folder, given, words, changed, corrupted):
    done("train", "a.txt", "b.txt", *words.split(), "--threads", 3, "--device", "cpu")
    recipe = RECIPES["paper" if "paper" in words else "red"]
    assert given[0][0] == recipe.changed({"seed": 1} | changed, corrupted)
    assert given[0][5:7] == ("on cpu", 3)


@pytest.mark.parametrize("there", ["red.safetensors", "state.safetensors"])
def test_a_training_is_replaced_or_resumed_only_on_request(folder, given, there):
    (folder / "trained").mkdir()
    (folder / "trained" / there).write_text("")
    refused = call("train", "a.txt", "b.txt")
    assert (refused.code, given) == (1, [])
    assert refused.err.count("\n") == 1
    assert "trained holds a training" in refused.err
    done("train", "a.txt", "b.txt", "--force")
    assert given[0][7] is False
    resumed = call("train", "a.txt", "b.txt", "--resume")
    assert resumed.code == (there != "state.safetensors")
    assert [words[7] for words in given[1:]] == ([True] if there == "state.safetensors" else [])


def test_weights_of_another_network_do_not_prevent_a_training(folder, given):
    (folder / "trained").mkdir()
    (folder / "trained" / "lstm.safetensors").write_text("")
    done("train", "a.txt", "b.txt")
    assert call("train", "a.txt", "b.txt", "--recipe", "paper").code == 1
    assert len(given) == 1


def test_text_and_json_have_the_scores(folder, given):
    lines = done("train", "a.txt", "b.txt").out.splitlines()
    names = list(SCORES["clean"]["red"])
    head = ["validation windows", "predictor", "ADE m", "FDE m", "ADE m²", "NLL", "in 50 %", "in 90 %", "in 95 %"]
    assert re.split(r"  +", lines[0].strip()) == head
    wanted = []
    for kind, words in (("clean", "as they are"), ("noisy", "with 0.2 m of noise")):
        for number, (predictor, values) in enumerate(SCORES[kind].items()):
            wanted.append([*([words] if number == 0 else []), predictor, *(f"{values[name]:.3f}" for name in names)])
    assert [re.split(r"  +", line.strip()) for line in lines[1:5]] == wanted
    assert len({len(line.rstrip()) for line in lines[1:5]}) == 1  # numbers end below each other
    assert lines[5:] == [
        "",
        "trained/red.safetensors: epoch 5 of 7, 2 min 5 s",
        "Use it:  mcaptrack predict LOG --predictor red:trained/red.safetensors",
    ]
    data = json.loads(done("train", "a.txt", "b.txt", "--force", "--json").out)
    assert {key: data[key] for key in ("weights", "epochs", "kept_epoch", "seconds", "scores")} == {
        "weights": "trained/red.safetensors",
        "epochs": 7,
        "kept_epoch": 5,
        "seconds": 125.4,
        "scores": SCORES,
    }
    assert (data["windows"], data["validation_windows"]) == (len(given[1][1]), len(given[1][2]))
