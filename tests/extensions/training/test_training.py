"""Training: made-up walks, windows, sources, recipes, and what a training leaves behind."""

from __future__ import annotations

import csv
import json
import re
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from mcaptrack import __version__, log, tables
from mcaptrack.cli import app
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.metrics.displacement import forecast_scores
from mcaptrack.extensions.training import api as training
from mcaptrack.extensions.training.api import TrainResult
from mcaptrack.extensions.training.recipe import RECIPES, Recipe
from mcaptrack.extensions.training.sources import Scene, SourceOptions, read_scenes, split, synthetic, windows_of
from mcaptrack.extensions.training.windows import Corruption, Windows, ar1
from mcaptrack.predictors import PeopleSeen, make
from mcaptrack.predictors.lstm import Lstm
from mcaptrack.predictors.red import Red
from mcaptrack.predictors.weights import Weights, load
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.walks import walks
from mcaptrack.tables.export import export
from tests.commands import call, done

RED, PAPER = RECIPES["red"], RECIPES["paper"]
SMALL = replace(RED, epochs=3, batch=64)


@pytest.fixture(scope="module")
def crowd() -> Windows:
    return synthetic(RED, 1500, seed=1)


class TestWalks:
    def test_the_same_seed_gives_the_same_walks_and_another_others(self, crowd):
        same, other = (synthetic(RED, 50, seed) for seed in (1, 2))
        np.testing.assert_array_equal(same.past, crowd.past[:50])
        np.testing.assert_array_equal(same.future, crowd.future[:50])
        assert not np.isclose(other.past, same.past).any()

    def test_synthetic_walks_have_speeds_and_stops_of_pedestrians(self):
        """Speeds of pedestrians (Weidmann): 1.3 m/s; some people stand; no jumps; people keep a distance."""
        paths, scene = walks(5760, 20, 0.4, 3)
        speed = np.linalg.norm(np.diff(paths, axis=1), axis=-1) / 0.4
        mean = speed.mean(axis=1)
        assert 0.1 < (mean < 0.1).mean() < 0.35
        assert 1.0 < np.median(mean[(mean > 0.5) & (mean < 2)]) < 1.4
        assert speed.max() < 6
        change = np.linalg.norm(np.diff(paths, 2, axis=1), axis=-1) / 0.4
        assert np.quantile(change, 0.99) < 1.5
        assert len(np.unique(scene)) == 48
        first = paths.reshape(48, 24, 5, 20, 2)[:, :, 0, 0]  # everybody of each scene at one time
        apart = np.linalg.norm(first[:, :, None] - first[:, None], axis=-1)[:, *np.triu_indices(24, 1)]
        assert np.quantile(apart, 0.01) > 0.4
        assert (apart < 1.2).any(axis=1).mean() > 0.9  # groups


