"""List the detectors of the catalogue, and fetch their weights."""

from __future__ import annotations

import hashlib
import logging
import os
import re
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

from mcaptrack.api.declared import Argument, declared, done_by
from mcaptrack.api.options import PathLike
from mcaptrack.errors import McaptrackError, call, needing
from mcaptrack.extensions.networks import catalogue
from mcaptrack.extensions.networks.catalogue import Model
from mcaptrack.extensions.networks.network import digest_of, providers
from mcaptrack.files import make_folder, publish_bytes, reading, refuse_special
from mcaptrack.notices import warn

#: How long to wait for a connection, and for the next bytes, in seconds.
_WAIT_S = (10, 60)
#: A server that gives less is given up after so many seconds.
_LEAST_BYTES_PER_S, _PATIENCE_S = 2000, 60
_CHUNK = 4096


@declared(printed_by="mcaptrack.extensions.networks.command:Models")
def models(
    name: Annotated[
        str | None, Argument("words", "get NAME", "`get` fetches the weights of NAME.", shown="a list", words=True)
    ] = None,
) -> tuple[Model, ...]:
    """List the learned detectors, or fetch the weights of one.

    Only a file with the known SHA-256 is taken. The weights are kept in your folder of caches, or where the environment
    variable MCAPTRACK_MODELS says.

    Parameters
    ----------
    name : str, optional
        List this one only.

    Returns
    -------
    tuple of Model
        With licence, size, origin and what each is good for.

    Raises
    ------
    McaptrackError
        If there is none of that name.

    Examples
    --------
    On the command line:

        mcaptrack models

        mcaptrack models get yolox-nano

    >>> import mcaptrack
    >>> [model.name for model in mcaptrack.models()]
    ['yolox-nano', 'yolox-tiny', 'yolox-s']
    """
    return (catalogue.find(name),) if name else tuple(catalogue.CATALOGUE.values())


@done_by("models", "get")
def get_model(name: str, *, source: PathLike | None = None) -> Path:
    """Fetch the weights of a detector of the catalogue, once, into the user's folder of caches.

    Only a file with the known digest is taken. The environment variable ``MCAPTRACK_MODELS`` names another folder.

    Parameters
    ----------
    name : str
        Name of the model, as `models` lists it.
    source : path or str, optional
        Take the weights from this file, or from this http(s) address, instead of the known ones.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    McaptrackError
        If there is no such model, or if its file can't be fetched or is another one.

    Examples
    --------
    >>> import mcaptrack
    >>> try:
    ...     mcaptrack.get_model("yolox-nano", source="log.mcap")
    ... except mcaptrack.McaptrackError as error:
    ...     print(str(error)[:38])
    log.mcap is not the file of yolox-nano
    """
    model = catalogue.find(name)
    text = "" if source is None else str(source)
    if text and not text.startswith(("http://", "https://")):
        data = _read(model, Path(text))
        make_folder(model.path.parent)
        publish_bytes(model.path, data)
        return model.path
    if not text and model.path.is_file():
        if digest_of(model.path) == model.sha256:
            return model.path
        warn(f"{model.path} is damaged, or another file; it is fetched again", "other")
    make_folder(model.path.parent)
    failures = []
    for url in (text,) if text else model.urls:
        try:
            return _fetch(model, url)
        except McaptrackError as error:
            failures.append(str(error))
    by_hand = call("get_model", name, source="FILE")
    raise McaptrackError(
        f"{name} can't be fetched: {'; '.join(failures)}. Get its file from {model.source} on another machine, and "
        f"hand it over with {by_hand}"
    )


def _read(model: Model, path: Path) -> bytes:
    """Return the bytes of a file of the user; no more are read than the model has.

    Raises McaptrackError if it can't be read, or is not the model's.
    """
    refuse_special(path)
    with reading(path) as file:
        data, size = file.read(model.size_bytes + 1), path.stat().st_size
    catalogue.check(model, hashlib.sha256(data).hexdigest(), max(size, len(data)), path)
    return data


def _fetch(model: Model, url: str) -> Path:
    """Fetch a file that has to have the known digest. Raises McaptrackError if that fails."""
    with needing("fetching", "pooch", "onnx"):
        import pooch
        import requests

    def download(address: str, output: Any, _: Any) -> None:
        """Save what an address gives; refuse more bytes than the model has."""
        begin = monotonic()
        with requests.get(address, stream=True, timeout=_WAIT_S) as response, Path(output).open("wb") as file:
            response.raise_for_status()
            if response.headers.get("Content-Type", "").startswith("text/html"):
                raise McaptrackError(f"{url} gives a web page, not a file")
            for chunk in response.iter_content(_CHUNK):
                file.write(chunk)
                if file.tell() > model.size_bytes:
                    raise McaptrackError(f"{url} gives more than the {model.size_bytes:,} bytes of {model.name}")
                waited_s = monotonic() - begin
                if waited_s > _PATIENCE_S and file.tell() < waited_s * _LEAST_BYTES_PER_S:
                    raise McaptrackError(f"{url} gives {file.tell():,} bytes in {waited_s:.0f} s, which is too slow")
            if file.tell() < model.size_bytes:
                raise McaptrackError(f"{url} ends after {file.tell():,} of {model.size_bytes:,} bytes")

    pooch.get_logger().setLevel(logging.ERROR)
    digest = f"sha256:{model.sha256}"
    try:
        return Path(pooch.retrieve(url, digest, fname=model.path.name, path=model.path.parent, downloader=download))
    except requests.RequestException as error:
        raise McaptrackError(f"{url}: {_reason(error)}") from None
    except ValueError:  # of pooch: another digest
        raise McaptrackError(f"{url} gives another file than that of {model.name} (SHA-256)") from None
    except OSError as error:
        raise McaptrackError(f"{model.path} can't be written: {error.strerror or error}") from None


def _reason(error: Any) -> str:
    if error.response is not None:
        return f"HTTP status {error.response.status_code}"
    if "IncompleteRead" in str(error):
        return "the connection broke"
    why = re.search(r"\[Errno -?\d+\] ([\w ]+)", str(error))
    return why[1] if why else re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(error).__name__).lower()


def doctor_lines() -> dict[str, str]:
    """Return what networks can run on, and where weights are kept, for ``mcaptrack doctor``."""
    folder = catalogue.folder()
    existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    can = "" if existing.is_dir() and os.access(existing, os.W_OK | os.X_OK) else ", which can't be written"
    return {"ONNX Runtime": ", ".join(providers()) or "not installed", "fetched weights": f"{folder}{can}"}
