"""The catalogue of detectors: fetched from a server of the test, checked, kept, and used by name."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from pathlib import Path

import pytest

import mcaptrack
from mcaptrack import notices
from mcaptrack.extensions.networks import api as fetching
from mcaptrack.extensions.networks import catalogue
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import STAGES
from tests.commands import call, done
from tests.extensions.networks.models import DATA, NAME, serve, stocked
from tests.extensions.networks.onnx_graphs import detector
from tests.extensions.networks.test_onnx_detectors import log, metadata_of, recorded

__all__ = ["log", "recorded"]  # fixtures


@pytest.fixture(scope="module")
def address():
    server, address = serve()
    yield address
    server.shutdown()
    server.server_close()


@pytest.fixture
def model(address, tmp_path, monkeypatch):
    return stocked(monkeypatch, tmp_path, f"{address}/network.onnx")


def refused(*words: object) -> str:
    outcome = call("models", "get", NAME, *words)
    assert (outcome.code, outcome.out) == (1, "")
    return outcome.err


def test_the_catalogue_says_where_each_model_comes_from_and_each_has_a_detector():
    for name, model in catalogue.CATALOGUE.items():
        assert re.fullmatch("[0-9a-f]{64}", model.sha256)
        assert model.licence in ("Apache-2.0", "MIT", "BSD-3-Clause")
        assert model.size_bytes > 1_000_000
        for url in model.urls:  # a commit or a release, never a branch
            assert re.match(r"https://\S+/([0-9a-f]{7,40}|releases/download/[\w.]+)/\S+\.onnx$", url), url
        cls = STAGES["detect"].find(name).cls
        assert (cls.model, cls().weights_sha256()) == (name, model.sha256)
    known = {name for name, cls in STAGES["detect"].built_in().items() if getattr(cls, "model", "")}
    assert known == set(catalogue.CATALOGUE)


class TestFetching:
    def test_a_model_is_fetched_once_and_kept(self, model, monkeypatch):
        assert not model.path.exists()
        path = mcaptrack.get_model(NAME)
        assert path == model.path
        assert path.read_bytes() == DATA
        monkeypatch.setattr("requests.get", lambda *_, **__: pytest.fail("fetched again"))
        assert mcaptrack.get_model(NAME) == path

    def test_the_next_address_is_taken_where_one_fails(self, address, tmp_path, monkeypatch):
        stocked(monkeypatch, tmp_path, f"{address}/none.onnx", f"{address}/other.onnx", f"{address}/moved.onnx")
        assert mcaptrack.get_model(NAME).read_bytes() == DATA

    def test_a_file_or_another_address_is_taken_instead(self, model, address, tmp_path):
        done("models", "get", NAME, "--from", tmp_path / "known.onnx")
        assert model.path.read_bytes() == DATA
        model.path.unlink()
        done("models", "get", NAME, "--from", f"{address}/moved.onnx")
        assert model.path.read_bytes() == DATA

    @pytest.mark.parametrize(
        ("file", "words"),
        [
            ("none.onnx", "HTTP status 404"),
            ("other.onnx", "gives another file than that of yolox-nano (SHA-256)"),
            ("short.onnx", f"short.onnx ends after 100 of {len(DATA):,} bytes"),
            ("page.onnx", "page.onnx gives a web page, not a file"),
            ("many.onnx", "many.onnx ends after 4,096 of"),
            ("broken.onnx", "broken.onnx: the connection broke"),
            ("long.onnx", f"gives more than the {len(DATA):,} bytes of yolox-nano"),
        ],
    )
    def test_what_is_not_the_file_is_refused_and_nothing_is_kept(self, model, address, file, words):
        err = refused("--from", f"{address}/{file}")
        assert err.count("\n") == 1
        assert words in err
        assert "hand it over with `mcaptrack models get yolox-nano --from FILE`" in err
        assert list(model.path.parent.iterdir()) == []

    def test_a_server_that_is_too_slow_is_given_up(self, model, address, monkeypatch):
        monkeypatch.setattr(fetching, "_PATIENCE_S", 0.1)
        monkeypatch.setattr(fetching, "_LEAST_BYTES_PER_S", 10**9)
        err = refused("--from", f"{address}/slow.onnx")
        assert re.search(r"slow\.onnx gives [\d,]+ bytes in \d+ s, which is too slow\. Get its file", err)
        assert list(model.path.parent.iterdir()) == []

    def test_files_without_a_length_and_compressed_ones_are_taken(self, model, address):
        for name in ("endless.onnx", "packed.onnx"):
            assert mcaptrack.get_model(NAME, source=f"{address}/{name}").read_bytes() == DATA
            model.path.unlink()

    def test_without_a_network_the_file_can_be_handed_over(self, tmp_path, monkeypatch):
        stocked(monkeypatch, tmp_path, "http://127.0.0.1:1/network.onnx")
        err = refused()
        assert err.startswith(
            "mcaptrack: yolox-nano can't be fetched: http://127.0.0.1:1/network.onnx: Connection refused. "
        )
        assert "Get its file from https://example.org on another machine" in err

    def test_another_file_of_the_user_is_refused(self, model, tmp_path):
        (tmp_path / "own.onnx").write_bytes(b"own")
        assert "own.onnx is not the file of yolox-nano: it has 3 bytes" in refused("--from", tmp_path / "own.onnx")
        (tmp_path / "own.onnx").write_bytes(bytes(len(DATA)))
        assert re.search(
            "own.onnx is not the file .* it has SHA-256 [0-9a-f]{12}..., not ", refused("--from", tmp_path / "own.onnx")
        )
        assert "does not exist" in refused("--from", tmp_path / "none")

    def test_a_file_is_read_once_and_no_further_than_it_may_be_long(self, model, tmp_path, monkeypatch):
        with (tmp_path / "own.onnx").open("wb") as file:
            file.truncate(10**12)
        assert "it has 1,000,000,000,000 bytes, not" in refused("--from", tmp_path / "own.onnx")
        opened, own = [], Path.open
        monkeypatch.setattr(
            Path, "open", lambda path, *mode, **more: (opened.append(path), own(path, *mode, **more))[1]
        )
        mcaptrack.get_model(NAME, source=tmp_path / "known.onnx")
        assert opened.count(tmp_path / "known.onnx") == 1

    def test_folders_that_can_not_be_written_and_a_missing_package_are_one_line(self, model, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "pooch", None)
        assert "pip install 'mcaptrack[onnx]'" in refused()
        monkeypatch.setenv("MCAPTRACK_MODELS", str(tmp_path / "known.onnx"))
        assert "known.onnx can't be written: File exists" in refused()

    def test_names_that_are_not_there_are_refused_with_the_nearest(self, model):
        assert "no model yolox-nan; did you mean yolox-nano?" in call("models", "get", "yolox-nan").err
        assert "takes nothing, or get and a name" in call("models", "fetch", NAME).err
        assert "--from goes with get" in call("models", "--from", "x").err


class TestListing:
    def test_the_list_says_what_there_is_and_whether_it_is_here(self, model):
        out = done("models").out
        assert "yolox-nano  0.3 MB, Apache-2.0, trained on blue blocks" in out.replace(f"{len(DATA) / 1e6:.1f}", "0.3")
        assert "not fetched; `mcaptrack models get yolox-nano` fetches it" in out
        (one,) = json.loads(done("models", "--json").out)["models"]
        assert (one["name"], one["sha256"], one["path"]) == (NAME, model.sha256, None)
        assert json.loads(done("models", "get", NAME, "--json").out)["path"] == str(model.path)
        (one,) = json.loads(done("models", "--json").out)["models"]
        assert one["path"] == str(model.path)
        assert model.urls[0] in done("models", "-v").out
        quiet = done("models", "get", NAME, "-q")
        assert (quiet.out, quiet.err) == ("", "")

    def test_the_folder_is_that_of_the_variable_or_one_for_caches(self, monkeypatch, tmp_path):
        monkeypatch.delenv("MCAPTRACK_MODELS", raising=False)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert catalogue.folder() == tmp_path / "mcaptrack" / "models"
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(Path, "home", lambda: tmp_path)
        assert catalogue.folder().parent.parent.parent == tmp_path

    def test_doctor_says_where_weights_are_kept_and_whether_they_can_be(self, monkeypatch, tmp_path):
        monkeypatch.setenv("MCAPTRACK_MODELS", str(tmp_path / "a" / "b"))
        assert mcaptrack.doctor().parts["fetched weights"] == str(tmp_path / "a" / "b")
        (tmp_path / "a").write_text("a file")
        assert mcaptrack.doctor().parts["fetched weights"] == f"{tmp_path / 'a' / 'b'}, which can't be written"
        assert "CPUExecutionProvider" in mcaptrack.doctor().parts["ONNX Runtime"]


class TestDetecting:
    def test_a_detector_by_name_needs_its_weights_and_then_finds(self, model, log):
        words = ("detect", log, "--detector", NAME, "--set", "input_size=160x128")
        assert "not here yet; `mcaptrack models get yolox-nano` fetches them" in call(*words).err
        mcaptrack.get_model(NAME)
        done(*words)
        made = Provenance.from_metadata(metadata_of(log, "/camera/detections"))
        assert (made.parameters["detector"], made.parameters["file"]) == (NAME, "")
        assert made.weights_sha256 == model.sha256
        with mcaptrack.open(log) as opened:
            assert opened.array("detections")["x_px"] == pytest.approx([0, 32, 64] * 2, abs=0.5)

    def test_weights_are_read_and_hashed_once(self, model, log, monkeypatch):
        mcaptrack.get_model(NAME)
        taken, read = hashlib.sha256, []

        def counted(data=b"", **words):
            read.append(len(data))
            return taken(data, **words)

        monkeypatch.setattr(hashlib, "sha256", counted)
        monkeypatch.setattr(hashlib, "file_digest", lambda *_: pytest.fail("hashed again"))
        done("run", log, "--detector", NAME, "--no-tables", "--quiet")
        assert read.count(len(DATA)) == 1

    def test_weights_that_were_changed_are_refused(self, model, log, tmp_path):
        mcaptrack.get_model(NAME).write_bytes(detector("yolox", metadata={"changed": "yes"}))
        assert "is not the file of yolox-nano" in call("detect", log, "--detector", NAME).err
        assert "`mcaptrack models get yolox-nano` fetches it again" in call("detect", log, "--detector", NAME).err
        with notices.collected() as said:
            assert mcaptrack.get_model(NAME).read_bytes() == DATA
        assert [notice.message for notice in said] == [f"{model.path} is damaged, or another file; it is fetched again"]
        (tmp_path / "other.onnx").write_bytes(b"other")
        assert "is not the file of" in call("detect", log, "--detector", f"{NAME}:{tmp_path}/other.onnx").err
        done("detect", log, "--detector", f"{NAME}:{tmp_path}/known.onnx", "--set", "input_size=160x128")

    def test_what_it_made_is_up_to_date_without_the_weights(self, model, log):
        mcaptrack.get_model(NAME)
        err = call("run", log, "--detector", NAME, "--no-tables").err
        assert "track by bytetrack (new_score 0.7, min_hits_frames 1), which suits the detector yolox-nano" in err
        model.path.unlink()
        assert "nothing to do" in call("run", log, "--no-tables").err
