"""The stores that URLs name, with credentials, region and endpoint as the environment or a profile gives them."""

from __future__ import annotations

import configparser
import os
from collections.abc import Mapping
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.location import SCHEMES, Url, hide_secrets

#: A request that fails is sent again so often, and within so many seconds; one without an answer fails after a while.
_RETRIES, _PATIENCE_S, _CONNECT_S, _READ_S, _REQUEST_S = 9, 60, 5, 20, 300
#: The first and the longest pause. Each is up to so many times as long as the one before; with 2 all nine would take
#: less than three seconds.
_FIRST, _LONGEST = timedelta(milliseconds=100), timedelta(seconds=5)
_GROWTH: Final = 3


def library(url: Url) -> Any:
    """The library, if it is installed."""
    try:
        import obstore
        import obstore.exceptions
    except ImportError:
        raise McaptrackError(
            f"{url} is in {SCHEMES[url.scheme]}, which needs obstore, and that is not installed; install it with: "
            'pip install "mcaptrack[cloud]"'
        ) from None
    return obstore


def store_of(url: Url) -> Any:
    """The store of a bucket."""
    names = ("AWS_", "AZURE_", "GOOGLE_")
    settings = tuple(sorted((name, value) for name, value in os.environ.items() if name.startswith(names)))
    return _made_store(url.scheme, url.bucket, settings)


@lru_cache(32)
def _made_store(scheme: str, bucket: str, settings: tuple[tuple[str, str], ...]) -> Any:
    from obstore.store import AzureStore, GCSStore, S3Store

    given = dict(settings)
    common: dict[str, Any] = {
        "client_options": {
            "connect_timeout": timedelta(seconds=_CONNECT_S),
            "read_timeout": timedelta(seconds=_READ_S),
            "timeout": timedelta(seconds=_REQUEST_S),
        },
        "retry_config": {
            "max_retries": _RETRIES,
            "backoff": {"init_backoff": _FIRST, "max_backoff": _LONGEST, "base": _GROWTH},
            "retry_timeout": timedelta(seconds=_PATIENCE_S),
        },
    }
    if scheme == "gs":
        return GCSStore(bucket, **common)
    if scheme == "az":
        return AzureStore(bucket, **common)
    config: Any = _of_profile(given)
    if endpoint := given.get("AWS_ENDPOINT_URL_S3") or given.get("AWS_ENDPOINT_URL") or config.get("endpoint"):
        config["endpoint"] = endpoint
        common["client_options"]["allow_http"] = endpoint.startswith("http://")
    if not given.get("AWS_REGION") and given.get("AWS_DEFAULT_REGION"):
        config["region"] = given["AWS_DEFAULT_REGION"]
    return S3Store(bucket, config=config, **common)


def _of_profile(given: Mapping[str, str]) -> dict[str, str]:
    """The settings in the profile of AWS that the environment does not have.

    Raises McaptrackError if AWS_PROFILE names a profile that has no keys.
    """
    home = Path.home() / ".aws"
    name = _profile(given)
    files = (
        (given.get("AWS_CONFIG_FILE") or home / "config", name if name == "default" else f"profile {name}"),
        (given.get("AWS_SHARED_CREDENTIALS_FILE") or home / "credentials", name),
    )
    found: dict[str, str] = {}
    for path, section in files:
        reader = configparser.RawConfigParser()
        try:
            reader.read(path, encoding="utf-8")
        except (configparser.Error, UnicodeDecodeError, OSError):
            raise McaptrackError(f"{path} can't be read as settings of AWS") from None
        found |= dict(reader[section]) if section in reader else {}
    has_keys = {"aws_access_key_id", "aws_secret_access_key"} <= found.keys()
    if given.get("AWS_PROFILE") and not has_keys and "AWS_ACCESS_KEY_ID" not in given:
        raise McaptrackError(
            f"the profile {name} of AWS (AWS_PROFILE) has no aws_access_key_id and aws_secret_access_key; "
            "`aws configure export-credentials` prints those of a profile of another kind, for the environment"
        )
    settings = {"region": found.get("region"), "endpoint": found.get("endpoint_url")}
    if "AWS_ACCESS_KEY_ID" not in given and has_keys:
        settings |= {
            "access_key_id": found["aws_access_key_id"],
            "secret_access_key": found["aws_secret_access_key"],
            "session_token": found.get("aws_session_token"),
        }
    return {name: value for name, value in settings.items() if value and f"AWS_{name.upper()}" not in given}


def described(url: Url) -> tuple[str, str, str]:
    """The server of a store, its region ("" where there are none), and where the credentials come from.

    Raises McaptrackError if the settings of AWS can't be read.
    """
    given, service = os.environ, SCHEMES[url.scheme]
    if url.scheme == "gs":
        file = given.get("GOOGLE_APPLICATION_CREDENTIALS") or given.get("GOOGLE_SERVICE_ACCOUNT")
        return service, "", f"the file {file}" if file else "the login of gcloud, or the account of this machine"
    if url.scheme == "az":
        name = given.get("AZURE_STORAGE_ACCOUNT_NAME")
        has_key = any(
            f"AZURE_STORAGE_{kind}" in given for kind in ("ACCOUNT_KEY", "ACCESS_KEY", "SAS_KEY", "SAS_TOKEN")
        )
        server = f"{service}, account {name}" if name else f"{service}, no account (AZURE_STORAGE_ACCOUNT_NAME)"
        return server, "", "the environment" if has_key else "the identity of this machine"
    config = _of_profile(given)
    server = endpoint() or config.get("endpoint", "")
    named = given.get("AWS_REGION") or given.get("AWS_DEFAULT_REGION") or config.get("region")
    if given.get("AWS_SKIP_SIGNATURE", "").lower() in ("true", "1"):
        keys = "none (AWS_SKIP_SIGNATURE)"
    elif "AWS_ACCESS_KEY_ID" in given:
        keys = "the environment"
    elif "access_key_id" in config:
        keys = f"the profile {_profile(given)} of AWS"
    else:
        keys = "the role of this machine or container"
    return hide_secrets(server) if server else service, named or "us-east-1 (assumed; AWS_REGION names another)", keys


def _profile(given: Mapping[str, str]) -> str:
    return given.get("AWS_PROFILE") or given.get("AWS_DEFAULT_PROFILE") or "default"


def endpoint() -> str:
    """The address that the environment gives for S3; "" if it gives none."""
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