class TestWindows:
    def test_cutting_by_hand(self):
        """Two people over six steps; one past position is missing, and one future one."""
        xy = np.arange(24.0).reshape(2, 6, 2)
        xy[0, 1] = np.nan
        xy[1, 5] = np.nan
        found = Windows.cut(xy, past=3, steps=2, least=2, scene=7)
        assert found.past[:, -1, 0].tolist() == [4 + 0.0, 6 + 0.0, 14.0, 16.0]  # present positions
        assert found.known.tolist() == [[True, False, True], [False, True, True], [False, True, True], [True] * 3]
        assert found.future[:, :, 0].tolist() == [[6, 8], [8, 10], [16, 18], [18, 20]]
        assert found.scene.tolist() == [7] * 4
        assert len(Windows.cut(xy, past=3, steps=2, least=3)) == 1
        assert Windows.cut(xy, past=3, steps=2, least=2, stride=2).past[:, -1, 0].tolist() == [4, 14]
        assert len(Windows.cut(xy[:, :2], past=3, steps=2, least=1)) == 0
        assert len(Windows.cut(np.empty((0, 9, 2)), past=3, steps=2, least=1)) == 0

    def test_augmentation_keeps_distances_up_to_the_scale(self, crowd):
        out = Corruption()(crowd, np.random.default_rng(1))
        for name in ("past", "future"):
            before, after = getattr(crowd, name), getattr(out, name)
            np.testing.assert_allclose(
                np.linalg.norm(np.diff(after, axis=1), axis=-1), np.linalg.norm(np.diff(before, axis=1), axis=-1)
            )
        assert np.all(out.past[:, -1] == 0)
        same = np.isclose(out.future[:, -1], crowd.future[:, -1] - crowd.past[:, -1], atol=1e-3).all(axis=1)
        assert same.mean() < 0.05
        bends = [
            np.linalg.det(np.stack([one.past[:, -1] - one.past[:, 0], one.future[:, -1] - one.past[:, -1]], 1))
            for one in (crowd, out)
        ]
        assert 0.3 < (np.sign(bends[0]) != np.sign(bends[1])).mean() < 0.7  # mirrored
        larger = Corruption(scale=0.2)(crowd, np.random.default_rng(1)).future[:, -1]
        ratio = np.linalg.norm(larger, axis=1) / np.linalg.norm(out.future[:, -1], axis=1)
        assert np.exp(-0.2) <= ratio.min() < 0.85
        assert 1.17 < ratio.max() <= np.exp(0.2)

    def test_noise_and_gaps_change_the_past_alone(self, crowd):
        quiet = Corruption(turn=False, mirror=False)
        plain = quiet(crowd, np.random.default_rng(1))
        hard = replace(quiet, noise_m=0.4, noisy=0.5, gaps=0.5, least=2)(crowd, np.random.default_rng(1))
        np.testing.assert_array_equal(hard.future, plain.future)
        noise = hard.past - plain.past
        assert (noise == 0).all(axis=(1, 2)).mean() == pytest.approx(0.5, abs=0.05)
        assert noise.std() < 0.4
        assert hard.known[:, -1].all()
        assert 0.2 < hard.known[:, :-1].mean() < 0.8

    def test_simulated_tracker_noise_has_unit_variance_and_autocorrelation(self):
        noise = ar1(np.random.default_rng(1), 20_000, 6)
        np.testing.assert_allclose(noise.std(axis=0), 1, atol=0.02)
        for back, wanted in ((1, 0.5), (2, 0.25)):
            assert (noise[:, back:] * noise[:, :-back]).mean() == pytest.approx(wanted, abs=0.02)

    def test_scenes_are_held_out_whole(self):
        part = Windows.of(np.zeros((100, 20, 2)), 8, np.repeat(np.arange(10), 10))
        training, validation = split(part, 0.2, seed=1)
        assert not set(training.scene) & set(validation.scene)
        assert sorted({*training.scene, *validation.scene}) == list(range(10))
        assert len(validation) == 20
        one = Windows.of(np.zeros((100, 20, 2)), 8)
        assert [len(part) for part in split(one, 0.2, seed=1)] == [80, 20]


PATHS = {1: lambda n: (0.5 * n, 1.0), 2: lambda n: (3.0, 0.25 * n), 7: lambda n: (-0.3 * n, -0.2 * n)}


