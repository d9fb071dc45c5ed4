"""Errors of stores as messages: in one line, with the URL, and without secrets."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Url, hide_secrets
from mcaptrack.objects.stores import endpoint, library

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


def plain(words: str) -> str:
    """A message of a library without the colours and arrows that some print even where no terminal is."""
    return _COLOUR.sub("", _ARROW.sub(":", words))


def meaning_of(url: Url, error: Exception) -> str:
    """The meaning of a store's answer; "" if it is not known."""
    said = _text_of(url, error)
    return next((meaning for words, meaning in _MEANINGS if any(word in said for word in words)), "")


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
    if any(words in said for words in ("dns error", "error trying to connect", "Connect", "sending request")):
        where = hide_secrets(endpoint()) if url.scheme == "s3" and endpoint() else ""
        return f"the store can't be reached{f' at {where}' if where else ''}"
    if breaks_off(error):
        return "the answer of the store breaks off"
    if "status code: 403" in said:
        return f"{FORBIDDEN}{_absent_hint(url)}"
    if any(words in said for words in ("timed out", "TimedOut", "timeout")):
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
