"""The stores that URLs name, with credentials, region and endpoint as the environment or a profile gives them."""

from __future__ import annotations

import configparser
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
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

    env = dict(settings)
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


class AbsentError(McaptrackError):
    """There is no such object."""


def replaced(url: Url) -> McaptrackError:
    """The error for an object that has another version now than when it was opened."""
    return McaptrackError(f"{url} was replaced by another version while it was being read; try again")


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