class TestSources:
    """The same people, told in different files."""

    def check(self, scenes: list[Scene], atol: float = 1e-6):
        (scene,) = scenes
        assert scene.xy_m.shape == (3, 25, 2)
        for row, path in zip(scene.xy_m, PATHS.values(), strict=True):
            np.testing.assert_allclose(row, [path(n) for n in range(25)], atol=atol)

    def lines(self, words):
        return "\n".join(words(who, n, *path(n)) for n in range(25) for who, path in PATHS.items())

    def read(self, path, topic=None, **options):
        return read_scenes([path], SourceOptions(IngestOptions(**options), topic), 0.4)

    def test_trajnet(self, tmp_path):
        (tmp_path / "t.txt").write_text(self.lines(lambda who, n, x, y: f"{12 * n} {who} {x} {y}"))
        self.check(self.read(tmp_path / "t.txt"))
        self.check(self.read(tmp_path / "t.txt", fps=Fraction(30)))
        self.check(self.read(tmp_path))

    def test_eth(self, tmp_path):
        (tmp_path / "obsmat.txt").write_text(self.lines(lambda who, n, x, y: f"{780 + 6 * n} {who} {x} 0 {y} 0 0 0"))
        self.check(self.read(tmp_path / "obsmat.txt"))

    def test_boxes_need_their_rate_and_their_ground(self, tmp_path):
        (tmp_path / "gt.txt").write_text(
            self.lines(lambda who, n, x, y: f"{4 * n + 1},{who},{10 * x + 99},{10 * y + 40},2,20,1,1,1")
        )
        (tmp_path / "h.txt").write_text("0.1 0 -10\n0 0.1 -6\n0 0 1")
        options = {"fps": Fraction(10), "ground_plane": tmp_path / "h.txt"}
        self.check(self.read(tmp_path / "gt.txt", **options))
        with pytest.raises(McaptrackError, match=r"gt\.txt: how many frames a second\? Say it with `fps=`"):
            self.read(tmp_path / "gt.txt")
        with pytest.raises(McaptrackError, match=r"gt\.txt is in pixels; give its homography with `ground_plane=`"):
            self.read(tmp_path / "gt.txt", fps=Fraction(10))

    def test_stanford_drone(self, tmp_path):
        text = self.lines(
            lambda who, n, x, y: (
                f'{who} {100 * x + 999:.0f} {100 * y + 999:.0f} {100 * x + 1001:.0f} {100 * y + 1001:.0f} {12 * n} 0 0 0 "Pedestrian"'
            )
        )
        (tmp_path / "annotations.txt").write_text(text)
        (tmp_path / "h.txt").write_text("0.01 0 -10\n0 0.01 -10\n0 0 1")
        self.check(self.read(tmp_path / "annotations.txt", ground_plane=tmp_path / "h.txt", point="center"), 1e-2)

    def test_logs_and_their_tables(self, tmp_path):
        (tmp_path / "t.txt").write_text(self.lines(lambda who, n, x, y: f"{12 * n} {who} {x} {y}"))
        path = tmp_path / "out" / "t.mcap"
        path.parent.mkdir()
        ingest(tmp_path / "t.txt", path, IngestOptions(fps=Fraction(30), role="truth"))
        self.check(self.read(path))
        with log.read(path) as opened:
            export(opened, tmp_path / "tables")
        self.check(self.read(tmp_path / "tables"))
        with log.read(path) as opened:
            export(opened, path.with_suffix(".tables"))
        self.check(self.read(path.parent))  # what is told twice counts once
        with pytest.raises(McaptrackError, match=r"t\.mcap has none of /camera/tracks"):
            self.read(path, topic="/camera/tracks")

    def test_tables_of_others(self, tmp_path):
        import pyarrow as pa
        import pyarrow.parquet as pq

        rows = [(int(4e8) * n, who, *path(n)) for n in range(25) for who, path in PATHS.items()]
        columns = dict(zip(("t_ns", "track_id", "x_m", "y_m"), zip(*rows, strict=True), strict=True))
        pq.write_table(pa.table({name: list(values) for name, values in columns.items()}), tmp_path / "a.parquet")
        self.check(self.read(tmp_path / "a.parquet"))
        assert tables.holds_tracks(tmp_path / "a.parquet")
        pq.write_table(pa.table({"t_ns": [1], "id": [1]}), tmp_path / "b.parquet")
        with pytest.raises(McaptrackError, match=r"b\.parquet has no column track_id, x_m, y_m"):
            self.read(tmp_path / "b.parquet")
        (tmp_path / "c.parquet").write_bytes(b"PAR1")
        with pytest.raises(McaptrackError, match=r"c\.parquet can't be read as Parquet"):
            self.read(tmp_path / "c.parquet")

    def test_nothing_to_train_on(self, tmp_path):
        with pytest.raises(McaptrackError, match=r"has no \.txt"):
            self.read(tmp_path)
        with pytest.raises(McaptrackError, match=r"no track lasts 5\.6 s without a gap in short"):
            windows_of([Scene("short", np.zeros((2, 9, 2)))], RED)


