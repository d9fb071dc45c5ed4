"""Write files atomically: they are either complete or not there."""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from itertools import islice
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory, gettempdir
from time import time
from typing import IO, Any, Final

from mcaptrack import notices
from mcaptrack.errors import McaptrackError, list_names, similar
from mcaptrack.location import SCHEMES, Location, Url, hide_secrets, shortened
from mcaptrack.processes import MARK_DIGITS, has_ended, mark_of

__all__ = [
    "follow_links", "is_same_file", "make_folder", "missing", "place_of", "publish", "publish_bytes", "read_beginning",
    "read_json", "reading", "refuse_overwrite", "refuse_special", "temporary_folder", "unreadable", "visible",
    "writing",
]  # fmt: skip


@contextmanager
def publish(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to; when the block succeeds, that file replaces ``path``.

    The bytes are synced to disk before the file is renamed, so that an interruption at any time leaves the old file or
    the new one. If the block fails, the temporary file is removed. Raises McaptrackError if it can't be written, as far
    as errors name it; libraries of video do, and a full disk is named for open files.
    """
    sweep(path.parent, path.name)
    part = _part_of(path)
    try:
        yield part
        with part.open("rb+") as written:
            os.fsync(written.fileno())
        lost = keep_attributes(path, part) if path.exists() else []
        os.replace(part, path)
        if lost:
            notices.warn(f"{path} is a new file now, without the {' and '.join(lost)} of the old one")
    except OSError as error:
        is_full = error.filename is None and error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
        if error.errno is None or not (is_full or part.name in str(error.filename)):
            raise
        raise McaptrackError(f"{path} can't be written: {error.strerror}") from error
    finally:
        if part.is_dir():  # code of another package may make one
            rmtree(part, ignore_errors=True)
        with suppress(FileNotFoundError):
            part.unlink()
    sync_folder(path.parent)


@contextmanager
def publish_stream(path: Path) -> Iterator[IO[bytes]]:
    """The same with an open file. Raises McaptrackError if it can't be written."""
    try:
        with publish(path) as part, part.open("xb") as stream:
            yield stream
    except OSError as error:
        if error.filename is None and error.errno is None:
            raise
        raise McaptrackError(f"{path} can't be written: {error.strerror or error}") from error


@contextmanager
def publish_folder(folder: Path) -> Iterator[Path]:
    """A path of the same name for a folder that the block makes; when it succeeds, that folder replaces ``folder``.

    If the block fails, it is removed. Raises McaptrackError if it can't be written.
    """
    part = folder.with_name(shortened(f".{folder.name}", _NAME_BYTES) + ".part")
    rmtree(part, ignore_errors=True)
    try:
        with writing(folder):
            part.mkdir(parents=True)
            yield part / folder.name
            if folder.exists():
                folder.rename(part / "before")  # removed in one step: half of it would be taken for another one
            (part / folder.name).rename(folder)
    finally:
        rmtree(part, ignore_errors=True)


@contextmanager
def writing(what: object) -> Iterator[None]:
    """A block that writes ``what``. Raises McaptrackError, which names it, for an error of the system in the block."""
    try:
        yield
    except OSError as error:
        raise McaptrackError(f"{what} can't be written: {error.strerror or error}") from error


@contextmanager
def reading(path: Path) -> Iterator[BufferedReader]:
    """The bytes of a file. Raises McaptrackError if it can't be opened, or read in the block."""
    try:
        with path.open("rb") as stream:
            yield stream
    except OSError as error:
        raise unreadable(path, error) from None


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, unless it exists. Raises McaptrackError if it can't be made."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


def publish_bytes(path: Path, data: bytes) -> None:
    """Write a small file atomically. Raises McaptrackError if it can't be written.

    ``data`` is its content.
    """
    with publish_stream(path) as stream:
        stream.write(data)


def keep_attributes(path: Path, new: Path) -> list[str]:
    """Copy owner, group, permissions and extended attributes (with access control lists) of a file to a new one.

    Returns the names of those that could not be copied.
    """
    old, here = path.stat(), new.stat()
    lost: list[str] = []
    for name, wanted, value, owner in (
        ("owner", old.st_uid, here.st_uid, (old.st_uid, -1)),
        ("group", old.st_gid, here.st_gid, (-1, old.st_gid)),
    ):
        if wanted != value:
            with _noting(name, lost):
                os.chown(new, *owner)
    with _noting("permissions", lost):
        new.chmod(old.st_mode & (0o777 if lost else 0o7777))  # no set-user-id bit for another user
    with _noting("extended attributes", lost):
        _keep_extended(path, new)
    return lost


@contextmanager
def _noting(name: str, lost: list[str]) -> Iterator[None]:
    try:
        yield
    except OSError:
        lost.append(name)


def _keep_extended(path: Path, new: Path) -> None:
    if not hasattr(os, "listxattr"):
        return
    ours, theirs = ({name: os.getxattr(of, name) for name in os.listxattr(of)} for of in (new, path))
    for name in ours.keys() - theirs.keys():
        os.removexattr(new, name)
    for name, value in theirs.items():
        if ours.get(name) != value:
            os.setxattr(new, name, value)


def can_replace(path: Path) -> bool:
    """Whether a new file can replace a file without losing anything but the old content.

    It can't if the file has hard links, which would still lead to the old content, or if its owner and attributes can't
    be copied.
    """
    if path.stat().st_nlink > 1:
        return False
    probe = _part_of(path)
    try:
        probe.touch(0o600, exist_ok=False)
        return not keep_attributes(path, probe)
    except OSError:
        return True  # no file can be created here; writing will report that
    finally:
        with suppress(OSError):
            probe.unlink()


#: A temporary file of ``publish``, and a temporary folder: what it is for, and the process that made it.
_PART: Final = re.compile(rf"\.(.+)\.(\d+)\.([0-9a-f]{{{MARK_DIGITS}}})[0-9a-f]{{6}}\.part", re.DOTALL)
_FOLDER: Final = re.compile(rf"mcaptrack-()(\d+)-([0-9a-f]{{{MARK_DIGITS}}})-.*")
#: The most bytes of a name that its temporary file repeats: file systems allow 255 bytes in all.
_NAME_BYTES: Final = 200
#: Seconds without a change after which the files of a process of another machine, or container, count as left behind.
_ABANDONED_S: Final = 3600.0


def _part_of(path: Path) -> Path:
    pid = os.getpid()
    return path.with_name(f".{shortened(path.name, _NAME_BYTES)}.{pid}.{mark_of(pid)}{secrets.token_hex(3)}.part")


def sweep(folder: Path, name: str = "") -> None:
    """Remove from a folder the temporary files of processes that have ended: those of the file ``name``, or all."""
    _remove_left(folder, _PART, shortened(name, _NAME_BYTES))


def temporary_folder() -> TemporaryDirectory[str]:
    """A temporary folder, removed after its block or with the object; those of processes that have ended are, too."""
    _remove_left(Path(gettempdir()), _FOLDER)
    pid = os.getpid()
    return TemporaryDirectory(prefix=f"mcaptrack-{pid}-{mark_of(pid)}-")


def _remove_left(folder: Path, pattern: re.Pattern[str], name: str = "") -> None:
    """Remove the entries of a folder that a pattern matches, if the process in their names has ended.

    With ``name`` only those of this file. An entry that can't be removed stays.
    """
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            parts = pattern.fullmatch(entry.name)
            if parts is None or (name and parts[1] != name):
                continue
            ended = has_ended(int(parts[2]), parts[3])
            with suppress(OSError):
                if ended or (ended is None and time() - entry.stat(follow_symlinks=False).st_mtime > _ABANDONED_S):
                    if entry.is_dir(follow_symlinks=False):
                        rmtree(entry.path)
                    else:
                        os.unlink(entry.path)


def visible(paths: Iterable[Path]) -> list[Path]:
    """Those of paths that are no hidden files, such as ._NAME, which macOS writes for each file, by name."""
    return sorted(path for path in paths if not path.name.startswith("."))


def sync_folder(folder: Path) -> None:
    """Sync a folder to disk, with the files created, renamed and removed in it."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def follow_links(path: Path) -> Path:
    """A path with symbolic links resolved; circular links are left, and opening the file reports them."""
    return Path(os.path.realpath(path))  # Path.resolve raises RuntimeError for these up to Python 3.12


def place_of(location: Location) -> Location:
    """The place that a location leads to: with symbolic links resolved, if it is a path."""
    return location if isinstance(location, Url) else follow_links(location)


def is_same_file(path: Location, other: Location) -> bool:
    """Whether two paths lead to the same existing file.

    ``other`` is the second of them.
    """
    if isinstance(path, Url) or isinstance(other, Url):
        return path == other
    return path.exists() and other.exists() and path.samefile(other)


def read_beginning(path: Path, count: int) -> bytes:
    """Return the first bytes of a file, at most ``count``. Raises McaptrackError if it can't be read."""
    refuse_special(path)
    with reading(path) as stream:
        return stream.read(count)


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON. Raises ValueError if a name is there twice."""
    out: dict[str, Any] = {}
    for name, value in pairs:
        if name in out:
            raise ValueError(f"{name!r:.60} stands there twice")
        out[name] = value
    return out


def read_json(
    path: Path,
    what: str,
    most_bytes: int,
    opened: Callable[[Path], IO[bytes]] | None = None,
    is_unique: bool = False,
) -> Any:
    """Return the content of a JSON file, of the form ``what``; ``opened`` opens it, if it may be packed.

    Raises McaptrackError if it can't be read, has more than ``most_bytes``, is nested too deep or is invalid; and if
    ``is_unique``, for a name that an object has twice.
    """
    refuse_special(path)
    try:
        size = path.stat().st_size
        if size > most_bytes:
            raise McaptrackError(f"{path} has {size} bytes; at most {most_bytes} of {what} are read: give it in parts")
        with opened(path) if opened else path.open("rb") as stream:
            text = stream.read().decode("utf-8-sig")
            return json.loads(text, object_pairs_hook=_each_once if is_unique else None)
    except OSError as error:
        raise unreadable(path, error) from None
    except UnicodeDecodeError:
        raise McaptrackError(f"{path} is not a text file, as {what} is") from None
    except RecursionError:
        raise McaptrackError(f"{path} is nested deeper than {what} is") from None
    except ValueError as error:
        raise McaptrackError(f"{path} is not valid JSON: {str(error)[:200]}") from None


def unreadable(path: Path, error: OSError | ValueError) -> McaptrackError:
    """The fault of a file that can't be read: one that isn't there, or why the system refuses it.

    ``error`` is what the system raised.
    """
    if isinstance(error, FileNotFoundError):
        return McaptrackError(missing(path))
    return McaptrackError(f"{path} can't be read: {getattr(error, 'strerror', None) or str(error).splitlines()[0]}")


#: The most names of a folder that are compared with one that isn't there.
_MOST_NAMES: Final = 2000


def missing(path: Path) -> str:
    """The message about a file or folder that isn't there, or is no file: whether its folder is, and which is meant."""
    if path.is_dir():
        return f"{path} is a folder; give the name of a file"
    if path.is_symlink():
        return f"{path} is a link to {path.readlink()}, which does not exist"
    folder = path.parent
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in islice(entries, _MOST_NAMES)]
    except OSError:
        return f"{path} does not exist: there is no folder {folder}"
    stems: dict[str, list[str]] = {}
    for name in names:
        stems.setdefault(Path(name).stem, []).append(name)
    stem = "" if path.stem.startswith(".") else similar(path.stem, stems, 0.75)
    of_kind = sorted(name for name in names if path.suffix and name.endswith(path.suffix) and not name.startswith("."))
    if stem:
        return f"{path} does not exist; did you mean {folder / similar(path.name, stems[stem], 0)}?"
    where = "the working folder" if folder == Path() else f"the folder {folder}"
    has = list_names(of_kind, 5) if of_kind else f"no file that ends with {path.suffix}"
    return f"{path} does not exist; {where} has {has}" if path.suffix else f"{path} does not exist"


