"""``doctor``: each thing that is missing is one line, and nothing is left over."""

from __future__ import annotations

import json
import tempfile
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest

import mcaptrack
from mcaptrack import environment
from mcaptrack.api import health
from mcaptrack.schema import Frame
from mcaptrack.sources.video.codecs import CODECS
from tests.commands import call, done
from tests.distributions import package


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch) -> Path:
    """The folder for temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def fault() -> str:
    outcome = call("doctor", "-q")
    assert (outcome.code, outcome.out) == (1, "")
    (line,) = outcome.err.splitlines()
    return line.removeprefix("mcaptrack: ")


def test_a_whole_installation_has_no_faults_and_nothing_is_left_over(place):
    said = json.loads(done("doctor", "--json").out)
    assert said["faults"] == []
    assert said["packages"]["numpy"] == np.__version__
    assert said["packages"]["av"] == metadata.version("av")
    assert said["codecs"] == dict.fromkeys([*CODECS, "h264 encoder"], "")
    assert Path(said["temporary_folder"]) == place
    assert list(place.iterdir()) == []
    assert said["extras"].keys().isdisjoint({"docs", "examples", "test"})
    assert said["extras"]["sql"] == []  # the tests need DuckDB


@pytest.mark.parametrize("name", CODECS)
def test_a_codec_without_decoder_is_named(name, monkeypatch):
    create = av.CodecContext.create

    def without(codec: str, mode: str) -> object:
        if (codec, mode) == (CODECS[name].decoder, "r"):
            raise ValueError("no codec")
        return create(codec, mode)

    monkeypatch.setattr(av, "CodecContext", SimpleNamespace(create=without))
    assert fault() == f"{name}: pictures can't be decoded (no codec); `pip install av` brings it"


def test_a_decoder_that_gives_another_picture_is_named(monkeypatch):
    def black(pictures):
        (picture,) = pictures
        return [Frame(0, 0, np.zeros((64, 64), np.uint8))] if picture.format == "vp9" else real([picture])

    from mcaptrack.sources.video import decode

    real = decode.decode_gray
    monkeypatch.setattr(decode, "decode_gray", black)
    assert "vp9: pictures can't be decoded (the picture looks different (by 128 of 255 on average))" in fault()


@pytest.mark.parametrize(
    ("name", "function", "words"),
    [
        ("pyarrow", "pyarrow.parquet.write_table", "no table can be written as Parquet and read back"),
        ("scipy", "scipy.optimize.linear_sum_assignment", "nothing can be assigned"),
        ("opencv-python-headless", "cv2.resize", "no picture can be worked on"),
    ],
)
def test_a_package_whose_libraries_are_missing_is_named(name, function, words, monkeypatch):
    """It is installed, by what pip says."""

    def broken(*given, **more):
        raise ImportError("libarrow_substrait.so: cannot open shared object file\nmore")

    monkeypatch.setattr(function, broken)
    why = "libarrow_substrait.so: cannot open shared object file"
    assert fault() == f"{name}: {words} ({why}); install {name} again"


def test_a_temporary_folder_that_is_missing_is_named(place, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(place / "none"))
    assert fault().startswith(f"{place / 'none'}: a log can't be written there and read back (No such file")


def test_little_space_is_a_warning(monkeypatch):
    monkeypatch.setattr(health, "free_bytes", lambda _: 20_000_000)
    outcome = done("doctor")
    assert "has only 20 MB free" in outcome.err


@pytest.mark.parametrize(
    ("requirement", "said"),
    [
        ("no-such-package>=1.2", "no-such-package: it is not installed"),
        (f"numpy<99,>={int(np.__version__.split('.')[0]) + 1}", f"numpy: version {np.__version__} is installed"),
    ],
)
def test_packages_that_are_missing_or_old_are_faults(requirement, said, monkeypatch):
    monkeypatch.setattr(metadata, "requires", lambda _: ["scipy>=1", requirement, 'nothing>=1; extra == "test"'])
    assert fault().startswith(said)


def test_what_an_extra_lacks_is_no_fault(monkeypatch):
    monkeypatch.setattr(metadata, "requires", lambda _: ['numpy>=1.0; extra == "some"', 'nothing>=1; extra == "some"'])
    assert mcaptrack.doctor().extras == {"some": ("nothing",)}
    assert "`pip install 'mcaptrack[some]'`" in done("doctor").out


def test_a_plug_in_that_cant_be_imported_is_a_warning(tmp_path, monkeypatch):
    package(tmp_path, "own", "1.5", {"mcaptrack.trackers": {"mine": "nothing_there:Mine"}})
    monkeypatch.syspath_prepend(str(tmp_path))
    assert done("doctor").out.endswith("none; 1 of what it can do without, see above\n")
    said = json.loads(done("doctor", "--json").out)
    ((name, why),) = said["plugins"].items()
    assert name == "tracker mine (own 1.5)"
    assert why == "tracker mine (own 1.5) can't be imported: ModuleNotFoundError: No module named 'nothing_there'"
    assert [warning["message"] for warning in said["warnings"]] == [why]


def test_parts_say_a_line_of_their_own(tmp_path, monkeypatch):
    points = {name: f"own_lines:{name}" for name in ("works", "fails", "counts")}
    package(tmp_path, "own", "1.5", {"mcaptrack.doctor_lines": points})
    (tmp_path / "own_lines.py").write_text(
        "def works(): return {'lidar driver': 7}\ndef fails(): 1 / 0\ndef counts(): return 3\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "\nlidar driver  " in done("doctor").out
    said = json.loads(done("doctor", "--json").out)
    assert said["parts"]["lidar driver"] == "7"
    assert [warning["message"] for warning in said["warnings"]] == [
        "doctor line counts (own 1.5) gave an int; it has to give a dict",
        "doctor line fails (own 1.5) failed: ZeroDivisionError: division by zero (own_lines.py, line 2)",
    ]


def test_packages_that_bring_the_same_module_are_named(tmp_path, monkeypatch):
    """As opencv-python does beside opencv-python-headless, whatever of them was installed last."""
    info = tmp_path / "opencv_python-9.8.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: opencv-python\nVersion: 9.8\n")

    monkeypatch.syspath_prepend(str(tmp_path))

    def doctor(record: str) -> tuple[int, str, str]:
        """What `doctor` says with a package that has this file."""
        (info / "RECORD").write_text(f"{record},,\n")
        code, out, err = call("doctor", "-q")
        return code, out, err

    assert doctor("cv2/data/__init__.py") == (0, "", "")
    own = metadata.version("opencv-python-headless")
    text = (
        f"mcaptrack: cv2 is of opencv-python 9.8 and opencv-python-headless {own}, of which the one installed last has "
        "overwritten the other; `pip uninstall -y opencv-python opencv-python-headless`, then "
        "`pip install opencv-python-headless`\n"
    )
    assert doctor("cv2/__init__.py") == (1, "", text)


def test_limits_are_those_of_the_control_group_and_of_those_above_it(tmp_path):
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    (tmp_path / "a" / "cpu.max").write_text("150000 100000\n")
    (inner / "cpu.max").write_text("max 100000\n")
    (tmp_path / "a" / "memory.max").write_text("2000000000\n")
    (inner / "memory.max").write_text("max\n")
    assert environment.cpu_quotas(tmp_path, "0::/a/b\n") == [1.5]
    assert environment.memory_limits(tmp_path, "0::/a/b\n") == [2_000_000_000]
    assert environment.memory_limits(tmp_path, "") == []


def test_limits_of_the_first_version_of_control_groups(tmp_path):
    for name, text in (
        ("cpu/cpu.cfs_quota_us", "50000"),
        ("cpu/cpu.cfs_period_us", "100000"),
        ("memory/memory.limit_in_bytes", "1000000000"),
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert environment.cpu_quotas(tmp_path, "") == [0.5]
    assert environment.memory_limits(tmp_path, "") == [1_000_000_000]
    (tmp_path / "memory/memory.limit_in_bytes").write_text("9223372036854771712")  # no limit
    assert environment.memory_limits(tmp_path, "") == []
