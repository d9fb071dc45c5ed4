"""Read the 3D boxes of one scene of nuScenes from the folder of its tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.gathered import as_float, chosen_part
from mcaptrack.files import read_json
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import ClassNames, headings, numbered

TABLES: Final = ("scene", "sample", "sample_annotation", "instance", "category")
#: The classes of the detection and tracking tasks, and the categories that they consist of.
_CLASSES: Final = {
    "barrier": ("movable_object.barrier",),
    "bicycle": ("vehicle.bicycle",),
    "bus": ("vehicle.bus.bendy", "vehicle.bus.rigid"),
    "car": ("vehicle.car",),
    "construction_vehicle": ("vehicle.construction",),
    "motorcycle": ("vehicle.motorcycle",),
    "pedestrian": tuple(
        f"human.pedestrian.{who}" for who in ("adult", "child", "construction_worker", "police_officer")
    ),
    "traffic_cone": ("movable_object.trafficcone",),
    "trailer": ("vehicle.trailer",),
    "truck": ("vehicle.truck",),
}
_CLASS_OF: Final = {category: name for name, categories in _CLASSES.items() for category in categories}
_NS_PER_US: Final = 1000
#: Whole numbers can't be larger: as microseconds they are times.
_MAX_WHOLE: Final = 2**53
_MAX_BYTES: Final = 4 * 2**30
#: The frame of reference, by the name that converters to MCAP give it.
FRAME: Final = "map"


def tables_folder(path: Path) -> Path | None:
    """The folder with the tables: ``path``, or its only ``v1.0-...``; None if it isn't of nuScenes.

    One without annotations counts if there is no other.
    """
    if not path.is_dir():
        return None
    folders = [path, *sorted(path.glob("v1.0-*"))]
    complete = [place for place in folders if (place / "sample_annotation.json").is_file()]
    complete = (
        complete or [place for place in folders if all((place / f"{name}.json").is_file() for name in TABLES[:2])][:1]
    )
    if len(complete) > 1:
        names = ", ".join(place.name for place in complete)
        raise McaptrackError(f"{path} has several sets of tables, {names}; give the folder of one")
    return complete[0] if complete else None


class NuScenes(Format):
    """The folder of the tables of a set; of these, a scene."""

    title = "nuScenes"
    row = "a folder with `sample_annotation.json` and the tables beside it"
    takes = ("scene",)
    in_space = True
    reads_folders = True

    def recognises(self, file: LabelFile) -> bool:
        """Whether a folder has the tables of nuScenes."""
        return tables_folder(file.path) is not None

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The boxes of a scene, at all of its samples."""
        return _read(file.path, asked.scene)


def _read(path: Path, scene: str | None) -> BoxTable:
    folder = tables_folder(path)
    if folder is None:
        raise McaptrackError(f"{path} holds no tables of nuScenes: sample_annotation.json and others")
    scenes, rows = dict(_pairs(folder, "scene", "name", "token")), list(_table(folder, "sample"))
    token = chosen_part(folder, scenes, scene, "scene")
    samples = {
        _text(folder, "sample", row, "token"): _number(folder, "sample", row, "timestamp") * _NS_PER_US
        for row in rows
        if row.get("scene_token") == token
    }
    if not samples:
        raise McaptrackError(f"{folder}: the scene has no samples")
    categories = dict(_pairs(folder, "category", "token", "name"))
    category_of = {own: categories.get(kind) for own, kind in _pairs(folder, "instance", "token", "category_token")}
    names, ids, kinds, times, boxes, quaternions, tokens = ClassNames(), [], [], [], [], [], []
    unseen = 0
    for row in _table(folder, "sample_annotation"):
        if _text(folder, "sample_annotation", row, "sample_token") not in samples:
            continue
        tokens.append(_text(folder, "sample_annotation", row, "token"))
        instance = _text(folder, "sample_annotation", row, "instance_token")
        category = category_of.get(instance)
        if category is None:
            raise McaptrackError(f"{folder}: annotation {tokens[-1]} is of an instance without a category")
        width, length, height = _numbers(folder, row, "size", 3)
        boxes.append([*_numbers(folder, row, "translation", 3), length, width, height, np.nan])
        quaternions.append(_numbers(folder, row, "rotation", 4))
        ids.append(instance)
        kinds.append(names.number(_CLASS_OF.get(category, category)))
        times.append(samples[row["sample_token"]])
        unseen += row.get("num_lidar_pts") == 0 and row.get("num_radar_pts") == 0
    if not boxes:
        raise McaptrackError(f"{folder}: the scene has no boxes")
    values = np.array(boxes)

    def at(row: int) -> str:
        return f"{folder}: annotation {tokens[row]}"

    values[:, 6] = headings(np.array(quaternions), folder, at)[0]
    remarks = [f"{folder}: {len(samples)} samples; tracks are numbered from 1 on, a number for each instance"]
    if unseen:
        remarks.append(f"{folder}: {unseen} of {len(boxes)} boxes have no points of lidar or radar; they stay")
    facts = LabelFacts(path, is_timed=True, frame_id=FRAME)
    facts.name(names.names)
    facts.usual, facts.states_labelled = frozenset(_CLASSES), True
    facts.labelled = np.unique(np.array(list(samples.values()), np.int64))
    return BoxTable(
        facts=facts, at=at, frame=np.array(times, np.int64), id=numbered([f"#{track}" for track in ids]),
        boxes_m=values, score=np.full(len(boxes), np.nan), class_id=np.array(kinds, np.int64), remarks=remarks,
    )  # fmt: skip


def _table(folder: Path, name: str) -> Iterator[dict[str, Any]]:
    path = folder / f"{name}.json"
    if not path.is_file():
        why = ": it is a set without labels" if path.stem == TABLES[2] else ""
        raise McaptrackError(f"{folder} has no {path.name}{why}; nuScenes boxes need {', '.join(TABLES)}")
    content = read_json(path, "nuScenes", _MAX_BYTES)
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise McaptrackError(f"{path} is not a table of nuScenes, a list of objects")
    yield from content


def _pairs(folder: Path, table: str, first: str, second: str) -> Iterator[tuple[str, str]]:
    """Two texts of each row of a table."""
    for row in _table(folder, table):
        yield _text(folder, table, row, first), _text(folder, table, row, second)


def _text(folder: Path, table: str, row: Mapping[str, Any], key: str) -> str:
    value = row.get(key)
    if not isinstance(value, str):
        raise McaptrackError(f"{folder / table}.json: a row has no {key}: {str(dict(row))[:80]}")
    return value


def _number(folder: Path, table: str, row: Mapping[str, Any], key: str) -> int:
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) > _MAX_WHOLE:
        raise McaptrackError(f"{folder / table}.json: {key} has to be a whole number, not {str(value)[:40]!r}")
    return value


def _numbers(folder: Path, row: Mapping[str, Any], key: str, count: int) -> list[float]:
    value = row.get(key)
    numbers = value if isinstance(value, list) else []
    if len(numbers) != count or not all(type(number) in (int, float) for number in numbers):
        raise McaptrackError(
            f"{folder / 'sample_annotation'}.json: {key} has to be {count} numbers, not {str(value)[:60]}"
        )
    return [as_float(number) for number in numbers]
