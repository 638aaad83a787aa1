"""A Dask cluster as an executor of jobs: `dask.distributed`, the extra `cluster`."""

from __future__ import annotations

import contextlib
import importlib
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from ladarreg_core.errors import DependencyError, DeviceError, OptionError

P = ParamSpec("P")
T = TypeVar("T")
_CONNECT_S = 20.0
_NAMES = ("ca", "cert", "key")


class ClusterExecutor(Executor):
    """Does tasks on the workers of a Dask scheduler; a task whose worker is lost is done by another one.

    Args:
        client: a `distributed.Client` that is connected.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False)

    @property
    def remark(self) -> str:
        """Why no task is being done, a sentence; empty: it is."""
        if self._client.status != "running":
            return "the scheduler does not answer; waiting until it does"
        if not self._client.scheduler_info(n_workers=0).get("n_workers", 1):
            return "the cluster has no workers; waiting until one joins"
        return ""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Have a function called by a worker; see `concurrent.futures.Executor`."""
        future: Future[T] = self._executor.submit(fn, *args, **kwargs)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no further task; see `concurrent.futures.Executor`."""
        self._executor.shutdown(wait=wait)


@contextlib.contextmanager
def cluster(address: str, *, tls: str | Path | None = None, insecure: bool = False) -> Iterator[ClusterExecutor]:
    """Connect to the scheduler of a cluster, for `batch(..., executor=...)`.

    Who reaches a scheduler has all machines of the cluster do what he likes. Connections are therefore encrypted, and
    both ends show a certificate.

    Args:
        address: of the scheduler: `tls://HOST:PORT`.
        tls: folder with `ca.pem`, `cert.pem` and `key.pem`; None: as Dask's own configuration says.
        insecure: allow `tcp://HOST:PORT`, without encryption and certificates, as in a network of one's own.

    Raises:
        OptionError: if the address is none, or not encrypted without `insecure`.
        DependencyError: if `distributed` is not installed.
        DeviceError: if the scheduler does not answer.
    """
    kind, found, rest = address.partition("://")
    if not found or kind not in ("tls", "tcp") or ":" not in rest:
        raise OptionError(f"the scheduler is {address[:80]!r}; give its address, as tls://HOST:8786")
    if kind == "tcp" and not insecure:
        raise OptionError(
            f"{address[:80]} is not encrypted, and whoever reaches it runs programs on all machines; give a tls:// "
            "address, or allow this one in a network of your own by `insecure_cluster`"
        )
    files = {} if tls is None else {name: Path(tls) / f"{name}.pem" for name in _NAMES}
    missing = [str(path) for path in files.values() if not path.is_file()]
    if missing:
        raise OptionError(f"{', '.join(missing)}: file not found; the folder needs ca.pem, cert.pem and key.pem")
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise DependencyError(
            "a cluster needs dask.distributed; install ladarreg[cluster] here and on all machines"
        ) from None
    security = None
    if files:
        security = distributed.Security(
            tls_ca_file=str(files["ca"]), tls_client_cert=str(files["cert"]), tls_client_key=str(files["key"]),
            require_encryption=True,
        )  # fmt: skip
    logging.getLogger("distributed").setLevel(logging.ERROR)  # what it reports are workers that come and go
    try:
        client = distributed.Client(address, security=security, timeout=_CONNECT_S, set_as_default=False)
    except Exception as error:  # each protocol has its own
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise DeviceError(
            f"the scheduler at {address[:80]} does not answer ({reason}); start it, and check the address and the "
            "certificates"
        ) from None
    try:
        yield ClusterExecutor(client)
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=5)
