"""Networks of strangers, in every use: what they reach, take or break is one line, and signals end them."""

from __future__ import annotations

import errno
import gc
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from itertools import product
from pathlib import Path
from threading import Thread
from time import sleep

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.networks import network as networks
from mcaptrack.extensions.networks.detector import OnnxDetector
from mcaptrack.extensions.networks.predictor import Onnx
from mcaptrack.predictors import make
from mcaptrack.registry import KINDS, own
from mcaptrack.schema import Frame
from tests.awaiting import is_running
from tests.bounded import limited
from tests.extensions.networks.onnx_graphs import (
    FLOAT,
    INPUTS,
    INT64,
    Graph,
    Sparse,
    blue_blocks,
    detector,
    field,
    graph,
    model,
    node,
    tensor,
    value,
)
from tests.tiers import one_in, thorough

SIZE = (512, 384)
PICTURE = blue_blocks(SIZE, (64, 32, 32, 32), (224, 160, 32, 32))
SECRET = np.arange(24, dtype="<f4")
#: Megabytes, and the longest that a test waits for what it knows to happen, in seconds.
MEMORY_MB, LATE_S = 150, 120.0


def detect(path: Path) -> None:
    list(OnnxDetector(file=str(path), max_memory_mb=MEMORY_MB)([Frame(0, 0, PICTURE)]))


def predict(path: Path) -> None:
    make(f"onnx:{path}", 3, 0.4).predict(np.zeros((1, 4, 2)), np.ones((1, 4), bool))


#: What takes `onnx:FILE`: how it is used, the shape of its input, and its command.
USES: dict[str, tuple[Callable[[Path], None], list[int | str], list[str]]] = {
    "detector": (detect, [1, 3, 384, 512], ["detect", "--to", "/camera/strange", "--detector"]),
    "predictor": (predict, ["B", 4, 2], ["predict", "--to", "/camera/strange", "--predictor"]),
}


def alternating(cases: Iterable[object], step: int) -> list[object]:
    """Some cases in one of the uses by default, and all in all of them in the thorough tier: each takes seconds."""
    uses = list(USES)
    return one_in(step, [(case, use) for n, case in enumerate(cases) for use in (uses[n % 2], uses[1 - n % 2])])


def test_every_use_of_networks_is_tested_here():
    assert set(USES) == {kind for kind in KINDS if "onnx" in own(kind)}


def far(name: str = "") -> bytes:
    """A tensor whose numbers are in a file of the working folder."""
    where = b"".join(
        field(13, field(1, key) + field(2, text)) for key, text in (("location", "secret"), ("length", "96"))
    )
    return field(1, 24) + field(2, FLOAT) + field(8, name) + where + field(14, 1)


def branch(*nodes: bytes, constants: dict[str, bytes] = {}) -> Graph:  # noqa: B006
    return graph(nodes, [], [value("y", None)], constants)


IDENTITY = node("Identity", ["w"], ["y"])
FAR = branch(IDENTITY, constants={"w": far("w")})
NEAR = branch(IDENTITY, constants={"w": tensor([1.0], "w")})
YES = {"yes": field(2, 9) + field(8, "yes") + field(9, b"\x01"), "rounds": tensor(2**60, "rounds", INT64)}
CHOICE = node("If", ["yes"], ["y"], then_branch=NEAR, else_branch=FAR)
SPARSE = field(1, far()) + field(2, tensor([0] * 24, "", INT64)) + field(3, 24)


def body(*nodes: bytes, constants: dict[str, bytes] = {}) -> Graph:  # noqa: B006
    given = [value("round", [], INT64), value("going", [], 9)]
    return graph(
        [node("Identity", ["going"], ["on"]), *nodes], given, [value("on", [], 9), value("y", None)], constants
    )


def made(*nodes: bytes, constants: dict[str, bytes] = {}) -> Callable[[list[int | str]], bytes]:  # noqa: B006
    return lambda shape: model(nodes, [value("x", shape)], [value("y", None)], YES | constants)


