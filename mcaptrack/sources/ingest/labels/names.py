"""Names of classes in a file beside labels: labels.txt, classes.txt, obj.names, data.yaml and their like."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.files import visible
from mcaptrack.sources.ingest import plain_yaml
from mcaptrack.sources.ingest.labels.table import BoxTable
from mcaptrack.sources.ingest.labels.text import MAX_NAME, MAX_NAMES, is_count, lines_of

LISTS: Final = ("labels.txt", "classes.txt", "obj.names", "_classes.txt")
_YAML: Final = ("data.yaml", "data.yml", "dataset.yaml")
#: A line of a list that states its number: `2: person`, `2 person`, `2,person`.
_NUMBERED: Final = re.compile(r"([0-9]{1,9})(?: ?[:=,] ?| )(\D.*)")


def name_classes(table: BoxTable, folders: Iterable[Path], first: int) -> None:
    """Name the classes of a table by a file in the first of ``folders`` that has one.

    Names in a list count from ``first``, where it states no numbers. What can't be read is said.
    """
    for folder in dict.fromkeys(folders):
        others = visible(folder.glob("*.names")) if folder.is_dir() else []
        for path in (*(folder / name for name in (*LISTS, *_YAML)), *others[:1]):
            if not path.is_file() or path == table.path:
                continue
            try:
                names = _of_yaml(path) if path.name in _YAML else _of_list(path, first)
            except McaptrackError as error:
                table.find(f": {error}; class names are not known", "classes")
                continue
            if names:
                table.facts.names, table.facts.named_by = names, str(path)
                table.remark(f": class names by {path}")
                return


def _of_list(path: Path, first: int) -> dict[int, str]:
    lines = [" ".join(line.split())[:MAX_NAME] for _, line in lines_of(path)]
    numbered = [match for match in map(_NUMBERED.fullmatch, lines) if match]
    if len(numbered) == len(lines) == len({int(match[1]) for match in numbered}):
        return {int(match[1]): match[2] for match in numbered}
    return dict(enumerate(lines[:MAX_NAMES], start=first))


def _of_yaml(path: Path) -> dict[int, str]:
    """The field "names" of a data.yaml: a list, or a map from numbers to names."""
    with path.open("rb") as stream:
        data = stream.read(plain_yaml.MAX_BYTES + 1)
    try:
        content: Any = plain_yaml.load(data)
    except plain_yaml.UnsupportedYamlError as error:
        raise McaptrackError(f"{path} is not valid YAML ({str(error)[:200]})") from None
    names = content.get("names") if isinstance(content, dict) else None
    if isinstance(names, list):
        names = {str(number): name for number, name in enumerate(names)}
    if not isinstance(names, dict) or not names:
        return {}
    if not all(isinstance(name, str) and is_count(key, 9) for key, name in names.items()):
        raise McaptrackError(f"{path}: `names` is neither a list of names nor a map from numbers to names")
    return {int(key): " ".join(str(name).split())[:MAX_NAME] for key, name in names.items()}