class TestRecipes:
    def test_the_papers_rate(self):
        assert (PAPER.epochs, PAPER.loss, PAPER.network) == (50, "displacements", "lstm")
        rates = [PAPER.rate_at(epoch * 10 + 3, 10) for epoch in (0, 39, 40, 49)]
        np.testing.assert_allclose(rates, [1e-4, 1e-4, 2e-5, 2e-5])

    def test_the_one_cycle_rate_rises_and_falls(self):
        rates = [RED.rate_at(step, 10) for step in range(RED.epochs * 10)]
        assert max(rates) == pytest.approx(RED.rate_at(RED.epochs, 10)) == pytest.approx(RED.rate)
        assert (np.diff(rates[1:21]) > 0).all()
        assert RED.rate_at(RED.epochs // 2, 10) == pytest.approx(RED.rate / 2)  # halfway through the first tenth
        assert (np.diff(rates[20:]) <= 0).all()

    def test_the_paper_compares_displacements_alone(self):
        with pytest.raises(McaptrackError, match="consistency weight needs the recipe red"):
            PAPER.changed({"consistency_weight": 0.3}, {})

    def test_a_card_lists_the_changed_parameters(self):
        assert RED.changes() == {}
        assert RED.changed({"epochs": 7}, {"gaps": 0.1}).changes() == {"epochs": "7", "gaps": "0.1"}


@pytest.fixture
def fit():
    pytest.importorskip("torch", reason="training needs torch")
    from mcaptrack.extensions.training.loop import train

    def run(recipe: Recipe, windows: Windows, folder, **options):
        folder.mkdir(exist_ok=True)
        training, validation = split(windows, 0.2, 1)
        return train(recipe, training, validation, folder, {"data": "a test"}, "cpu", 1, **options)

    return run


class TestTraining:
    def test_a_short_training_improves_on_its_start(self, fit, crowd, tmp_path):
        trained = fit(replace(SMALL, epochs=8), crowd, tmp_path)
        noisy = {name: scores["ADE_m"] for name, scores in trained.scores["noisy"].items()}
        assert noisy["red"] < min(noisy["kalman"], noisy["cv"])  # a fresh network is the Kalman filter
        # Every step is calibrated on windows as they are and with noise together.
        held = [scores["red"]["coverage_95"] for scores in trained.scores.values()]
        assert np.mean(held) == pytest.approx(0.95, abs=0.005)
        card = load(trained.weights).card
        assert (card["data"], card["network"], json.loads(card["recipe"])["epochs"]) == ("a test", "red", "8")
        rows = list(csv.DictReader((tmp_path / "epochs.csv").read_text().splitlines()))
        assert [int(row["epoch"]) for row in rows] == list(range(1, 9))
        errors = [float(row["validation_ade_m"]) for row in rows]
        assert trained.kept_epoch == 1 + errors.index(min(errors))

    @pytest.mark.parametrize("recipe", [SMALL, replace(PAPER, epochs=3), replace(SMALL, consistency_weight=1.0)])
    def test_a_resumed_training_equals_an_uninterrupted_one(self, fit, crowd, tmp_path, recipe):
        windows = crowd if recipe.network == "red" else crowd.last(4)
        whole = fit(recipe, windows, tmp_path / "whole")
        stop = iter([None, KeyboardInterrupt()])

        def interrupt(*_):
            if error := next(stop, None):
                raise error

        with pytest.raises(KeyboardInterrupt):
            fit(recipe, windows, tmp_path / "cut", progress=interrupt)
        resumed = fit(recipe, windows, tmp_path / "cut", resume=True)
        assert resumed.epochs == whole.epochs == 3
        assert resumed.weights.read_bytes() == whole.weights.read_bytes()
        with pytest.raises(McaptrackError, match="is of a training with another recipe or"):
            fit(replace(recipe, seed=5), windows, tmp_path / "cut", resume=True)

    def test_it_stops_without_improvement(self, fit, crowd, tmp_path):
        said = []
        patient = replace(SMALL, epochs=60, rate=0.05, patience=2)  # steps so wide that it soon gets worse
        trained = fit(patient, crowd, tmp_path, say=said.append)
        assert trained.kept_epoch == trained.epochs - 2 < 58
        assert "no improvement for 2 epochs" in said[0]

    def test_a_rate_that_is_too_high_is_refused(self, fit, crowd, tmp_path):
        with pytest.raises(McaptrackError, match=r"the loss is (nan|inf) in epoch"):
            fit(replace(PAPER, rate=1e30), crowd.last(4), tmp_path)

    def test_more_consistency_makes_forecasts_drift_less(self, fit, crowd, tmp_path):
        from mcaptrack.predictors import make

        drift = []
        for number, weight in enumerate((0.0, 30.0)):
            trained = fit(replace(SMALL, consistency_weight=weight), crowd, tmp_path / str(number))
            predictor = make(f"red:{trained.weights}", 12, 0.4)
            path = np.concatenate([crowd.past, crowd.future[:, :1]], axis=1)
            path = path + 0.2 * ar1(np.random.default_rng(0), *path.shape[:2])
            now, then = (predictor.predict(path[:, k : k + 8], crowd.known).mean for k in (0, 1))
            drift.append(np.linalg.norm(now[:, 1:] - then[:, :-1], axis=-1).mean())
        assert drift[1] < 0.9 * drift[0]


class TestCommand:
    def run(self, *words):
        return CliRunner().invoke(app, ["train", *map(str, words)])

    def test_from_files_to_a_table_and_back_into_predict(self, tmp_path):
        pytest.importorskip("torch", reason="training needs torch")
        paths, scene = walks(1440, 20, 0.4, 5)
        for number in range(6):
            rows = [
                f"{12 * step} {who} {x:.3f} {y:.3f}"
                for who, path in enumerate(paths[scene == number * 2][:60])
                for step, (x, y) in enumerate(path)
            ]
            (tmp_path / f"s{number}.txt").write_text("\n".join(rows))
        words = (tmp_path, "-o", tmp_path / "out", "--epochs", 2, "--device", "cpu", "--set", "threads=1")
        result = self.run(*words)
        assert result.exit_code == 0, result.output
        lines = result.stdout.splitlines()
        assert [line.split("  ")[0].strip() for line in lines[1:7:3]] == ["as they are", "with 0.2 m of noise"]
        assert f"predict LOG --predictor red:{tmp_path / 'out' / 'red.safetensors'}" in result.stdout
        assert load(tmp_path / "out" / "red.safetensors").card["licence"] == "that of the data it was trained on"
        assert "holds a training; --resume goes on with it, --force replaces it" in self.run(*words).stderr
        again = self.run(*words, "--resume", "--json", "-q")
        assert again.exit_code == 0, again.output
        assert json.loads(again.stdout)["epochs"] == 2

    def test_mistakes_are_one_line(self, tmp_path, monkeypatch):
        (tmp_path / "file").write_text("")
        assert "training needs a folder" in self.run("synthetic", "-o", tmp_path / "file").stderr
        assert "there is no training to resume" in self.run("synthetic", "-o", tmp_path, "--resume").stderr
        monkeypatch.setitem(sys.modules, "torch", None)
        result = self.run("synthetic", "-o", tmp_path / "new")
        assert result.exit_code == 1
        assert result.stderr == (
            "mcaptrack: training needs torch, which is not installed; `pip install 'mcaptrack[train]'` installs it\n"
        )
        assert not (tmp_path / "new").exists()


# What `train` passes to the training and prints of it; the training, which needs torch, is replaced by a stand-in


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
        weights = words[3] / f"{words[0].network}.safetensors"
        return TrainResult(
            weights=weights,
            predictor=f"{words[0].network}:{weights}",
            epochs=7,
            kept_epoch=5,
            windows=len(words[1]),
            validation_windows=len(words[2]),
            seconds=125.4,
            scores=SCORES,
        )

    stand_in = SimpleNamespace(train=train, find_device=lambda name: f"on {name}")
    monkeypatch.setitem(sys.modules, "mcaptrack.extensions.training.loop", stand_in)
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
    done("train", "synthetic", "--walks", 1234, "--set", "seed=5", "--validate", "b.txt", "-o", "one")
    done("train", "a.txt", "synthetic", "--walks", 1234, "--set", "seed=5", "--validate", "b.txt", "-o", "two")
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
        ("--epochs 3 --set batch=9 --set rate=0.01", {"epochs": 3, "batch": 9, "rate": 0.01}, {}),
        (
            "--set patience=4 --set seed=6 --set consistency_weight=2",
            {"patience": 4, "seed": 6, "consistency_weight": 2.0},
            {},
        ),
        ("--set noise_m=0.2 --set gaps=0.1 --set scale=0.3", {}, {"noise_m": 0.2, "gaps": 0.1, "scale": 0.3}),
        ("--set noise_m=0 --set gaps=0 --set scale=0", {}, {"noise_m": 0.0, "gaps": 0.0, "scale": 0.0}),
        ("--recipe paper --epochs 1 --set gaps=0.9", {"epochs": 1}, {"gaps": 0.9}),
    ],
)
def test_options_change_the_recipe(folder, given, words, changed, corrupted):
    done("train", "a.txt", "b.txt", *words.split(), "--set", "threads=3", "--device", "cpu")
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
        "weights": "trained/red.safetensors", "epochs": 7, "kept_epoch": 5, "seconds": 125.4, "scores": SCORES,
    }  # fmt: skip
    assert (data["windows"], data["validation_windows"]) == (len(given[1][1]), len(given[1][2]))


