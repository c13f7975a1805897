"""A server for the live page that listens to this machine only, and only to the page that it serves itself.

Binding to 127.0.0.1 keeps other machines out, but not other pages: any site that is open in a browser here may connect to
a websocket of this machine and give orders, since websockets are not held to the same origin (RFC 6455, section 10.2). The
browser says in the header ``Origin`` which page it is that asks; whoever is not a browser sends none.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from typing import TYPE_CHECKING, Any

from flockopt.errors import SolverFailed, require

if TYPE_CHECKING:
    import viser

__all__ = ["HOST", "load_viser", "local_server", "stop_server"]

#: The page is for whoever sits at this machine.
HOST = "127.0.0.1"


def load_viser() -> Any:
    """The module viser.

    Raises:
        MissingExtra: If it is not installed.
    """
    return require("viser", extra="live")


def local_server(port: int, label: str) -> viser.ViserServer:
    """Serve a page that only itself may speak to.

    Args:
        port: Where; the next free one if it is taken, any free one for 0.
        label: Its title.

    Raises:
        MissingExtra: If viser is not installed.
        SolverFailed: If viser serves pages in another way than this module knows how to guard.
    """
    viser_module = load_viser()
    origins: list[Any] = [None]  # until the port is known, no page at all
    with redirect_stdout(StringIO()), _held_to(origins) as guarded:  # it announces itself in a way of its own
        server: viser.ViserServer = viser_module.ViserServer(host=HOST, port=port, label=label, verbose=False)
    if not guarded:
        stop_server(server)
        raise SolverFailed("viser", "this version cannot be told whom to listen to; install another one")
    origins += [f"http://{name}:{server.get_port()}" for name in (HOST, "localhost")]
    return server


@contextmanager
def _held_to(origins: list[Any]) -> Iterator[list[int]]:
    """Let servers that begin to serve here accept websockets from these origins only; yields the ports that they try.

    The package websockets refuses others in the handshake if it is asked to, but viser has no word to ask it.
    """
    from websockets.asyncio import server as websockets_server

    serve, ports = websockets_server.serve, list[int]()

    def serve_held(handler: Any, host: str, port: int, **settings: Any) -> Any:
        ports.append(port)
        return serve(handler, host, port, origins=origins, **settings)

    setattr(websockets_server, "serve", serve_held)  # noqa: B010  an assignment is no better, and mypy refuses it
    try:
        yield ports
    finally:
        setattr(websockets_server, "serve", serve)  # noqa: B010


def stop_server(server: viser.ViserServer) -> None:
    """Stop serving, without the farewell that viser prints."""
    with redirect_stdout(StringIO()):
        server.stop()
