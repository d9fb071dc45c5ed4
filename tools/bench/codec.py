"""The row codec against the protobuf runtime on one frame of 40 tracked people.

Both write the same bytes from the same array, and both make the same array of the same bytes. Prints microseconds and
ratios, the best of several rounds in turn.
"""

from __future__ import annotations

import timeit
from collections.abc import Callable
from operator import attrgetter

import numpy as np

from mcaptrack.schema import TRACKS

ROWS, ROUNDS, CALLS = 40, 7, 2000


def main() -> None:
    rng = np.random.default_rng(1)
    rows = TRACKS.rows(
        track_id=np.arange(ROWS),
        **{name: rng.uniform(0, 1000, ROWS) for name in ("x_px", "y_px", "w_px", "h_px", "x_m", "y_m")},
        score=rng.random(ROWS),
        observed=rng.random(ROWS) > 0.2,
        source_id=np.arange(ROWS),
    )
    codec, names = TRACKS.codec, rows.dtype.names
    payload = codec.encode(rows)

    pick = attrgetter(*names)

    def runtime_encode() -> bytes:
        message = codec.message_class()
        add = message.rows.add
        for who, x, y, w, h, x_m, y_m, score, observed, source in rows.tolist():
            add(
                track_id=who,
                x_px=x,
                y_px=y,
                w_px=w,
                h_px=h,
                x_m=x_m,
                y_m=y_m,
                score=score,
                observed=observed,
                source_id=source,
            )
        return message.SerializeToString()

    def runtime_decode() -> np.ndarray:
        message = codec.message_class()
        message.ParseFromString(payload)
        return np.array([pick(row) for row in message.rows], rows.dtype)

    theirs = runtime_decode()
    assert all((theirs[name] == rows[name]).all() for name in names)
    assert (codec.decode(runtime_encode()) == rows).all()
    for what, ours, peer in (
        ("encode", lambda: codec.encode(rows), runtime_encode),
        ("decode", lambda: codec.decode(payload), runtime_decode),
    ):
        times = [(best(ours, CALLS), best(peer, CALLS // 20)) for _ in range(ROUNDS)]
        a, b = min(t for t, _ in times), min(t for _, t in times)
        print(f"{what}: {a:6.2f} us, protobuf runtime {b:7.2f} us, {b / a:5.1f} times as fast")


def best(call: Callable[[], object], calls: int) -> float:
    """Microseconds a call."""
    return timeit.timeit(call, number=calls) / calls * 1e6


if __name__ == "__main__":
    main()