def beside(place: int, *parts: bytes) -> Callable[[list[int | str]], bytes]:
    """Parts of the graph (a place from 0 on), or of the model (the negative of one)."""

    def encoded(shape: list[int | str]) -> bytes:
        plain = model([IDENTITY], [value("x", shape)], [value("y", None)], {"w": tensor([1.0], "w")})
        return plain + b"".join(field(7, field(place, one)) if place > 0 else field(-place, one) for one in parts)

    return encoded


#: Networks that reach out of their file, for an input of a shape.
REACHING = {
    "initializer": made(IDENTITY, constants={"w": far("w")}),
    "constant": made(node("Constant", [], ["y"], value=far())),
    "branch": made(CHOICE),
    "loop in a branch": made(
        node(
            "If",
            ["yes"],
            ["y"],
            then_branch=branch(node("Loop", ["rounds", "yes"], ["y"], body=body(IDENTITY, constants={"w": far("w")}))),
            else_branch=NEAR,
        )
    ),
    "function": beside(-25, field(1, "f") + field(10, "own") + field(5, "y") + field(7, CHOICE)),
    "function's attribute": beside(-25, field(1, "f") + field(10, "own") + field(11, field(1, "a") + field(5, far()))),
    "sparse initializer": beside(15, SPARSE),
    "sparse constant": made(node("Constant", [], ["y"], sparse_value=Sparse(SPARSE))),
    "training": beside(-20, field(1, FAR)),
    "compiled": made(node("EPContext", ["x"], ["y"]) + field(7, "com.microsoft")),
}
MANY = {"count": tensor([400_000_000], "count", INT64)}
LESS = node("ReduceMean", ["many"], ["y"], keepdims=0)
#: y is a mean of x, times 0 and plus the count, so that it is known only when the network runs.
LATER = [
    node("ReduceMean", ["x"], ["mean"], keepdims=0),
    node("Cast", ["mean"], ["whole"], to=INT64),
    node("Mul", ["whole", "none"], ["nothing"]),
    node("Add", ["count", "nothing"], ["shape"]),
]
NONE = {"none": tensor([0], "none", INT64)}
ENDLESS = made(node("Loop", ["rounds", "yes"], ["y"], body=body(node("Identity", ["x"], ["y"]))), constants={})
LOOP = made(
    node(
        "Loop",
        ["rounds", "yes", "x"],
        ["y"],
        body=graph(
            [node("Identity", ["going"], ["on"]), node("Identity", ["state"], ["y"])],
            [value("round", [], INT64), value("going", [], 9), value("state", None)],
            [value("on", [], 9), value("y", None)],
        ),
    )
)
#: Networks that take too much: and the limit that ends them.
TAKING = {
    "memory when it is opened": (
        made(node("ConstantOfShape", ["count"], ["many"]), LESS, constants=MANY),
        f"needs more than {MEMORY_MB} MB of memory; ",
    ),
    "memory when it runs": (
        made(*LATER, node("ConstantOfShape", ["shape"], ["many"]), LESS, constants=MANY | NONE),
        f"needs more than {MEMORY_MB} MB of memory; ",
    ),
    "time": (LOOP, "took longer than 1 s and was ended; MCAPTRACK_MAX_NETWORK_S allows more"),
    "memory in each round": (ENDLESS, f"needs more than {MEMORY_MB} MB of memory; "),
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Iterator[Path]:
    """The working folder, with a secret in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret").write_bytes(SECRET.tobytes())
    monkeypatch.setenv("MCAPTRACK_MAX_NETWORK_MB", str(MEMORY_MB))
    yield tmp_path
    Onnx._of.cache_clear()


def refused(use: str, data: bytes) -> str:
    path = Path("strange.onnx")
    path.write_bytes(data)
    with pytest.raises(McaptrackError) as error:
        USES[use][0](path)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith("strange.onnx ")
    return str(error.value)


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("how", REACHING)
def test_what_reaches_out_of_its_file_is_refused(use, how, monkeypatch):
    monkeypatch.setattr(networks, "_runs_apart", lambda is_trusted: False)  # the check is the same, and quicker here
    words = "has a node EPContext" if how == "compiled" else "keeps weights in other files (external data)"
    assert words in refused(use, REACHING[how](USES[use][1]))


def test_a_network_can_open_no_file_even_if_nothing_was_checked(monkeypatch):
    """The secret's numbers come out where nothing forbids it, which shows that the network asks for them."""
    import onnxruntime

    data = made(IDENTITY, constants={"w": far("w")})([1])
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    assert session.run(None, {"x": np.zeros(1, "f")})[0].tolist() == SECRET.tolist()
    code = (
        "import sys; from mcaptrack.extensions.networks import child, graph; graph.reach = lambda model: ''; "
        "child.session.graph.reach = graph.reach; child.serve(*given)"
    )
    from mcaptrack.extensions.networks import child

    start, _, _ = child._CODE.partition("from mcaptrack")
    monkeypatch.setattr(child, "_CODE", start + code)
    monkeypatch.setattr(child.subprocess, "Popen", _in_folder(subprocess.Popen, os.getcwd()))
    Path("strange.onnx").write_bytes(data)
    limits = networks.NetworkLimits.of_environment()
    with pytest.raises(McaptrackError, match=f"can't be run by ONNX Runtime: .*{errno.EMFILE}$"):
        networks.OnnxNetwork(networks.read_file(Path("strange.onnx"), limits), limits)


def _in_folder(popen, folder):
    return lambda *words, **options: popen(*words, **(options | {"cwd": folder}))


@pytest.mark.parametrize(("how", "use"), alternating(TAKING, 4))
def test_what_takes_too_much_is_ended(use, how, monkeypatch):
    build, words = TAKING[how]
    monkeypatch.setenv("MCAPTRACK_MAX_NETWORK_S", "1" if how == "time" else "1000")
    assert words in refused(use, build(USES[use][1]))
    assert not strange_processes(os.getpid())


SAME = node("Identity", ["x"], ["y"])
LONG = "y" * 100_000
#: Networks that declare too much, by use: and words of the refusal.
DECLARING = {
    "a name": (
        ("detector", "predictor"),
        lambda shape: model([node("Identity", ["x"], [LONG])], [value("x", shape)], [value(LONG, None)]),
        "has a name of 100,000 characters",
    ),
    "no size": (
        ("detector",),
        lambda shape: model([SAME], [value("x", [1, 3, -128, -160])], [value("y", None)]),
        "takes pictures of any size",
    ),
    "a past": (
        ("predictor",),
        lambda shape: model([SAME], [value("x", ["B", 2**40, 2])], [value("y", None)]),
        "takes 1,099,511,627,776 past positions",
    ),
    "a future": (
        ("predictor",),
        made(node("Tile", ["x", "by"], ["y"]), constants={"by": tensor([1, 9999, 1], "by", INT64)}),
        "returns 39,996 steps",
    ),
}


@pytest.mark.parametrize(("how", "use"), [(how, use) for how, (uses, *_) in DECLARING.items() for use in uses])
def test_what_declares_too_much_is_refused_in_a_short_line(how, use):
    _, build, words = DECLARING[how]
    message = refused(use, build(USES[use][1]))
    assert words in message
    assert len(message) < 300


@pytest.mark.parametrize("free", [0, 3, 6])
def test_without_room_for_open_files_no_process_is_started(free):
    with limited(resource.RLIMIT_NOFILE, 200), ExitStack() as held:
        taken = []
        with suppress(OSError):
            while True:
                taken.append(os.open("/dev/null", os.O_RDONLY))
        for handle in taken[free:]:
            held.callback(os.close, handle)
        for handle in taken[:free]:
            os.close(handle)
        refuses_to_start()
        again = [os.open("/dev/null", os.O_RDONLY) for _ in range(free)]  # nothing stayed open
        for handle in again:
            os.close(handle)


def test_where_files_have_to_be_small_no_process_is_started():
    with limited(resource.RLIMIT_FSIZE, 1_000_000):
        refuses_to_start()


def refuses_to_start() -> None:
    with pytest.raises(McaptrackError, match="can't be run: no process can be started for it"):
        networks.OnnxNetwork(networks.NetworkFile(Path("net.onnx"), b"", ""), networks.NetworkLimits.of_environment())
    gc.collect()


@pytest.mark.parametrize("use", one_in(2, USES))
@thorough
def test_a_network_that_breaks_its_process_is_named(use):
    def kill() -> None:
        os.kill(at_work(os.getpid()), signal.SIGSEGV)

    Thread(target=kill, daemon=True).start()
    assert refused(use, LOOP(USES[use][1])) == "strange.onnx can't be run: the process that ran it was ended by SIGSEGV"


@pytest.mark.parametrize(("number", "use"), one_in(6, product([signal.SIGINT, signal.SIGKILL, signal.SIGTERM], USES)))
def test_signals_end_a_command_and_its_network(use, number, template, folder):
    log = shutil.copyfile(template, folder / "log.mcap")
    Path("strange.onnx").write_bytes(LOOP(USES[use][1]))
    words = [sys.executable, "-m", "mcaptrack", USES[use][2][0], str(log), *USES[use][2][1:], "onnx:strange.onnx", "-q"]
    code = "import signal, os, sys; signal.signal(2, signal.default_int_handler); os.execv(sys.argv[1], sys.argv[1:])"
    started = subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.PIPE, text=True)
    network = at_work(started.pid)
    started.send_signal(number)
    _, err = started.communicate(timeout=LATE_S)
    assert "Traceback" not in err
    assert started.returncode == (-number if number == signal.SIGKILL else 128 + number)
    while is_running(network):
        sleep(0.01)
    assert not any(folder.glob("*.part"))


