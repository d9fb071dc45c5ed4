"""Objects in Amazon S3, Google Cloud Storage and Azure Blob Storage. Only here: obstore.

Credentials, regions and endpoints are found as the programs of these services find them: in the environment, in the
profiles of AWS, on the machine itself. Requests that fail are sent again, with growing pauses. What can't be mended by
that is a McaptrackError that names the URL; no message contains a secret.

Every request for a part of an object asks for the version that was opened.
"""

from __future__ import annotations

import configparser
import os
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from mcaptrack.errors import McaptrackError
from mcaptrack.location import SCHEMES, Url, hide_secrets
from mcaptrack.objects import AbsentError, StoreCheck, Version, replaced

#: Requests at the same time, and the most bytes of one.
_AT_ONCE: Final = 8
_MAX_BYTES: Final = 8 * 2**20
#: Larger objects are written in parts of this size, each with its checksum.
_PART_BYTES: Final = 16 * 2**20
#: An answer that breaks off is asked for so often.
_TRIES: Final = 3


# The stores that URLs name, with credentials, region and endpoint as the environment or a profile gives them.


#: A request that fails is sent again so often, and within so many seconds; one without an answer fails after a while.
_RETRIES: Final = 9
_PATIENCE, _CONNECT, _READ, _REQUEST = (timedelta(seconds=seconds) for seconds in (60, 5, 20, 300))
#: The first and the longest pause. Each is up to so many times as long as the one before; with 2 all nine would take
#: less than three seconds.
_FIRST, _LONGEST = timedelta(milliseconds=100), timedelta(seconds=5)
_GROWTH: Final = 3


def library(url: Url) -> Any:
    """The library, if it is installed, and if its threads are in this process: in a fork it would wait for ever."""
    if _first_process() != os.getpid():
        raise McaptrackError(
            f"{url} can't be reached: this process was forked from one that has used a store; start processes by "
            "spawning, as `multiprocessing.get_context('spawn')` does"
        )
    try:
        import obstore
        import obstore.exceptions
    except ImportError:
        raise McaptrackError(
            f"{url} is in {SCHEMES[url.scheme]}, which needs obstore, and that is not installed; install it with: "
            'pip install "mcaptrack[cloud]"'
        ) from None
    return obstore


@lru_cache(1)
def _first_process() -> int:
    """The process that asked first; also in those that were forked from it since."""
    return os.getpid()


def store_of(url: Url) -> Any:
    """The store of a bucket."""
    names = ("AWS_", "AZURE_", "GOOGLE_")
    settings = tuple(sorted((name, value) for name, value in os.environ.items() if name.startswith(names)))
    return _made_store(url.scheme, url.bucket, settings)


@lru_cache(32)
def _made_store(scheme: str, bucket: str, settings: tuple[tuple[str, str], ...]) -> Any:
    from obstore.store import AzureStore, GCSStore, S3Store

    env = dict(settings)
    backoff = {"init_backoff": _FIRST, "max_backoff": _LONGEST, "base": _GROWTH}
    common: dict[str, Any] = {
        "client_options": {"connect_timeout": _CONNECT, "read_timeout": _READ, "timeout": _REQUEST},
        "retry_config": {"max_retries": _RETRIES, "backoff": backoff, "retry_timeout": _PATIENCE},
    }
    if scheme == "gs":
        return GCSStore(bucket, **common)
    if scheme == "az":
        return AzureStore(bucket, **common)
    config: Any = _of_profile(env)
    if endpoint := env.get("AWS_ENDPOINT_URL_S3") or env.get("AWS_ENDPOINT_URL") or config.get("endpoint"):
        config["endpoint"] = endpoint
        common["client_options"]["allow_http"] = endpoint.startswith("http://")
    if not env.get("AWS_REGION") and env.get("AWS_DEFAULT_REGION"):
        config["region"] = env["AWS_DEFAULT_REGION"]
    return S3Store(bucket, config=config, **common)


