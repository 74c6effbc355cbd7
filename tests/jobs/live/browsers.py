"""What a browser asks of a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from http.client import HTTPConnection, HTTPResponse

UPGRADE = {
    "Connection": "keep-alive, Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}
ACCEPT = "s3pPLMBiTxaQ9kYGzzhZRbK+xOo="
"""What RFC 6455, section 1.3, says the answer to this key is."""


@contextmanager
def connected(url: str) -> Iterator[HTTPConnection]:
    """A connection to a page, by the loopback address."""
    with closing(HTTPConnection("127.0.0.1", int(url.rpartition(":")[2]), timeout=10.0)) as opened:
        opened.connect()
        yield opened


def ask(
    opened: HTTPConnection,
    host: str = "localhost:{}",
    origin: str | None = None,
    more: Mapping[str, str] = {},
) -> HTTPResponse:
    """The answer to a request under a name, of a page of an origin; {}: the page's port."""
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin}) | dict(more)
    opened.putrequest("GET", "/", skip_host=True, skip_accept_encoding=True)
    for name, value in headers.items():
        opened.putheader(name, value.format(opened.port))
    opened.endheaders()
    return opened.getresponse()