@pytest.mark.parametrize("layout", INPUTS)
def test_the_outputs_of_detectors_are_those_of_this_process_to_the_bit(layout):
    Path("net.onnx").write_bytes(detector(layout, SIZE))
    limits = networks.NetworkLimits.with_memory(1000, "")
    file = networks.read_file(Path("net.onnx"), limits)
    here = networks.OnnxNetwork(file, limits, is_trusted=True)
    apart = networks.OnnxNetwork(file, limits, lanes=3)
    assert here.facts == apart.facts
    pixels = np.random.default_rng(1).uniform(0, 255, (1, 3, *SIZE[::-1])).astype(np.float32)
    given = {name: pixels if len(shape) == 4 else np.array([SIZE]) for name, shape, _ in here.facts["inputs"]}
    for mine, other in zip(here.run(given), apart.run(given), strict=True):
        assert (mine.dtype, mine.shape, mine.tobytes()) == (other.dtype, other.shape, other.tobytes())
    apart.close()


def test_the_outputs_of_predictors_are_those_of_this_process_to_the_bit(monkeypatch):
    nodes = [node("Slice", ["x", "from", "to", "axis"], ["last"]), node("Mul", ["last", "w"], ["y"])]
    numbers = {"from": 1, "to": 4, "axis": 1}
    constants = {name: tensor([number], name, INT64) for name, number in numbers.items()} | {"w": tensor([0.1], "w")}
    Path("net.onnx").write_bytes(made(*nodes, constants=constants)(["B", 4, 2]))
    past = np.random.default_rng(1).normal(size=(9, 4, 2))
    apart = make("onnx:net.onnx", 3, 0.4).predict(past, np.ones((9, 4), bool))
    Onnx._of.cache_clear()
    monkeypatch.setattr(networks, "_runs_apart", lambda is_trusted: False)
    here = make("onnx:net.onnx", 3, 0.4).predict(past, np.ones((9, 4), bool))
    assert [one.tobytes() for one in here] == [one.tobytes() for one in apart]


def strange_processes(pid: int) -> list[int]:
    children = [Path(f"{thread}/children").read_text().split() for thread in Path(f"/proc/{pid}/task").iterdir()]
    return [int(one) for some in children for one in some if "networks.child" in _command(int(one))]


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def at_work(pid: int) -> int:
    """The process of the network of a process, once it has used more time than any start does."""
    while True:
        for one in strange_processes(pid):
            used = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
            if (int(used[11]) + int(used[12])) / os.sysconf("SC_CLK_TCK") > 0.7:
                return one
        sleep(0.02)
