"""A store at s3:// for the tests: moto's server, with its requests counted and with faults on request."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import boto3
import pytest
from moto.server import ThreadedMotoServer

BUCKET = "bucket"
#: Answers instead of that of the store: the status, and the code in the body.
ANSWERS = {
    "error": ("503 Slow Down", ""),
    "denied": ("403 Forbidden", "AccessDenied"),
    "expired": ("400 Bad Request", "ExpiredToken"),
}


class Request(NamedTuple):
    """A request: its method, key, query and range, the id of the key that signed it, and the answer."""

    method: str
    key: str
    query: str
    range: str
    key_id: str
    status: int
    bytes: int


class Store:
    """The server. ``fault`` says for a request how it fails: one of ``ANSWERS``, "slow", "cut", "lost"; "" for not at all."""

    def __init__(self) -> None:
        logging.getLogger("werkzeug").setLevel(logging.CRITICAL)
        self._server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        self._server.start()
        host, port = self._server.get_host_and_port()
        self.endpoint = f"http://{host}:{port}"
        self.environment = {
            "AWS_ENDPOINT_URL": self.endpoint, "AWS_ACCESS_KEY_ID": "key-of-the-tests",
            "AWS_SECRET_ACCESS_KEY": "secret-of-the-tests", "AWS_REGION": "us-east-1",
            "AWS_SHARED_CREDENTIALS_FILE": "/nowhere", "AWS_CONFIG_FILE": "/nowhere",
        }  # fmt: skip
        self.client: Any = boto3.client(
            "s3", endpoint_url=self.endpoint, region_name="us-east-1", aws_access_key_id="a",
            aws_secret_access_key="b",
        )  # fmt: skip
        self.client.create_bucket(Bucket=BUCKET)
        self.requests: list[Request] = []
        self.fault: Callable[[Request], str] = lambda _: ""
        inner: Any = self._server._server
        self._app, inner.app = inner.app, self._answer

    def put(self, key: str, content: bytes | Path) -> str:
        data = content.read_bytes() if isinstance(content, Path) else content
        self.client.put_object(Bucket=BUCKET, Key=key, Body=data)
        return f"s3://{BUCKET}/{key}"

    def get(self, key: str) -> bytes:
        data: bytes = self.client.get_object(Bucket=BUCKET, Key=key)["Body"].read()
        return data

    def names(self) -> list[str]:
        return [found["Key"] for found in self.client.list_objects_v2(Bucket=BUCKET).get("Contents", [])]

    def clear(self) -> None:
        for key in self.names():
            self.client.delete_object(Bucket=BUCKET, Key=key)

    def stop(self) -> None:
        self._server.stop()

    @contextmanager
    def failing(self, fault: Callable[[Request], str]) -> Iterator[None]:
        """Let requests fail within the block."""
        self.fault = fault
        try:
            yield
        finally:
            self.fault = lambda _: ""

    @contextmanager
    def counted(self) -> Iterator[list[Request]]:
        start = len(self.requests)
        found: list[Request] = []
        yield found
        found += self.requests[start:]

    def _answer(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        key = environ["PATH_INFO"].removeprefix(f"/{BUCKET}").removeprefix("/")
        key_id = environ.get("HTTP_AUTHORIZATION", "").partition("Credential=")[2].partition("/")[0]
        asked = Request(
            environ["REQUEST_METHOD"], key, environ["QUERY_STRING"], environ.get("HTTP_RANGE", ""), key_id, 0, 0
        )
        fault = self.fault(asked)
        if fault in ANSWERS:
            status, code = ANSWERS[fault]
            body = f"<Error><Code>{code}</Code><Message>no</Message></Error>".encode() if code else b""
            self.requests.append(asked._replace(status=int(status.split()[0])))
            start_response(status, [("Content-Length", str(len(body))), ("Content-Type", "application/xml")])
            return [body]
        if fault == "slow":
            time.sleep(0.2)
        said: list[Any] = []
        body = b"".join(self._app(environ, lambda status, headers, *_: said.append((status, headers))))
        status, headers = said[-1]
        self.requests.append(asked._replace(status=int(status.split()[0]), bytes=len(body)))
        if fault == "lost":  # the store has done it, and its answer does not arrive
            start_response("500 Internal Server Error", [("Content-Length", "0")])
            return []
        start_response(status, headers)
        return [body[: len(body) // 2]] if fault == "cut" else [body]


def only_in(patch: pytest.MonkeyPatch, store: Store) -> None:
    """Let programs find this store, and no other."""
    for name, value in store.environment.items():
        patch.setenv(name, value)