# Networks of training and shipped weights, on walks and on recordings that they were not trained on


def test_networks_for_training_give_the_same_forecasts():
    torch = pytest.importorskip("torch", reason="training needs torch")
    from mcaptrack.extensions.training.network import LstmNetwork, RedNetwork

    torch.manual_seed(1)
    path = walks(32, 20, 0.4, seed=3)[0]
    windows = Windows.of(path, 8)
    for network, kind, card in (
        (RedNetwork(12, 0.4), Red, {"network": "red", "steps": "12", "step_s": "0.4"}),
        (LstmNetwork(12), Lstm, {"network": "lstm", "steps": "12", "step_s": "0.4"}),
    ):
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.normal_(0, 0.2)
            part = windows if kind is Red else windows.last(4)
            given = network.prepare(part)
            there = network(given)[0] if kind is Red else network(given["past"]).cumsum(1)
        tensors = {name: np.asarray(value, float) for name, value in network.tensors().items()}
        here = kind.of(Weights(Path("w"), tensors, card, "")).predict(part.past, part.known).mean
        here = here if kind is Red else here - part.past[:, -1:]
        np.testing.assert_allclose(here, there.numpy(), atol=2e-4)


def test_red_has_less_error_than_linear_predictors_and_is_calibrated_and_social_has_less():
    """On walks that it was not trained on, as they are and with the noise of a tracker."""
    paths, scene = walks(3000, 20, 0.4, seed=12345)
    windows = Windows.of(paths, 8)
    moment = 5 * scene + np.arange(len(scene)) % 5  # the walks of a person follow one another
    noise = 0.2 * ar1(np.random.default_rng(0), 3000, 8)
    for seen in (windows.past, windows.past + noise):
        scores = {
            name: forecast_scores(*make(name, 12, 0.4).predict(seen, windows.known), windows.future)
            for name in ("red", "cv", "kalman")
        }
        people = PeopleSeen(seen, windows.known, moment, np.arange(len(seen)))
        among = forecast_scores(*make("social", 12, 0.4).predict(seen, windows.known, people), windows.future)
        assert among["ADE_m"] < 0.97 * scores["red"]["ADE_m"]
        assert among["NLL"] < scores["red"]["NLL"]
        assert scores["red"]["ADE_m"] < 0.95 * min(scores["cv"]["ADE_m"], scores["kalman"]["ADE_m"])
        assert scores["red"]["NLL"] < min(scores["cv"]["NLL"], scores["kalman"]["NLL"]) - 0.3
        assert 0.93 < scores["red"]["coverage_95"] < 0.97


@pytest.mark.parametrize(("past", "noise_m", "most_m"), [(4, 0.0, 0.61), (8, 0.2, 0.90)])
def test_weights_that_never_saw_a_recording_foretell_one(data, past, noise_m, most_m):
    """Scenes of Stanford Drone: errors in metres, what the ellipses hold, and constant velocity beside it."""
    recipe = replace(RECIPES["red"], past=past, least=past)
    windows = windows_of(read_scenes([data / "sdd" / "val"], SourceOptions(), recipe.step_s), recipe)
    seen = windows.past + noise_m * ar1(np.random.default_rng(3), *windows.known.shape)
    red, cv = (
        forecast_scores(*make(name, 12, 0.4).predict(seen, windows.known), windows.future) for name in ("red", "cv")
    )
    assert red["ADE_m"] < most_m
    assert red["ADE_m"] < cv["ADE_m"]
    assert 0.90 < red["coverage_95"] < 0.97
