"""Limits of what is read from files of others, as they were decided: memory and time that a damaged or hostile file may cost.

Whoever changes one changes what files are accepted, and says so here. That limits act is tested beside what they limit.
"""

from __future__ import annotations

from importlib import import_module

import pytest

from mcaptrack.schema import EVENT_KINDS, EventKind

KIB, MIB = 2**10, 2**20
LABELS, BAGS = "mcaptrack.sources.ingest.labels", "mcaptrack.sources.ingest.bags"
LIMITS = {
    f"{BAGS}.plain_yaml": {"MAX_BYTES": 8 * MIB, "_MAX_VALUES": 500_000, "_MAX_DEPTH": 32},
    f"{BAGS}.rosbag2": {"_MAX_MESSAGE_BYTES": 256 * MIB, "_MAX_STRANGE": 10},
    f"{BAGS}.sqlite_tables": {
        "_STEPS": 100_000,
        "_MIN_STEPS": 2_000_000,
        "_STEPS_PER_BYTE": 4,
        "_ROW_BYTES": 6,
        "_MAX_EXPANSION": 1.5,
        "_MAX_VALUE_BYTES": 256 * MIB,
        "_MAX_SQL_BYTES": MIB,
    },
    f"{BAGS}.decompression": {"_PIECE_BYTES": MIB, "_FED_BYTES": KIB, "_WINDOW_BYTES": 128 * MIB},
    f"{LABELS}.delimited": {"MAX_LINE": 64 * KIB, "_MAX_COLUMNS": 1024, "_MAX_SECONDS": 9223372036.854775807},
    f"{LABELS}.json_boxes": {
        "_MAX_BYTES": 512 * MIB,
        "_MAX_ROWS": 10_000_000,
        "_MAX_CLASSES": 65_536,
        "_MAX_NAME": 256,
    },
    f"{LABELS}.number_table": {
        "_MAX_ROWS": 10_000_000,
        "_MAX_LINE": 4096,
        "EXACT": 9_007_199_254_740_992,
        "_MOST_ZOOM": 4.0,
    },
    f"{LABELS}.yolo": {
        "_MAX_FILES": 1_000_000,
        "_MAX_ROWS": 10_000_000,
        "_MAX_CLASSES": 65_536,
        "_MAX_NAME": 256,
        "_MOST": 2.0,
    },
    f"{LABELS}.box_rows": {"_MAX_CLASS": 2_147_483_647, "_MOST_SHARE": 2.0},
    f"{LABELS}.timeline": {"MAX_FRAMES": 10_000_000, "_EMPTY_FRAMES": 100_000, "_EMPTY_A_LABELLED": 100},
    f"{LABELS}.formats": {
        "MAX_PLACE": 1e8,
        "MAX_SCORE": 1e9,
        "MAX_FRAME": 2_147_483_647,
        "_MAX_NAMES": 65_536,
        "KITTI_HEIGHT_PX": 25.0,
    },
    "mcaptrack.sources.ingest.recording_job": {"_MAX_MESSAGE_BYTES": 240 * MIB},
    f"{LABELS}.cvat": {
        "_MAX_BYTES": 512 * MIB,
        "_MAX_ROWS": 10_000_000,
        "_MAX_FRAMES": 10_000_000,
        "_MAX_DEPTH": 32,
        "_MAX_TEXT": 65_536,
        "_MAX_CLASSES": 65_536,
    },
    f"{LABELS}.boxes_3d.rows": {"_LEAST_LENGTH_M": 0.05, "_MOST_LENGTH_M": 60.0},
    "mcaptrack.sources.ingest.calibration.content": {"_MAX_BYTES": MIB, "_MAX_DEPTH": 16, "_MAX_NODES": 20_000},
    f"{BAGS}.rosbag1": {"_MAX_HEADER_BYTES": MIB, "_MAX_DATA_BYTES": 256 * MIB},
    f"{BAGS}.metadata_yaml": {"_MOST_TRIES": 5},
    "mcaptrack.log.chunks": {
        "MAX_CHUNK_MIB": 256,
        "_MAX_PLAIN_BYTES": 64 * MIB,
        "MAX_NS": 9_223_372_036_854_775_807,
        "LOG_MAX_NS": 18_446_744_073_709_551_615,
    },
    "mcaptrack.schema.cdr": {"_LONGEST_TOPIC": 247, "_MAX_DEFINITION": MIB},
    "mcaptrack.tables.messages": {"_EXACT": 2**53, "_MAX_INT": 2**63, "_MAX_UINT": 2**64},
    "mcaptrack.networks.graph": {"_MAX_NAMES": 100_000},
    "mcaptrack.predictors.checked": {"_MOST": 10_000, "_LARGEST": 1e15},
    "mcaptrack.tables.export.contents": {"_MAX_BYTES": 200},
    "mcaptrack.cli.config": {"MAX_BYTES": MIB},
}


