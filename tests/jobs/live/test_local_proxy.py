"""The proxy in front of Meshcat: what browsers send, and what comes back."""

import socket
import time
from pathlib import Path

import pytest

from drake_pose.jobs.live.local_proxy import open_page, refuse
from tests.jobs.live.browsers import ACCEPT, UPGRADE, ask, connected

SOCKETS = Path("/proc/net/tcp")


@pytest.fixture(scope="module")
def page():
    return open_page()


def wait_for_connections(page, count):
    end = time.monotonic() + 10.0
    while page.GetNumActiveConnections() != count and time.monotonic() < end:
        time.sleep(0.01)
    assert page.GetNumActiveConnections() == count


@pytest.mark.parametrize("name", ["localhost:{}", "127.0.0.1:{}", "LocalHost:{}"])
def test_the_page_itself_is_served_and_gets_the_motion(page, name):
    with connected(page.web_url()) as opened:
        answer = ask(opened, name, f"http://{name}", UPGRADE)
        assert answer.status == 101
        assert answer.getheader("Sec-WebSocket-Accept") == ACCEPT
        wait_for_connections(page, 1)
        # A word that is in no message before it.
        page.Delete("secret_of_the_walker")
        data = b""
        while b"secret_of_the_walker" not in data:
            data += answer.fp.read1(65536)
        answer.close()
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
@pytest.mark.parametrize("more", [{}, UPGRADE], ids=["page", "socket"])
def test_other_pages_are_refused(page, host, origin, more):
    with connected(page.web_url()) as opened:
        answer = ask(opened, host, origin, more)
        assert answer.status == 403
        assert page.web_url() in answer.read().decode()
    assert page.GetNumActiveConnections() == 0


def test_every_request_of_a_connection_is_looked_at(page):
    with connected(page.web_url()) as opened:
        for _ in range(2):
            answer = ask(opened)
            assert answer.status == 200
            assert b"meshcat" in answer.read().lower()
        assert ask(opened, "localhost:{}", "http://elsewhere.example", UPGRADE).status == 403


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
    with connected(page.web_url()) as opened:
        opened.sock.sendall(b"\x16\x03\x01\x02\x00\r\n\r\n")
        assert opened.sock.recv(65536).startswith(b"HTTP/1.0 400 ")


@pytest.mark.skipif(not SOCKETS.is_file(), reason="the system lists no sockets")
def test_meshcat_itself_is_at_an_address_that_cannot_be_guessed():
    pages = [open_page(), open_page()]
    lines = [line.split() for line in SOCKETS.read_text(encoding="ascii").splitlines()[1:]]
    listening = {int(line[1][-4:], 16): line[1][:8] for line in lines if line[3] == "0A"}
    hosts = {listening[page.port()] for page in pages}
    # Little-endian: the last byte is the address's first.
    assert len(hosts - {"0100007F"}) == 2
    assert {host[-2:] for host in hosts} == {"7F"}


def test_a_page_that_is_gone_ends_its_connections_and_frees_its_port(capfd):
    page = open_page()
    with connected(page.web_url()) as opened:
        answer = ask(opened, "localhost:{}", "http://localhost:{}", UPGRADE)
        del page
        while answer.fp.read1(65536):
            pass
        port = opened.port
    with socket.create_server(("127.0.0.1", port)):
        pass
    assert capfd.readouterr().err == ""
