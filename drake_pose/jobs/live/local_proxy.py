"""A reverse proxy (aiohttp) that lets only a page's own requests through to Drake's Meshcat.

Meshcat answers whoever reaches its port, as any web page in a browser here can. Browsers send the
name that a page asked for as ``Host``, and with each WebSocket the page's ``Origin``; a page of
another origin cannot change either.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import secrets
import socket
import threading
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress

from aiohttp import (
    ClientSession,
    ClientWebSocketResponse,
    ClientWSTimeout,
    TCPConnector,
    WSMsgType,
    web,
)
from pydrake.geometry import Meshcat, MeshcatParams

from drake_pose.errors import SettingsError

PORTS = range(7000, 8000)
"""Where a page listens if not told otherwise; Meshcat's."""

_NAMES = ("localhost", "127.0.0.1")
# How long either side may take to close a connection [s].
_GOODBYE = 0.5
# Headers of an answer that tell what it is; the others are of one connection.
_PASSED = ("Content-Type", "Content-Encoding", "Content-Disposition", "Cache-Control")


def listen(port: int | None = None) -> socket.socket:
    """A socket on the loopback address alone, at the port or else the first free one of ``PORTS``.

    Raises:
        OSError: the port is taken, or no port is free.
    """
    for number in PORTS[:-1] if port is None else ():
        with suppress(OSError):
            return socket.create_server(("127.0.0.1", number))
    return socket.create_server(("127.0.0.1", PORTS[-1] if port is None else port))


def refuse(hosts: Sequence[str], origins: Sequence[str], port: int) -> str | None:
    """Why a request to a port, with these headers, is refused; None: it is a page's own."""
    own = [f"{name}:{port}" for name in _NAMES]
    if len(hosts) != 1 or hosts[0].strip().lower() not in own:
        return f"Host is {', '.join(hosts) or 'missing'}, not {own[0]}"
    for origin in origins:
        if origin.strip().lower() not in [f"http://{host}" for host in own]:
            return f"Origin is {origin}, not http://{own[0]}"
    return None


def open_page(port: int | None = None) -> Meshcat:
    """A Meshcat page for this machine's browsers, without Drake's own message.

    Meshcat listens behind the proxy at one of 2^24 loopback addresses, which no web page can find
    by trying; where the system has but one of them (macOS), at a port among 2^16.

    Raises:
        SettingsError: no page can be opened at the port.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        listening = listen(port)
        number = listening.getsockname()[1]
        page, host = _hidden_meshcat(f"http://localhost:{number}")
    except (OSError, RuntimeError) as error:
        where = f"port {port}" if port is not None else f"ports {PORTS[0]} to {PORTS[-1]}"
        raise SettingsError(f"no page can be opened at {where}: {error}") from error
    finally:
        logger.setLevel(level)
    weakref.finalize(page, _serve(listening, f"{host}:{page.port()}", number))
    return page


def _hidden_meshcat(url: str) -> tuple[Meshcat, str]:
    """A Meshcat that says it is at a URL, and the loopback address at which it is."""
    # Neither the network's own address, nor its last one, which is for broadcasts.
    hidden = ipaddress.ip_address((127 << 24) + 1 + secrets.randbelow((1 << 24) - 2))
    for host in (str(hidden), "127.0.0.1"):
        with suppress(RuntimeError):
            params = MeshcatParams(host=host, port=0, show_stats_plot=False, web_url_pattern=url)
            return Meshcat(params), host
    raise RuntimeError("Meshcat cannot listen at any loopback address")


def _serve(listening: socket.socket, target: str, port: int) -> Callable[[], None]:
    """Passes a page's requests on to a server, in a thread of its own; returns what ends it."""
    loop, ended, started = asyncio.new_event_loop(), asyncio.Event(), threading.Event()

    async def run() -> None:
        # Meshcat waits for connections that are kept.
        connector = TCPConnector(force_close=True)
        async with ClientSession(connector=connector, auto_decompress=False) as session:

            async def handle(request: web.BaseRequest) -> web.StreamResponse:
                headers = request.headers
                why = refuse(headers.getall("Host", []), headers.getall("Origin", []), port)
                if why is not None:
                    text = f"Refused: {why}. Open this page at http://localhost:{port}\n"
                    refused = web.Response(status=403, text=text)
                    refused.force_close()
                    return refused
                return await _pass_on(request, session, target)

            runner = web.ServerRunner(web.Server(handle, access_log=None), shutdown_timeout=0.0)
            await runner.setup()
            await web.SockSite(runner, listening).start()
            started.set()
            await ended.wait()
            await runner.cleanup()

    thread = threading.Thread(
        target=lambda: loop.run_until_complete(run()), name="local_proxy", daemon=True
    )
    thread.start()
    started.wait()

    def close() -> None:
        loop.call_soon_threadsafe(ended.set)
        thread.join()
        loop.close()

    return close


async def _pass_on(
    request: web.BaseRequest, session: ClientSession, target: str
) -> web.StreamResponse:
    """What the server answers to a request."""
    url = f"http://{target}{request.rel_url}"
    outer = web.WebSocketResponse(timeout=_GOODBYE, max_msg_size=0, compress=False)
    if not outer.can_prepare(request).ok:
        async with session.get(url) as answer:
            headers = {name: answer.headers[name] for name in _PASSED if name in answer.headers}
            return web.Response(body=await answer.read(), status=answer.status, headers=headers)
    timeout = ClientWSTimeout(ws_close=_GOODBYE)
    async with session.ws_connect(url, timeout=timeout, max_msg_size=0) as inner:
        await outer.prepare(request)
        copies = [asyncio.ensure_future(_copy(*pair)) for pair in ((inner, outer), (outer, inner))]
        try:
            await asyncio.wait(copies, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for copy in copies:
                copy.cancel()
            await asyncio.gather(*copies, return_exceptions=True)
        await outer.close()
    return outer


_Socket = web.WebSocketResponse | ClientWebSocketResponse


async def _copy(source: _Socket, target: _Socket) -> None:
    """Passes messages on until no more come."""
    async for message in source:
        if message.type is WSMsgType.BINARY:
            await target.send_bytes(message.data)
        elif message.type is WSMsgType.TEXT:
            await target.send_str(message.data)