def refuse_special(path: Path) -> None:
    """Raise McaptrackError for a pipe, a device or a socket (reading may never end), and an impossible name.

    ``path`` may name a file, a folder or nothing.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise unreadable(path, error) from None
        return  # opening it reports the reason
    except ValueError:
        raise McaptrackError(f"{path} can't be the name of a file: it has a zero byte") from None
    kinds = {stat.S_ISFIFO: "a pipe", stat.S_ISCHR: "a device", stat.S_ISBLK: "a device", stat.S_ISSOCK: "a socket"}
    for is_kind, what in kinds.items():
        if is_kind(mode):
            raise McaptrackError(f"{path} is {what}, not a file; save its data to a file first")


#: A URL, also one that has become a path: "s3://bucket/a" is "s3:/bucket/a" then.
_URL: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+([^\s]+)")


def refuse_url(path: Path | str) -> None:
    """Raise McaptrackError for a URL, with the slashes that it had."""
    match = _URL.fullmatch(str(path))
    if match and not Path(path).exists():
        url = hide_secrets(f"{match[1]}://{match[2]}")
        if match[1].lower() in SCHEMES:
            raise McaptrackError(f"{url} is in a store, from which only logs are read; give a file here")
        raise McaptrackError(
            f"{url} is a URL; only files, and logs at s3://, gs:// and az://, are read: copy it here first"
        )


def refuse_overwrite(path: Path, force: bool) -> None:
    """Raise McaptrackError if ``path`` can't be written to, or exists and ``force`` is not given."""
    if path.is_dir():
        raise McaptrackError(f"{path} is a folder; give the name of a file")
    if not (folder := path.parent).is_dir():
        raise McaptrackError(f"{folder} is a file, no folder" if folder.exists() else f"the folder {missing(folder)}")
    if path.exists() and not force:
        raise McaptrackError(f"{path} exists; give another name with `output=`, or `force=True` to replace it")
