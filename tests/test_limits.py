"""Limits of what is read from files of others, as they were decided: memory and time that a damaged or hostile file may cost.

Whoever changes one changes what files are accepted, and says so here. That limits act is tested beside what they limit.
"""

from __future__ import annotations

from importlib import import_module

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
    "mcaptrack.log.chunks": {
        "MAX_CHUNK_MIB": 256,
        "_MAX_PLAIN_BYTES": 64 * MIB,
        "MAX_NS": 9_223_372_036_854_775_807,
        "LOG_MAX_NS": 18_446_744_073_709_551_615,
    },
    "mcaptrack.schema.encodings": {"_LONGEST_TOPIC": 247, "_MAX_DEFINITION": MIB},
    "mcaptrack.tables.messages": {"_EXACT": 2**53, "_MAX_INT": 2**63, "_MAX_UINT": 2**64},
    "mcaptrack.networks.graph": {"_MAX_NAMES": 100_000},
    "mcaptrack.predictors.checked": {"_MOST": 10_000, "_LARGEST": 1e15},
    "mcaptrack.tables.export.contents": {"_MAX_BYTES": 200},
    "mcaptrack.cli.config": {"MAX_BYTES": MIB},
}


def test_limits_are_those_that_were_decided():
    for module, limits in LIMITS.items():
        found = import_module(module)
        assert {name: getattr(found, name) for name in limits} == limits, module