def _of_profile(environment: Mapping[str, str]) -> dict[str, str]:
    """The settings in the profile of AWS that the environment does not have.

    Raises McaptrackError if AWS_PROFILE names a profile that has no keys.
    """
    home = Path.home() / ".aws"
    name = _profile(environment)
    files = (
        (environment.get("AWS_CONFIG_FILE") or home / "config", name if name == "default" else f"profile {name}"),
        (environment.get("AWS_SHARED_CREDENTIALS_FILE") or home / "credentials", name),
    )
    profile: dict[str, str] = {}
    for path, section in files:
        reader = configparser.RawConfigParser()
        try:
            reader.read(path, encoding="utf-8")
        except (configparser.Error, UnicodeDecodeError, OSError):
            raise McaptrackError(f"{path} can't be read as settings of AWS") from None
        profile |= dict(reader[section]) if section in reader else {}
    has_keys = {"aws_access_key_id", "aws_secret_access_key"} <= profile.keys()
    if environment.get("AWS_PROFILE") and not has_keys and "AWS_ACCESS_KEY_ID" not in environment:
        raise McaptrackError(
            f"the profile {name} of AWS (AWS_PROFILE) has no aws_access_key_id and aws_secret_access_key; "
            "`aws configure export-credentials` prints those of a profile of another kind, for the environment"
        )
    settings = {"region": profile.get("region"), "endpoint": profile.get("endpoint_url")}
    if "AWS_ACCESS_KEY_ID" not in environment and has_keys:
        settings |= {
            "access_key_id": profile["aws_access_key_id"],
            "secret_access_key": profile["aws_secret_access_key"],
            "session_token": profile.get("aws_session_token"),
        }
    return {name: value for name, value in settings.items() if value and f"AWS_{name.upper()}" not in environment}


def described(url: Url) -> tuple[str, str, str]:
    """The server of a store, its region ("" where there are none), and where the credentials come from.

    Raises McaptrackError if the settings of AWS can't be read.
    """
    environment, service = os.environ, SCHEMES[url.scheme]
    if url.scheme == "gs":
        file = environment.get("GOOGLE_APPLICATION_CREDENTIALS") or environment.get("GOOGLE_SERVICE_ACCOUNT")
        return service, "", f"the file {file}" if file else "the login of gcloud, or the account of this machine"
    if url.scheme == "az":
        name = environment.get("AZURE_STORAGE_ACCOUNT_NAME")
        has_key = any(
            f"AZURE_STORAGE_{kind}" in environment for kind in ("ACCOUNT_KEY", "ACCESS_KEY", "SAS_KEY", "SAS_TOKEN")
        )
        server = f"{service}, account {name}" if name else f"{service}, no account (AZURE_STORAGE_ACCOUNT_NAME)"
        return server, "", "the environment" if has_key else "the identity of this machine"
    config = _of_profile(environment)
    server = endpoint() or config.get("endpoint", "")
    named = environment.get("AWS_REGION") or environment.get("AWS_DEFAULT_REGION") or config.get("region")
    if environment.get("AWS_SKIP_SIGNATURE", "").lower() in ("true", "1"):
        keys = "none (AWS_SKIP_SIGNATURE)"
    elif "AWS_ACCESS_KEY_ID" in environment:
        keys = "the environment"
    elif "access_key_id" in config:
        keys = f"the profile {_profile(environment)} of AWS"
    else:
        keys = "the role of this machine or container"
    return hide_secrets(server) if server else service, named or "us-east-1 (assumed; AWS_REGION names another)", keys


def _profile(environment: Mapping[str, str]) -> str:
    return environment.get("AWS_PROFILE") or environment.get("AWS_DEFAULT_PROFILE") or "default"


def endpoint() -> str:
    """The address that the environment gives for S3; "" if it gives none."""
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""


# Errors of stores as messages: in one line, with the URL, and without secrets.


#: Words in the answers of stores, and what they mean.
_MEANINGS: Final = (
    (("NoSuchBucket", "ContainerNotFound"), "there is no such bucket"),
    (("ExpiredToken", "token has expired", "ExpiredAuthenticationToken"), "the credentials have expired; renew them"),
    (
        ("InvalidAccessKeyId", "SignatureDoesNotMatch", "AuthenticationFailed"),
        "the store does not know the credentials",
    ),
    (("Account must be specified",), "no account is named; set AZURE_STORAGE_ACCOUNT_NAME"),
    (("SlowDown", "status code: 503", "status code: 429"), "the store answers that it is overloaded"),
    (
        ("PermanentRedirect", "status code: 301", "AuthorizationHeader"),
        "the bucket is in another region; set AWS_REGION",
    ),
)
FORBIDDEN: Final = "the store refuses it to these credentials (forbidden)"
_ARROW: Final = re.compile(r"\s*\x1b\[[0-9;]*m↳\x1b\[[0-9;]*m")
_COLOUR: Final = re.compile(r"\x1b\[[0-9;]*m")
#: Hosts that give machines in a cloud their credentials, if nothing else does.
_MACHINE_HOSTS: Final = ("169.254.169.254", "169.254.170.2", "metadata.google.internal")


