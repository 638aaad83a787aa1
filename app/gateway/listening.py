"""The socket that the gateway listens on: the first free port, or a Unix socket for a proxy in front."""

from __future__ import annotations

import errno
import os
import socket
import stat
import sys
from contextlib import suppress
from pathlib import Path

from ladarreg_core.errors import OptionError

from .options import GatewayOptions

_PORTS_TRIED = 100
_SOCKET_MODE = 0o660
"""The owner and the group: that of the folder, if the folder passes its group on (set-group-ID)."""


def listening_socket(options: GatewayOptions) -> socket.socket:
    """Return a socket that listens where the options say.

    Raises:
        OptionError: if the address is not one of this machine, no port is free, or the path cannot be listened on.
    """
    return _on_port(options) if options.socket is None else _on_path(options.socket)


def stop_listening(listening: socket.socket, options: GatewayOptions) -> None:
    """Close the socket; remove the file of a Unix socket."""
    listening.close()
    if options.socket is not None:
        with suppress(OSError):
            options.socket.unlink()


def _on_port(options: GatewayOptions) -> socket.socket:
    """Return a listening socket on the first free port."""
    host = options.host.strip("[]")
    last = min(options.port + _PORTS_TRIED, 65536) if options.port else 1
    for port in range(options.port, last):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
        except OSError:
            raise OptionError(f"{host!r} is not an address of this machine; give another with --host") from None
        bound = socket.socket(family, kind, protocol)
        if sys.platform == "win32":  # SO_REUSEADDR would let two servers share a port there
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            bound.bind(address)
            bound.listen(1)  # of two servers that could both bind, the second fails here
        except OSError as error:
            bound.close()
            if error.errno != errno.EADDRINUSE:
                reason = error.strerror or error
                raise OptionError(f"{host} port {port}: {reason}; give another with --host or --port") from None
            continue
        return bound
    raise OptionError(f"no port is free from {options.port} to {last - 1}; give another with --port")


def _on_path(path: Path) -> socket.socket:
    """Return a listening Unix socket, in place of one that a killed program left."""
    family = getattr(socket, "AF_UNIX", None)
    if family is None:
        raise OptionError("this system has no Unix sockets for --socket; use --port with --behind-proxy")
    _remove_dead_socket(path, family)
    bound = socket.socket(family, socket.SOCK_STREAM)
    before = os.umask(0o777 & ~_SOCKET_MODE)  # no moment in which others may connect
    try:
        bound.bind(os.fspath(path))
        bound.listen(1)
    except OSError as error:  # also of a path that is longer than about 100 bytes
        bound.close()
        reason = error.strerror or error
        raise OptionError(f"{path}: cannot listen there ({reason}); give another path with --socket") from None
    finally:
        os.umask(before)
    return bound


def _remove_dead_socket(path: Path, family: int) -> None:
    try:
        mode = path.lstat().st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(mode):
        raise OptionError(f"{path} exists and is not a socket; give another path with --socket")
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(os.fspath(path))
        except ConnectionRefusedError:  # nobody listens any more
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise OptionError(f"{path}: {error.strerror or error}; give another path with --socket") from None
    raise OptionError(f"{path}: another program listens there; end it, or give another path with --socket")
