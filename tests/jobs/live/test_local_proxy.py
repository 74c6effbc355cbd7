"""The proxy in front of Meshcat, by plain sockets: what browsers send, and what comes back."""

import contextlib
import socket
import time
from pathlib import Path

import pytest

from drake_pose.jobs.live.local_proxy import open_page, refuse

UPGRADE = (
    "Connection: keep-alive, Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)
SOCKETS = Path("/proc/net/tcp")
ACCEPT = b"s3pPLMBiTxaQ9kYGzzhZRbK+xOo="
"""What RFC 6455, section 1.3, says the answer to this key is."""


@pytest.fixture(scope="module")
def page():
    return open_page()


def port_of(page):
    return int(page.web_url().rpartition(":")[2])


@contextlib.contextmanager
def connection(page):
    with socket.create_connection(("127.0.0.1", port_of(page)), timeout=10.0) as opened:
        yield opened


def head_of(page, host, origin=None, more=""):
    lines = f"GET / HTTP/1.1\r\nHost: {host.format(port_of(page))}\r\n"
    if origin is not None:
        lines += f"Origin: {origin.format(port_of(page))}\r\n"
    return (lines + more + "\r\n").encode()


def answer(opened):
    """Status line and headers, and what follows them."""
    data = b""
    while b"\r\n\r\n" not in data:
        chunk = opened.recv(65536)
        assert chunk, "closed before the head had ended"
        data += chunk
    head, _, rest = data.partition(b"\r\n\r\n")
    return head, rest


def wait_for_connections(page, count):
    end = time.monotonic() + 10.0
    while page.GetNumActiveConnections() != count and time.monotonic() < end:
        time.sleep(0.01)
    assert page.GetNumActiveConnections() == count


@pytest.mark.parametrize("name", ["localhost:{}", "127.0.0.1:{}", "LocalHost:{}"])
def test_the_page_itself_is_served_and_gets_the_motion(page, name):
    with connection(page) as opened:
        opened.sendall(head_of(page, name, f"http://{name}", UPGRADE))
        head, data = answer(opened)
        assert head.startswith(b"HTTP/1.1 101 ")
        assert ACCEPT in head
        wait_for_connections(page, 1)
        # A word that is in no message before it.
        page.Delete("secret_of_the_walker")
        while b"secret_of_the_walker" not in data:
            data += opened.recv(65536)
    wait_for_connections(page, 0)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("localhost:{}", "http://elsewhere.example"),
        ("localhost:{}", "https://localhost:{}"),
        ("localhost:{}", "http://localhost:3000"),
        ("localhost:{}", "null"),
        # The name of a page whose owner has it resolve to this machine.
        ("elsewhere.example:{}", "http://elsewhere.example:{}"),
        ("elsewhere.example", None),
        ("localhost:1", None),
    ],
)
@pytest.mark.parametrize("more", ["", UPGRADE])
def test_other_pages_are_refused(page, host, origin, more):
    with connection(page) as opened:
        opened.sendall(head_of(page, host, origin, more))
        head, text = answer(opened)
        assert head.startswith(b"HTTP/1.1 403 ")
        while chunk := opened.recv(65536):
            text += chunk
    assert page.web_url().encode() in text
    assert page.GetNumActiveConnections() == 0


def test_every_request_of_a_connection_is_looked_at(page):
    with connection(page) as opened:
        for _ in range(2):
            opened.sendall(head_of(page, "localhost:{}"))
            head, body = answer(opened)
            assert head.startswith(b"HTTP/1.1 200 ")
            length = int(head.lower().partition(b"content-length:")[2].split()[0])
            while len(body) < length:
                body += opened.recv(65536)
            assert b"meshcat" in body.lower()
        opened.sendall(head_of(page, "localhost:{}", "http://elsewhere.example", UPGRADE))
        assert answer(opened)[0].startswith(b"HTTP/1.1 403 ")


@pytest.mark.parametrize(
    ("hosts", "origins"),
    [
        ([], []),
        (["localhost:7000", "a.example"], []),
        (["localhost:7000"], ["http://localhost:7000", "http://a.example"]),
        (["localhost:7000"], ["http://localhost:7000.a.example"]),
    ],
)
def test_heads_of_no_page_are_refused(hosts, origins):
    assert refuse(hosts, origins, 7000) is not None
    assert refuse(["localhost:7000"], [], 7000) is None


def test_what_is_no_http_is_refused(page):
    with connection(page) as opened:
        opened.sendall(b"\x16\x03\x01\x02\x00\r\n\r\n")
        assert answer(opened)[0].startswith(b"HTTP/1.0 400 ")


@pytest.mark.skipif(not SOCKETS.is_file(), reason="the system lists no sockets")
def test_meshcat_itself_is_at_an_address_that_cannot_be_guessed():
    pages = [open_page(), open_page()]
    places = [
        line.split()[1].split(":")
        for line in SOCKETS.read_text(encoding="ascii").splitlines()[1:]
        if line.split()[3] == "0A"
    ]
    hosts = [place[0] for page in pages for place in places if int(place[1], 16) == page.port()]
    assert len(hosts) == 2
    assert len(set(hosts)) == 2
    for host in hosts:
        # Little-endian: the last byte is the address's first.
        assert host.endswith("7F")
        assert host != "0100007F"


def test_a_page_that_is_gone_ends_its_connections_and_frees_its_port(capfd):
    page = open_page()
    port = port_of(page)
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as opened:
        opened.sendall(head_of(page, "localhost:{}", "http://localhost:{}", UPGRADE))
        answer(opened)
        del page
        while opened.recv(65536):
            pass
    with socket.create_server(("127.0.0.1", port)):
        pass
    assert capfd.readouterr().err == ""