def overtaken(url: Url) -> McaptrackError:
    """The error for an object that was written since it was opened, and is not overwritten."""
    return McaptrackError(f"{url} was written by another process meanwhile, and is left as it is now; try again")


@contextmanager
def reporting_faults(url: Url, done: str = "read") -> Iterator[None]:
    """Turn errors of the store into a McaptrackError that names the URL."""
    exceptions = library(url).exceptions
    try:
        yield
    except FileNotFoundError as error:
        if meaning := meaning_of(url, error):
            raise McaptrackError(f"{url} can't be {done}: {meaning}") from None
        raise AbsentError(f"{url} can't be {done}: there is no such object") from None
    except exceptions.PreconditionError:
        raise replaced(url) from None
    except exceptions.PermissionDeniedError as error:
        why = meaning_of(url, error) or f"{FORBIDDEN}{_absent_hint(url) if done == 'read' else ''}"
        raise McaptrackError(f"{url} can't be {done}: {why}") from None
    except exceptions.UnauthenticatedError as error:
        why = meaning_of(url, error) or "the store asks for other credentials"
        raise McaptrackError(f"{url} can't be {done}: {why}{_credentials_hint(url)}") from None
    except (exceptions.BaseError, ValueError, OSError) as error:
        raise McaptrackError(f"{url} can't be {done}: {reason(url, error)}") from None


def plain(message: str) -> str:
    """A message of a library without the colours and arrows that some print even where no terminal is."""
    return _COLOUR.sub("", _ARROW.sub(":", message))


def meaning_of(url: Url, error: Exception) -> str:
    """The meaning of a store's answer; "" if it is not known."""
    said = _text_of(url, error)
    return next((meaning for phrases, meaning in _MEANINGS if any(word in said for word in phrases)), "")


def _text_of(url: Url, error: Exception) -> str:
    """An error of the library in one line, without the name of the object and the settings that it was asked with."""
    said = " ".join(plain(str(error)).partition("Debug source")[0].split()).replace("retry_timeout", "")  # a setting
    return said.replace(url.key, "") if url.key else said


def reason(url: Url, error: Exception) -> str:
    """The reason of an error of a store, in a few words."""
    said = _text_of(url, error)
    if any(host in said for host in _MACHINE_HOSTS):
        return f"no credentials are found{_credentials_hint(url)}"
    if meaning := meaning_of(url, error):
        return meaning
    if any(phrase in said for phrase in ("dns error", "error trying to connect", "Connect", "sending request")):
        where = hide_secrets(endpoint()) if url.scheme == "s3" and endpoint() else ""
        return f"the store can't be reached{f' at {where}' if where else ''}"
    if breaks_off(error):
        return "the answer of the store breaks off"
    if "status code: 403" in said:
        return f"{FORBIDDEN}{_absent_hint(url)}"
    if any(phrase in said for phrase in ("timed out", "TimedOut", "timeout")):
        return "the store does not answer in time"
    status = re.search(r"status code: (\d\d\d [A-Za-z ]+)", said)
    if status and status[1].startswith("400"):  # to a request for the head of an object, S3 can't say why
        return f"the store answers {status[1].strip()}; the credentials may have expired"
    return f"the store answers {status[1].strip()}" if status else said[:200]


def _absent_hint(url: Url) -> str:
    """For results, which may be absent: S3 tells only those who may list the bucket."""
    is_hidden = url.scheme == "s3" and ".results." in url.name
    return "; it may be absent, which S3 tells only to those with s3:ListBucket" if is_hidden else ""


def _credentials_hint(url: Url) -> str:
    names = {
        "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE; AWS_SKIP_SIGNATURE=true if it is public",
        "gs": "GOOGLE_APPLICATION_CREDENTIALS",
        "az": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
    }
    return f"; set {names[url.scheme]}"


def breaks_off(error: Exception) -> bool:
    """Whether an answer arrived in part only."""
    return "body error" in str(error)


