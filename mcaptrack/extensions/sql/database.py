"""SQL on logs: the tables of logs and of folders of tables, in a database without access to other files.

    with Database([Path("log.mcap")]) as database:
        answer = database.ask("select topic, count(distinct track_id) from tracks group by topic")

A table is loaded when a query names it: from the Parquet file beside the log if that is up to date, otherwise from the
log. Each channel is a table, too, under its name in double quotes. Only this module imports DuckDB.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from itertools import repeat
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from mcaptrack import log, tables
from mcaptrack.errors import McaptrackError, call, did_you_mean, needing
from mcaptrack.evaluation.world_tracks import WorldInterval, WorldTracks, lacks_intervals, tracks_in_worlds
from mcaptrack.files import place_of, publish
from mcaptrack.geometry.arrays import Floats
from mcaptrack.location import Location, distinct_names
from mcaptrack.notices import warn
from mcaptrack.tables import TABLES
from mcaptrack.tables.export import TOPICS, LogTables, current_file, default_folder, topic_folder

__all__ = ["Database"]

#: Settings of a database that only computes with what is in memory. All settings are locked.
_CLOSED: Final = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "allow_persistent_secrets": "false",
    "python_enable_replacements": "false",
    "temp_directory": "",
}
#: Statements that ask, or that create something temporary.
_ASKING: Final = ("SELECT", "EXPLAIN", "CREATE", "SET", "VARIABLE_SET", "RELATION", "MULTI")
_ANSWERING: Final = ("SELECT", "EXPLAIN", "RELATION", "MULTI")
#: The suffixes of files that can be given as tables, and the method that reads each.
_READERS: Final = {
    ".parquet": "read_parquet",
    ".csv": "read_csv",
    ".tsv": "read_csv",
    ".json": "read_json",
    ".jsonl": "read_json",
    ".ndjson": "read_json",
}
#: The tables that ``world_tracks`` is made of, and all that are the same in each world.
_OF_WORLDS: Final = ("tracks", "worlds", "channels", "frames")
_IN_ALL_WORLDS: Final = {"frames", "channels", "recordings", "ground_planes"}
_WORLD_CHANNELS: Final = """
select distinct recording, topic, input from worlds join channels using (recording, topic) order by all
"""
#: The samples of a channel of worlds, at their smoothed places where re-tracking kept them; its frames, and its rows.
_SAMPLES: Final = """
select s.* replace ($shown as topic, coalesce(r.x_m, s.x_m) as x_m, coalesce(r.y_m, s.y_m) as y_m)
from all_tracks s
left join all_tracks r on (r.recording, r.topic, r.source_id, r.t_ns) = (s.recording, $shown, s.track_id, s.t_ns)
where s.recording = $recording and s.topic = $input and s.observed order by s.track_id, s.t_ns
"""
_FRAMES: Final = "select frame, t, t_ns from frames where recording = $recording and topic = $input order by t_ns"
_WORLD_ROWS: Final = """
select world, source_id, track_id, kept, duration_s, t_ns from worlds where recording = $recording and topic = $topic
"""
#: What rows that were not detected lack.
_DETECTED: Final = ("x_px", "y_px", "w_px", "h_px", "score")
#: Queries about pairs of tracks, such as how near people are to each other.
_PAIRS: Final = re.compile(r"\btracks(\s+(as\s+)?\w+)?\s*(,|(\s\w+)*\sjoin\s)\s*tracks\b", re.IGNORECASE)
_MISSING: Final = re.compile(r'Table with name "?(.+?)"? does not exist')


class _LogTables:
    """The tables of a log, named as ``recording``, which is at ``where``."""

    def __init__(self, path: Location) -> None:
        self.opened = log.read(path)
        self.contents = LogTables(self.opened)
        self.recording = self.contents.recording
        self.where: Location = place_of(path)

    def part(self, name: str) -> Any:
        """One of ``TABLES`` as Arrow or as a Parquet file; None if it does not exist."""
        return current_file(self.contents, default_folder(self.opened.path), name) or self.contents.table(name)

    def channel(self, topic: str) -> Any:
        """The table of a channel; None if it does not exist."""
        return self.contents.messages(topic) if topic in self.opened.channels else None

    def channels(self) -> list[str]:
        """The channels that have tables of their own."""
        return sorted(self.opened.channels)


class _FolderTables:
    """The tables of a log in a folder, those that exist as Parquet files."""

    def __init__(self, folder: Path, recording: str) -> None:
        self.folder, self.recording = folder, recording
        self.where: Location = place_of(folder) / recording
        self._member = Path(f"recording={recording}", "part-0.parquet")

    def part(self, name: str) -> Any:
        path = self.folder / name / self._member
        return path if path.is_file() else None

    def channel(self, topic: str) -> Any:
        return self.part(f"{TOPICS}/{topic_folder(topic)}")

    def channels(self) -> list[str]:
        paths = sorted((self.folder / TOPICS).glob(f"*/{self._member.parent.name}/{self._member.name}"))
        metadata = (tables.file_metadata(path, "parquet") or {} for path in paths)
        return [texts["topic"] for texts in metadata if "topic" in texts]


_TableSource = _LogTables | _FolderTables


class Database:
    """A database with the tables of logs, and of folders as ``mcaptrack export`` writes them. A context manager.

    Parameters
    ----------
    paths : sequence of Path or Url
        Logs, and folders of tables. The column ``recording`` has their names, with folders where names are the same.
    files : mapping of str to Path, optional
        More tables by name: CSV, JSON or Parquet. Queries read nothing else, and leave nothing behind.

    Raises
    ------
    McaptrackError
        If there is nothing to read, or if DuckDB isn't installed.
    """

    def __init__(self, paths: Sequence[Location], files: Mapping[str, Path] | None = None) -> None:
        self._stack = ExitStack()
        with ExitStack() as opening:
            self._duckdb = _duckdb()
            #: The sources of the tables that were loaded, as text.
            self.notes: list[str] = []
            self._loaded: dict[str, Any] = {}
            self._sources = [source for path in _unique_paths(paths) for source in self._opened(path, opening)]
            named = [(source.recording, source.where) for source in self._sources]
            self._names = distinct_names([name for name, _ in named], [where for _, where in named])
            self._connection = opening.enter_context(self._duckdb.connect(":memory:", config=_CLOSED))
            for name, path in (files or {}).items():
                self._load_file(name, path)
            for setting in ("TimeZone = 'UTC'", "enable_external_access = false", "lock_configuration = true"):
                self._connection.execute(f"SET {setting}")
            self._stack = opening.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all files."""
        self._stack.close()

    @property
    def recordings(self) -> tuple[str, ...]:
        """The names of the logs, as in the column ``recording``."""
        return tuple(self._names)

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that are tables under their own names."""
        return tuple(sorted({topic for source in self._sources for topic in source.channels()}))

    def ask(self, query: str) -> Any:
        """The answer of the last question in a query, an Arrow table; times are UTC in nanoseconds (DuckDB 2).

        Raises McaptrackError, in one line, for errors of DuckDB.
        """
        return self._guarded(query, self._answer)

    def ask_worlds(self, query: str) -> Any:
        """The answer of one SELECT from ``tracks`` in the worlds of re-tracking, an Arrow table.

        Each number has its median, and in ``NAME_from`` and ``NAME_to`` an interval of 90 %. Rows are told apart by
        their texts and times; ``worlds`` says in how many worlds a row is. A whole number counts as 0 in others.
        Intervals are null where the log can't tell, and for numbers of pairs of tracks.

        Raises McaptrackError for errors of DuckDB, queries that worlds don't change, and logs without worlds.
        """
        return self._guarded(query, self._worlds_answer)

    def _guarded(self, query: str, answered: Callable[[str], Any]) -> Any:
        duckdb = self._duckdb
        try:
            answer = answered(query)
        except duckdb.OutOfMemoryException as error:
            raise McaptrackError(f"the query needs more memory than there is: {_first(error)}") from None
        except (duckdb.Error, RuntimeError) as error:  # DuckDB raises these, too
            raise McaptrackError(self._error_text(str(error), query)) from None
        if answer is None:
            raise McaptrackError("the query asks nothing; it needs a SELECT")
        return tidy(answer)

    def _answer(self, query: str) -> Any:
        """The answer of the last statement that gives one, Arrow or None."""
        if re.match(r"\s*show\s+(all\s+)?tables\b", query, re.IGNORECASE):
            raise McaptrackError(f"tables come in when a query names them; {call('list_tables', 'LOG')} lists them")
        statements = self._connection.extract_statements(query)
        _refuse_writing([statement.type.name for statement in statements])
        answers = [self._run(each) for each in statements]
        answers = [answer for answer, each in zip(answers, statements, strict=True) if each.type.name in _ANSWERING]
        if len(answers) > 1:
            warn(f"the query asks {len(answers)} questions; only the last is answered", "left-out")
        return answers[-1] if answers else None

    def _worlds_answer(self, query: str) -> Any:
        """As ``ask_worlds``."""
        statements = self._connection.extract_statements(query)
        if [statement.type.name for statement in statements] != ["SELECT"]:
            raise McaptrackError("worlds are asked by one SELECT; `world_tracks` has their tracks for other queries")
        plain = re.sub(r"\busing\s*\([^)]*\)", "on true", query, flags=re.IGNORECASE)  # its columns are not known yet
        names = {name.lower().strip('"') for name in self._connection.get_table_names(plain)}
        self._load_worlds()
        having = {recording for recording, *_ in self._connection.sql(_WORLD_CHANNELS).fetchall()}
        if lacking := [name for name in self._names if name not in having]:
            raise McaptrackError(f"{lacking[0]} has no worlds; {call('retrack', 'LOG', worlds=50)} draws them")
        others = {name for name in names if name in TABLES or "/" in name} - _IN_ALL_WORLDS - {"tracks"}
        topics = {topic for (topic,) in self._connection.sql("select distinct topic[:-8] from worlds").fetchall()}
        others |= set(re.findall(r"'(/[^']*)'", query)) & set(self.channels) - topics
        if others or "tracks" not in names:
            raise McaptrackError(
                f"worlds have other `tracks` of {', '.join(sorted(topics))}, and nothing else: ask these"
                + (f", not {', '.join(sorted(others))}" if others else "")
            )
        answers, seen = [], []
        for tracks, of_world in self._tracks_in_worlds():
            self._connection.register("tracks", tracks.drop_columns(["world"]))
            answers.append(tidy(self._run(self._connection.extract_statements(query)[0])))
            seen.append(of_world)
        has_none = lacks_intervals(seen)
        if _PAIRS.search(query) and not has_none:
            has_none = True
            warn(
                "numbers of pairs of tracks have no intervals: worlds hold how near people are too seldom",
                "not-compared",
            )
        return self._over_worlds(answers, has_none)

    def _tracks_in_worlds(self) -> Iterator[tuple[Any, tuple[int, float, float]]]:
        """The tracks of each world, Arrow, and the number of people and the shares of tracks that are late and lost."""
        import pyarrow as pa

        def asked(query: str, **values: str) -> Any:
            return self._connection.sql(query, params=values).to_arrow_table()

        parts = []
        for recording, topic, samples_topic in self._connection.sql(_WORLD_CHANNELS).fetchall():
            where = {"recording": recording, "input": samples_topic}
            samples, frames = asked(_SAMPLES, shown=topic.removesuffix("/worlds"), **where), asked(_FRAMES, **where)
            rows = _arrays(asked(_WORLD_ROWS, recording=recording, topic=topic))
            of, t_ns = _arrays(samples), _arrays(frames)["t_ns"]
            frame = np.searchsorted(t_ns, of["t_ns"])
            xy_m = np.stack([of["x_m"], of["y_m"]], axis=1)
            drawn = tracks_in_worlds(of["track_id"], of["class_id"], frame, xy_m, t_ns, rows, rows["t_ns"])
            parts.append(zip(repeat(samples), repeat(frames), repeat(xy_m), drawn, strict=False))
        for number, channels in enumerate(zip(*parts, strict=False), start=1):
            people = [world.people for *_, world in channels]
            cut = [(world.late, world.lost) for *_, world in channels]
            late, lost = np.average(cut, axis=0, weights=np.maximum(people, 1)).tolist()
            whole = pa.concat_tables([_of_world(*channel) for channel in channels])
            whole = whole.append_column("world", pa.array(np.full(len(whole), number, np.uint32)))
            yield whole, (sum(people), late, lost)

    def _load_worlds(self) -> None:
        """Load what the tracks of worlds are made of."""
        for table in _OF_WORLDS:
            self._load(table)
        self._connection.register("all_tracks", self._loaded["tracks"])

    def _over_worlds(self, answers: Sequence[Any], has_none: bool) -> Any:
        """The median and the interval of each number in the ``answers`` of all worlds."""
        import pyarrow as pa

        schema = answers[0].schema
        is_number = {f.name: pa.types.is_integer(f.type) or pa.types.is_floating(f.type) for f in schema}
        keys = [_quoted(name) for name in schema.names if not is_number[name]]
        whole = pa.concat_tables(
            [answer.append_column("world of answer", pa.array([n] * len(answer))) for n, answer in enumerate(answers)]
        )
        rows = self._connection.from_arrow(whole)
        repeated = rows.aggregate('count(*) as "rows of world"', ", ".join(['"world of answer"', *keys]))
        if repeated.filter('"rows of world" > 1').fetchall():
            raise McaptrackError(
                "worlds have several rows with the same texts and times, so that their numbers can't be put together; "
                "name each row by a text, as in `track_id::text`, or ask for one row"
            )
        numbers = [name for name in schema.names if is_number[name]]
        lists = [f"list({_quoted(name)}) as {_quoted(name)}" for name in numbers]
        over_all = rows.aggregate(", ".join([*keys, *lists, "count(*) as worlds"]), ", ".join(keys))
        found = (over_all.order(", ".join(keys)) if keys else over_all.limit(len(whole))).to_arrow_table()
        columns = {name: found[name] for name in schema.names if not is_number[name]}
        for name in numbers:
            counts = pa.types.is_integer(schema.field(name).type)
            missing = [0] * len(answers) if counts else []
            values = (row + missing[len(row) :] for row in found[name].to_pylist())
            intervals = [WorldInterval.of(np.array(row, float), counts, has_none) for row in values]
            middle, low, high = zip(*intervals, strict=True) if intervals else ((), (), ())
            kind = pa.int64() if counts else pa.float64()
            columns |= {name: pa.array(middle, pa.float64())}
            columns |= {name + end: pa.array(side).cast(kind) for end, side in (("_from", low), ("_to", high))}
        return pa.table(columns | {"worlds": found["worlds"]})

    def _run(self, statement: Any) -> Any:
        """The answer of a statement, Arrow or None; loads the tables that it names, and those that DuckDB then
        misses.
        """
        with suppress(self._duckdb.Error):
            for name in self._connection.get_table_names(statement.query):
                self._load(name)
        while True:
            try:
                return self._computed(statement)
            except self._duckdb.CatalogException as error:
                missing = _MISSING.search(str(error))
                if not missing or not self._load(missing.group(1)):
                    raise

    def _computed(self, statement: Any) -> Any:
        """The answer of a statement, Arrow or None.

        Python handles SIGINT only between bytecodes, so the query runs in another thread, which this one can interrupt.
        """

        def compute() -> Any:
            relation = self._connection.sql(statement)
            return None if relation is None else relation.to_arrow_table()

        with ThreadPoolExecutor(1) as executor:
            running = executor.submit(compute)
            try:
                return running.result()
            except BaseException:
                while not running.done():
                    self._connection.interrupt()
                    wait([running], 0.05)
                raise

    def _load(self, name: str) -> bool:
        """Load a table; False if it is loaded already or does not exist."""
        lower = name.lower()
        if name in self._loaded or lower in self._loaded:
            return False
        if lower == "world_tracks":
            import pyarrow as pa

            self._load_worlds()
            whole = [tracks for tracks, *_ in self._tracks_in_worlds()]
            none = self._loaded["tracks"].slice(0, 0).append_column("world", pa.array([], pa.uint32()))
            self._loaded[lower] = pa.concat_tables(whole or [none])
            self._connection.register(lower, self._loaded[lower])
            return True
        if lower in TABLES:
            name, columns = lower, TABLES[lower].arrow
            parts = [(at, source.part(lower)) for at, source in self._named()]
        else:
            columns = None
            parts = [(at, source.channel(name)) for at, source in self._named()]
        parts = [(at, part) for at, part in parts if part is not None]
        if not parts and columns is None:
            return False
        for recording, part in parts:
            text = f"from {part}" if isinstance(part, Path) else "read from the log; exported tables would be quicker"
            self.notes.append(f"{recording}: {name} {text}")
        self._loaded[name] = tables.join(parts, columns)
        self._connection.register(name, self._loaded[name])
        return True

    def _named(self) -> list[tuple[str, _TableSource]]:
        return list(zip(self._names, self._sources, strict=True))

    def _opened(self, path: Location, opening: ExitStack) -> list[_TableSource]:
        if not isinstance(path, Path) or not path.is_dir():
            source = _LogTables(path)
            opening.enter_context(source.opened)
            return [source]
        recordings = {member.name.partition("=")[2] for name in TABLES for member in (path / name).glob("recording=*")}
        readers = [_FolderTables(path, name) for name in sorted(recordings)]
        usable = [reader for reader in readers if any(reader.part(table) for table in TABLES)]
        if not usable:
            log.refuse_non_mcap(path)
            other = " (those in other formats are not read)" if recordings else ""
            raise McaptrackError(
                f"{path} is a folder without tables in Parquet{other}; give a log, or a folder that one was exported to"
            )
        return [*usable]

    def _load_file(self, name: str, path: Path) -> None:
        """Load a file as a table."""
        reader = _READERS.get(path.suffix.lower())
        if reader is None:
            raise McaptrackError(f"{path}: tables are read from files that end with {', '.join(_READERS)}")
        if name.lower() in TABLES or not re.fullmatch(r"[A-Za-z_]\w*", name):
            raise McaptrackError(
                f"{name} can't name a table; take letters and digits, and no name that a log's table has"
            )
        if not path.is_file():
            raise McaptrackError(f"{path} can't be read: no such file")
        try:
            getattr(self._connection, reader)(str(path)).create(name)
        except self._duckdb.Error as error:
            raise McaptrackError(f"{path} can't be read as a table: {_first(error)}") from None
        self._loaded[name.lower()] = path

    def _error_text(self, error: str, query: str) -> str:
        """A message of DuckDB in one line, with the tables that exist."""
        if missing := _MISSING.search(error):
            name = missing.group(1)
            names = [*TABLES, *sorted(set(self._loaded) - set(TABLES))]
            channels = self.channels if "/" in name else ()
            question = did_you_mean(name, [*names, *channels])
            nearest = f" ({question.rstrip()})" if question else ""
            more = f"the channels {', '.join(channels)}" if channels else "channels in double quotes"
            return f"there is no table {name}{nearest}; there are {', '.join(names)}, and {more}"
        kind, _, text = error.partition(": ")
        line = re.search(r"^LINE (\d+):", text, re.M)
        text = " ".join(re.split(r"^LINE \d+:|\n\s*Candidate functions:", text, maxsplit=1, flags=re.M)[0].split())
        if "file system operations are disabled" in error or "is disabled through configuration" in error:
            return f"queries only read what they are given ({text}); `files=` gives a file"
        if re.search(r'Referenced column "[^"]*[/ ][^"]*" not found', text):
            text += " (text stands in 'single quotes', names in \"double\" ones)"
        if "TIMESTAMPTZ_NS" in text:
            text += " Such functions take t::timestamptz, which is exact to the microsecond."
        where = f", in line {line.group(1)}" if line and "\n" in query.strip() else ""
        return f"SQL{where}: {text}" if kind.endswith("Error") else f"SQL: {error}"


def _arrays(table: Any) -> dict[str, NDArray[Any]]:
    """The columns of an Arrow table, of numbers."""
    import pyarrow.types as kinds

    numbers = [name for name in table.column_names if kinds.is_primitive(table.schema.field(name).type)]
    return {name: table[name].to_numpy() for name in numbers}


def _of_world(samples: Any, frames: Any, xy_m: Floats, world: WorldTracks) -> Any:
    """The tracks of a world, as rows of samples, Arrow."""
    import pyarrow as pa
    import pyarrow.compute as pc

    rows, at, seen = samples.take(pa.array(world.before)), frames.take(pa.array(world.frame)), pa.array(world.observed)
    x_m, y_m = (pa.array(values, from_pandas=True) for values in world.values(xy_m).T)
    columns = {name: at[name] for name in at.column_names}
    columns |= {"track_id": pa.array(world.track), "x_m": x_m, "y_m": y_m, "observed": seen}
    columns |= {name: pc.if_else(seen, rows[name], pa.scalar(None, rows[name].type)) for name in _DETECTED}
    columns["source_id"] = pc.if_else(seen, rows["source_id"], -1)
    return pa.table({name: columns.get(name, rows[name]) for name in rows.column_names})


def _duckdb() -> Any:
    """DuckDB, if it is installed."""
    with needing("SQL", "DuckDB", "sql"):
        import duckdb
    return duckdb


def _unique_paths(paths: Sequence[Location]) -> list[Location]:
    """Paths without repetitions, and without results of a log that is among them."""
    by_place: dict[Location, Location] = {}
    for path in paths:
        by_place.setdefault(place_of(path), path)
    results = {log.results_path(place) for place in by_place}
    return [path for place, path in by_place.items() if place not in results]


def _refuse_writing(kinds: Sequence[str]) -> None:
    for kind in kinds:
        if kind not in _ASKING:
            raise McaptrackError(
                f"queries only read: {kind} is refused; `output=` writes an answer, `files=` gives a file"
            )


def _quoted(name: str) -> str:
    """The name of a column in a query."""
    return '"' + name.replace('"', '""') + '"'


def _first(error: Exception) -> str:
    return str(error).partition(": ")[2].splitlines()[0]


def tidy(table: Any) -> Any:
    """An answer with unique column names and types that all formats support; sums of whole numbers become int64 if
    possible.

    The second of two columns ``a`` is ``a_1``; intervals become text.
    """
    import pyarrow as pa

    names: list[str] = []
    for name in table.schema.names:
        unique = (f"{name}_{number}" if number else name for number in range(len(table.schema.names) + 1))
        names.append(next(name for name in unique if name not in names))
    columns = []
    for column in table.columns:
        kind = column.type
        if pa.types.is_decimal(kind) and kind.scale == 0:
            try:
                column = column.cast(pa.int64())  # noqa: PLW2901
            except pa.ArrowInvalid:
                column = column.cast(pa.string())  # noqa: PLW2901
        elif pa.types.is_decimal(kind):
            column = column.cast(pa.float64())  # noqa: PLW2901
        elif kind == pa.month_day_nano_interval():
            column = pa.array([_interval(value) for value in column.to_pylist()], pa.string())  # noqa: PLW2901
        columns.append(column)
    return pa.table(columns, names=names)


def _interval(value: Any) -> str | None:
    """An interval as DuckDB prints it: 1 month 2 days 00:00:01.5."""
    if value is None:
        return None
    years = math.trunc(value.months / 12)
    calendar = ((years, "year"), (value.months - 12 * years, "month"), (value.days, "day"))
    parts = [f"{count} {name}{'s' * (abs(count) != 1)}" for count, name in calendar if count]
    sign, rest = "-" * (value.nanoseconds < 0), abs(value.nanoseconds)
    if rest or not parts:
        seconds, nanos = divmod(rest, 10**9)
        fraction = f".{nanos:09d}".rstrip("0") if nanos else ""
        parts.append(f"{sign}{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}{fraction}")
    return " ".join(parts)


def write_answer(path: Path, table: Any, form: str) -> None:
    """Write an answer to a file, which appears when it is complete. Raises McaptrackError if it can't be written.

    ``form`` is its format: "csv", "json", "jsonl", "parquet" or "arrow".
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with publish(path) as part, part.open("xb") as stream:
            if form == "parquet":
                pq.write_table(table, stream, compression="zstd")
            elif form == "arrow":
                with pa.ipc.new_file(stream, table.schema) as writer:
                    writer.write_table(table)
            else:
                for piece in tables.pieces(table, form):  # type: ignore[arg-type]
                    stream.write(piece)
    except (OSError, pa.ArrowException) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise McaptrackError(f"{path} can't be written: {reason}") from error
