"""A reverse proxy that lets only a page's own requests through to a server on this machine.

Drake's Meshcat answers whoever reaches its port, and any web page that a browser shows may open a
WebSocket to this machine. Browsers send the name that a page asked for as ``Host``, and with each
WebSocket the page's own origin as ``Origin``; a page of another origin cannot change either. Every
head of a request is read and checked; all else passes unread.
"""

from __future__ import annotations

import asyncio
import http.client
import io
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from email.message import Message

PORTS = range(7000, 8000)
"""Where a page listens if not told otherwise; Meshcat's."""

_NAMES = ("localhost", "127.0.0.1")
_END = b"\r\n\r\n"
_CHUNK = 1 << 16
# A server that was told that no more will come may still answer for this long [s].
_PATIENCE = 5.0


def listen(port: int | None = None) -> socket.socket:
    """A socket on the loopback address alone.

    Args:
        port: where it listens; the first free one of ``PORTS`` where not given.

    Raises:
        OSError: the port is taken, or no port is free.
    """
    for number in PORTS[:-1] if port is None else ():
        with suppress(OSError):
            return socket.create_server(("127.0.0.1", number))
    return socket.create_server(("127.0.0.1", PORTS[-1] if port is None else port))


def refuse(head: bytes, port: int) -> str | None:
    """Why the head of a request is refused; None: it is a page's own.

    Args:
        head: request line and headers, up to the empty line.
        port: the proxy's.
    """
    try:
        headers = http.client.parse_headers(io.BytesIO(head.partition(b"\n")[2]))
    except http.client.HTTPException:
        return "its head is no HTTP"
    return refuse_headers(headers, port)


def refuse_headers(headers: Message, port: int) -> str | None:
    """Why the headers of a request to a port are refused; None: they are a page's own."""
    own = [f"{name}:{port}" for name in _NAMES]
    hosts = headers.get_all("Host", [])
    if len(hosts) != 1 or hosts[0].strip().lower() not in own:
        return f"Host is {', '.join(hosts) or 'missing'}, not {own[0]}"
    for origin in headers.get_all("Origin", []):
        if origin.strip().lower() not in [f"http://{host}" for host in own]:
            return f"Origin is {origin}, not http://{own[0]}"
    return None


def serve(listening: socket.socket, target: tuple[str, int]) -> Callable[[], None]:
    """Passes what comes to a socket on to a server, in a thread of its own.

    Args:
        listening: of ``listen``.
        target: the server's address and port.

    Returns:
        What ends it, and closes the socket.
    """
    loop = asyncio.new_event_loop()
    port = listening.getsockname()[1]
    started = threading.Event()

    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # It is cancelled when the page is gone.
        with suppress(OSError, asyncio.LimitOverrunError, asyncio.CancelledError):
            await _pass_on(reader, writer, target, port)
        writer.close()

    def run() -> None:
        asyncio.set_event_loop(loop)
        server = loop.run_until_complete(asyncio.start_server(connected, sock=listening))
        started.set()
        loop.run_forever()
        server.close()
        tasks = asyncio.all_tasks(loop)
        for task in tasks:
            task.cancel()
        loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        loop.close()

    thread = threading.Thread(target=run, name="local_proxy", daemon=True)
    thread.start()
    started.wait()

    def close() -> None:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()

    return close


async def _pass_on(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    target: tuple[str, int],
    port: int,
) -> None:
    """Serves one connection, until either side ends it."""
    inner_reader, inner_writer = await asyncio.open_connection(*target)
    tasks = [
        asyncio.ensure_future(_ask(reader, inner_writer, port)),
        asyncio.ensure_future(_copy(inner_reader, writer)),
    ]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        refusal = tasks[0].result() if tasks[0].done() else None
        if refusal is not None:
            tasks[1].cancel()
            text = f"Refused: {refusal}. Open this page at http://localhost:{port}\n".encode()
            head = "HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain; charset=utf-8\r\n"
            head += f"Content-Length: {len(text)}\r\nConnection: close\r\n\r\n"
            writer.write(head.encode() + text)
            await writer.drain()
        elif not tasks[1].done():
            inner_writer.write_eof()
            await asyncio.wait(tasks[1:], timeout=_PATIENCE)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        inner_writer.close()


async def _ask(
    reader: asyncio.StreamReader, inner_writer: asyncio.StreamWriter, port: int
) -> str | None:
    """Passes requests on until no more come; why one is refused, None if none is."""
    while True:
        try:
            head = await reader.readuntil(_END)
        except asyncio.IncompleteReadError:
            return None
        refusal = refuse(head, port)
        if refusal is not None:
            return refusal
        inner_writer.write(head)
        await inner_writer.drain()
        # What follows a WebSocket's head is its own; bodies are not among what Meshcat takes, and
        # would be refused as the head of a request.
        if b"\r\nupgrade:" in head.lower():
            await _copy(reader, inner_writer)
            return None


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Passes bytes on until no more come."""
    while chunk := await reader.read(_CHUNK):
        writer.write(chunk)
        await writer.drain()