def read_end(url: Url, size: int) -> tuple[Version, bytes]:
    """The present version of an object, and its last ``size`` bytes; in one request where the store can.

    Raises McaptrackError if there is no such object, or if it can't be read.
    """
    obstore = library(url)
    with reporting_faults(url):
        try:
            return _get(obstore, url, {"range": {"suffix": size}})
        except obstore.exceptions.BaseError as error:
            # Azure knows no ranges of this kind, and an empty object has none.
            is_range = any(fault in str(error) for fault in ("416", "non-partial"))
            if not is_range and not isinstance(error, obstore.exceptions.NotSupportedError):
                raise
            version = _version(obstore.head(store_of(url), url.key))
    start = max(version.size - size, 0)
    return version, read_ranges(url, version, [(start, version.size)])[0] if version.size else b""


def read_ranges(url: Url, version: Version, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Bytes from start to end of a version of an object, for each range; long ranges in several requests at once.

    Raises McaptrackError if the object has been replaced, or can't be read.
    """
    pieces = [(at, min(at + _MAX_BYTES, end)) for start, end in ranges for at in range(start, end, _MAX_BYTES)]
    if len(pieces) <= 1:
        parts = [_read(url, version, *piece) for piece in pieces]
    else:
        with ThreadPoolExecutor(min(_AT_ONCE, len(pieces))) as threads:
            parts = list(threads.map(lambda piece: _read(url, version, *piece), pieces))
    waiting = iter(parts)
    return [b"".join(next(waiting) for _ in range(start, end, _MAX_BYTES)) for start, end in ranges]


def _read(url: Url, version: Version, start: int, end: int) -> bytes:
    options: dict[str, Any] = {"range": (start, end)} | ({"if_match": version.etag} if version.etag else {})
    with reporting_faults(url):
        present, data = _get(library(url), url, options)
    if present != version:
        raise replaced(url)
    if len(data) != end - start:
        raise McaptrackError(f"{url} can't be read: the store gives {len(data)} bytes of {end - start}")
    return data


def _get(obstore: Any, url: Url, options: Mapping[str, Any]) -> tuple[Version, bytes]:
    """The version of an object, and a part of it. An answer that breaks off is asked for again."""
    for left in reversed(range(_TRIES)):
        try:
            response = obstore.get(store_of(url), url.key, options=options)
            return _version(response.meta), bytes(response.bytes())
        except obstore.exceptions.GenericError as error:
            if not left or not breaks_off(error):
                raise
    raise AssertionError("the last attempt gives an answer or fails")


def find(url: Url) -> Version | None:
    """The present version of an object; None if there is none.

    Raises McaptrackError if the store can't tell.
    """
    with suppress(AbsentError), reporting_faults(url):
        return _version(library(url).head(store_of(url), url.key))
    return None


def replace(url: Url, file: Path, before: Version | None) -> Version:
    """Write a file as an object, in place of the version ``before``; None for a new object.

    The object is complete when it appears. A large one is sent in parts. Afterwards it is read back and compared.

    Raises McaptrackError if there is another version by now, or if the object can't be written.
    """
    obstore = library(url)
    size = file.stat().st_size
    with reporting_faults(url, "written"):
        try:
            if size <= _PART_BYTES:
                mode: Any = {"e_tag": before.etag} if before else "create"
                answer = obstore.put(store_of(url), url.key, file.read_bytes(), mode=mode, use_multipart=False)
            else:
                if find(url) != before:
                    raise overtaken(url)
                answer = obstore.put(store_of(url), url.key, file, chunk_size=_PART_BYTES, max_concurrency=4)
            version = Version(size, answer["e_tag"])
        except (obstore.exceptions.PreconditionError, obstore.exceptions.AlreadyExistsError):
            present = find(url)  # it may be this one, if the answer to the first attempt was lost
            if present is None or present.size != size or not _holds(url, present, file):
                raise overtaken(url) from None
            return present
    if not _holds(url, version, file):
        raise McaptrackError(f"{url} does not hold what was written to it; the results are not safe there")
    return version


def _holds(url: Url, version: Version, file: Path) -> bool:
    """Whether an object has the bytes of a file."""
    theirs = ours = 0
    with file.open("rb") as stream:
        for start in range(0, version.size, 4 * _MAX_BYTES):
            data = read_ranges(url, version, [(start, min(start + 4 * _MAX_BYTES, version.size))])[0]
            theirs, ours = zlib.crc32(data, theirs), zlib.crc32(stream.read(len(data)), ours)
        return theirs == ours and not stream.read(1)


def put_if_unchanged(url: Url, data: bytes, before: Version | None) -> Version | None:
    """Write a small object if the store still has the version ``before``; None stands for no object.

    Returns the version that was written; None if there is another one. Of two processes, one succeeds. ``data`` has to
    differ between processes: if the store has it, it is taken for what was written here, because the answer to a
    request may be lost.
    """
    obstore = library(url)
    mode: Any = {"e_tag": before.etag} if before else "create"
    is_other = suppress(obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError)
    with suppress(AbsentError), reporting_faults(url, "written"), is_other:
        answer = obstore.put(store_of(url), url.key, data, mode=mode, use_multipart=False)
        return Version(len(data), answer["e_tag"])
    try:
        present, content = read_end(url, max(len(data), 1) + 1)
    except AbsentError:
        return None
    return present if content == data else None


def delete(url: Url) -> None:
    """Remove an object; one that isn't there is no fault."""
    with suppress(AbsentError), reporting_faults(url, "removed"):
        library(url).delete(store_of(url), url.key)


def list_objects(prefix: Url) -> Iterator[tuple[Url, Version]]:
    """The objects below a prefix of whole parts ("s3://bucket/night": those in it, not "s3://bucket/nights/a").

    They come in the order of the store, which is alphabetical in most.
    """
    with reporting_faults(prefix):
        root = Url(f"{prefix.scheme}://{prefix.bucket}")
        for page in library(prefix).list(store_of(prefix), prefix=prefix.key.strip("/") or None):
            yield from ((root / listed["path"], _version(listed)) for listed in page)


def _version(meta: Any) -> Version:
    return Version(meta["size"], meta["e_tag"])


def why_absent(url: Url) -> str:
    """The reason that there is no object of this name: it may be a bucket, or a prefix of others."""
    if not url.key.strip("/"):
        return f"it is a bucket; name the logs in it, as in {url.rstrip('/')}/*.mcap"
    try:
        inside = next(list_objects(url), None)
    except McaptrackError:
        inside = None
    if inside:
        return (
            f"it is no object but a prefix, of {inside[0]} and maybe others; name logs, as in {url.rstrip('/')}/*.mcap"
        )
    return "there is no such object"


# A bucket or a prefix is tried with a small hidden object, which is removed again.

_REASON: Final = re.compile(r"^.*? can't be (?:read|written|removed): ")


def check_store(url: Url) -> StoreCheck:
    """Try the operations of a run on a store."""
    server, region, credentials = described(url)
    return StoreCheck(str(url), server, region, credentials, dict(_tries(url)))


def _tries(url: Url) -> Iterator[tuple[str, str]]:
    """Yield each operation, and why it failed; "" if it didn't."""
    listed: list[Url] = []
    yield "list", _why(lambda: listed.extend(member for member, _ in islice(list_objects(url), 1)))
    probe = url / f".mcaptrack-doctor-{uuid4().hex}"
    texts = [f"{number} {uuid4().hex}".encode() for number in range(4)]
    versions: list[Version | None] = []
    why = _why(lambda: versions.append(put_if_unchanged(probe, texts[0], None)))
    yield "write", why
    if why or versions[0] is None:
        if listed:
            yield "read", _why(lambda: read_end(listed[0], 1))
        return
    first = versions[0]
    try:
        yield "read", _why(lambda: _compare(probe, first, texts[0]))
        yield "put-if-absent", _why(lambda: _refuse(put_if_unchanged(probe, texts[1], None)))
        yield "replace", _why(lambda: _replace(probe, first, texts))
    finally:
        why = _why(lambda: delete(probe))
    yield "delete", why


def _why(attempt: Callable[[], object]) -> str:
    """Do something, and return why it failed; "" if it didn't."""
    try:
        attempt()
    except McaptrackError as error:
        return _REASON.sub("", str(error))
    return ""


def _compare(url: Url, version: Version, text: bytes) -> None:
    if read_ranges(url, version, [(0, len(text))]) != [text]:
        raise McaptrackError("the store gives other bytes than were written")


def _refuse(written: Version | None) -> None:
    if written is not None:
        raise McaptrackError("the store overwrites an object although it was asked not to")


def _replace(url: Url, first: Version, texts: list[bytes]) -> None:
    with suppress(McaptrackError):  # a store that overwrote it has another version now
        first = find(url) or first
    second = put_if_unchanged(url, texts[2], first)
    if second is None:
        raise McaptrackError("the store does not replace an object that is unchanged")
    _refuse(put_if_unchanged(url, texts[3], first))