@pytest.mark.parametrize("module", LIMITS)
def test_limits_are_those_that_were_decided(module):
    found = import_module(module)
    assert {name: getattr(found, name) for name in LIMITS[module]} == LIMITS[module]


#: What is held in memory, read or written at once: more costs memory, less costs time.
AT_ONCE = {
    "mcaptrack.log.byte_source": {
        "MIN_AHEAD": 4 * KIB, "_MAX_AHEAD": 256 * KIB, "GAP_BYTES": 512 * KIB, "_MIN_SUMMED": 64 * KIB, "_TICK_S": 0.05,
    },
    "mcaptrack.log.checksums": {"_CRC_BLOCK": MIB},
    "mcaptrack.log.chunks": {"_FEW": 16},
    "mcaptrack.log.in_place": {"_PIECE": 4 * MIB, "_BLOCK": MIB},
    "mcaptrack.log.journal": {"_IDENTITY_BYTES": 64 * KIB, "ROW": 512, "_BLOCK": MIB, "_MAX_TORN_ROWS": 2},
    "mcaptrack.log.messages": {
        "OPEN_BYTES": 128 * MIB, "_KEPT_BYTES": 8 * MIB, "_MAX_GAP_BYTES": 16 * KIB, "_READ_AT_ONCE_BYTES": 16 * MIB,
        "_MIN_GAP_BYTES": 64 * KIB,
    },
    "mcaptrack.log.records": {"BLOCK": 8 * MIB, "_LOOKAHEAD": KIB, "_WALK_BLOCK": 64 * KIB},
    "mcaptrack.log.recover": {"_FIRST_STEP": 64 * KIB, "_CHAIN": 3},
    "mcaptrack.log.remote": {
        "_END_BYTES": 128 * KIB, "_MIN_AHEAD": 16 * KIB, "_MAX_AHEAD": 16 * MIB, "_KEPT_BYTES": 64 * MIB,
        "_MARGIN": 4 * KIB,
    },
    "mcaptrack.schema.encodings": {"_BATCH": 256},
    "mcaptrack.schema.frame_columns": {"BLOCK_BYTES": MIB, "_IN_MEMORY": 1, "_CACHED": 8, "_MOST_PARTS": 4096},
    "mcaptrack.schema.framing": {"PART_ROWS": 64 * KIB},
    "mcaptrack.tables.files": {"_ZSTD_LEVEL": 1, "_ROWS_READ": 16 * KIB},
    "mcaptrack.tables.rows": {"GROUP_ROWS": 32 * KIB, "_MOST_GROUPS": 256, "_BUFFER_BYTES": 64 * KIB},
    "mcaptrack.tables.build": {"PIECE_ROWS": 128 * KIB},
    "mcaptrack.tables.text": {"_PIECE": 16 * KIB},
    "mcaptrack.tables.exchange.text": {"_LINES": 4096},
    "mcaptrack.tables.exchange.coco": {"_ENTRIES": 1024},
    f"{BAGS}.decompression": {"_RATIO": 64, "_MIN_MIB": 64, "_DISK_SHARE": 0.9},
    f"{LABELS}.cvat": {"_BLOCK": 64 * KIB},
    "mcaptrack.transforms.detect.onnx.detector": {
        "_LEAST_PIXELS": 700_000, "_MOST_PIXELS": 1_000_000, "_MOST_TILES": 64, "_KEPT": 4,
    },
    "mcaptrack.transforms.detect.onnx.nms": {"_MOST": 1000},
}  # fmt: skip
#: How much is shown in a message, a table, or a line.
SHOWN = {
    "mcaptrack.cli.files": {"_SHOWN": 20},
    "mcaptrack.cli.query": {"_SHOWN": 60, "_WIDEST": 60, "_WIDEST_UNBROKEN": 1000},
    "mcaptrack.cli.running": {"_SLOW_SHARE": 0.05},
    "mcaptrack.cli.show": {"_DEEPEST": 30, "_SHOWN": 3},
    "mcaptrack.cli.common": {"PROGRESS_S": 5.0},
    "mcaptrack.cli.text": {"_UNBROKEN": 100_000},
    "mcaptrack.tables": {"_DIGITS": 6},
    f"{LABELS}.box_rows": {"_SHOWN": 8},
    f"{LABELS}.cvat": {"_SHOWN": 5},
    f"{LABELS}.number_table": {"_SHOWN": 60},
    f"{LABELS}.content": {"_SHOWN": 10, "_MAX_LISTED": 20},
    f"{LABELS}.boxes_3d.nuscenes": {"_SHOWN": 10},
    f"{LABELS}.boxes_3d.rows": {"_SHOWN": 8},
    "mcaptrack.sources.ingest.boxes_3d_job": {"_LISTED": 8},
    "mcaptrack.transforms.detect.onnx.detector": {"_SHOWN": 8},
}
#: Numbers of formats: of MCAP, of bags, of ROS's markers and of our own rows, and exit codes of commands.
FORMATS = {
    "mcaptrack.log.checksums": {"_CRC_POLYNOMIAL": 0xEDB88320},
    "mcaptrack.log.index": {"FOOTER_SIZE": 9 + 20 + 8, "DATA_END_SIZE": 9 + 4},
    "mcaptrack.log.records": {"_CHUNK_NAME_AT": 32, "CHUNK_HEAD_BYTES": 44},
    "mcaptrack.log.writer": {"_MAX_ID": 65_535},
    "mcaptrack.log.journal": {"_NOT_LAST": 2**64 - 1, "_DIGEST_SIZE": 32, "_HEAD_SIZE": 164},
    f"{BAGS}.rosbag1": {"_MESSAGE": 2, "_BAG": 3, "_CHUNK": 5, "_CHUNK_INFO": 6, "_CONNECTION": 7},
    f"{BAGS}.metadata_yaml": {"_QOS_TEXT": 4, "_QOS_LIST": 9, "_HASH": 7},
    "mcaptrack.tables.rosbag2": {"_VERSION": 8, "_LAST_S": 2**31},
    "mcaptrack.tables.rosbag2.messages": {
        "_CUBE": 1, "_CYLINDER": 3, "_LINE_STRIP": 4, "_TEXT": 9, "_ADD": 0, "_DELETE_ALL": 3, "_MARKERS": 2**31,
    },
    "mcaptrack.schema.cdr": {"_ALIGN": 8, "_HEAD": 4, "_COUNT": 4, "_FILL": 8},
    "mcaptrack.schema.classes": {"UNKNOWN": 0, "PERSON": 1, "_LAST": 2**32 - 1},
    "mcaptrack.schema.ground_plane": {"_PLUMB_BOB": 5},
    f"{LABELS}.content": {"NO_ID": -1, "_SPARSE_FRAMES": 3},
    f"{LABELS}.formats": {"_DISTRACTORS": (2, 7, 8, 12), "_KITTI_OCCLUDED": 2},
    "mcaptrack.cli.common": {"DONE": 0, "REFUSED": 1, "LOST": 3, "GATE_MISSED": 4},
    "mcaptrack.cli.text": {"WRONG_USAGE": 2, "_STDOUT": 1, "_STDERR": 2},
    "mcaptrack.networks.graph": {"_INT64": 7},
    "mcaptrack.transforms.detect.onnx.layouts": {"_COCO": 80, "_BOX": 4, "_OBJECT": 5},
    "mcaptrack.transforms.detect.onnx.outputs": {"STRIDES": (8, 16, 32), "PLUS": (8, 16, 32, 64), "ANCHORS": 3},
    "mcaptrack.transforms.detect.onnx.session": {"_STEP": 32, "_GREY": 114.0},
}  # fmt: skip


@pytest.mark.parametrize("table", [AT_ONCE, SHOWN, FORMATS], ids=["at once", "shown", "formats"])
def test_numbers_are_those_that_were_decided(table):
    for module, numbers in table.items():
        found = import_module(module)
        assert {name: getattr(found, name) for name in numbers} == numbers, module


def test_kinds_of_events_have_the_numbers_that_logs_have():
    assert {kind.name: int(kind) for kind in EventKind} == {
        "MISS": 2, "FALSE_TRACK": 3, "SWITCH": 4, "BIRTH": 5, "END": 6, "JOINED": 7, "PARTED": 8,
    }  # fmt: skip
    assert [EVENT_KINDS[kind] for kind in sorted(EVENT_KINDS)] == [
        "miss", "false track", "identity switch", "birth", "end", "joined", "parted",
    ]  # fmt: skip
