"""Jobs on a Dask cluster: who may be reached, workers that are lost, and results as on one machine."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import ladarreg_core as lr
from ladarreg_core.batches.jobs.cluster import cluster
from ladarreg_core.errors import DependencyError, DeviceError, LadarregError, OptionError
from testing.jobs import Here, contents


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("node1", "give its address"),
        ("http://node1:80", "give its address"),
        ("tls://node1", "give its address"),
        ("tcp://node1:8786", "not encrypted"),
        ("", "give its address"),
    ],
)
def test_an_address_that_is_none_or_not_encrypted_is_refused(address: str, said: str) -> None:
    with pytest.raises(OptionError, match=said), cluster(address):
        pass


def test_missing_certificates_and_a_missing_package_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OptionError, match=r"key\.pem: file not found"), cluster("tls://node1:8786", tls=tmp_path):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(DependencyError, match=r"ladarreg\[cluster\]"), cluster("tls://node1:8786"):
        pass


def test_a_scheduler_that_does_not_answer_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="needs the extra cluster")
    monkeypatch.setattr("ladarreg_core.batches.jobs.cluster._CONNECT_S", 0.5)
    with pytest.raises(DeviceError, match="does not answer"), cluster("tcp://127.0.0.1:9", insecure=True):
        pass


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_workers_that_are_killed_cost_nothing_and_the_results_are_as_on_one_machine(
    jobs: list[lr.Job],
    tmp_path: Path,
) -> None:
    distributed = pytest.importorskip("distributed", reason="needs the extra cluster")
    killed: list[int] = []
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
        ) as machines,
        cluster(machines.scheduler_address, insecure=True) as executor,
    ):

        def kill_one(progress: lr.BatchProgress) -> None:
            if progress.done == 1 and not killed:
                killed.extend(machines.scheduler.workers and executor._client.run(os.getpid).values())
                os.kill(killed[0], signal.SIGKILL)

        result = lr.batch(jobs, tmp_path / "cluster", executor=executor, report=kill_one)
    assert killed
    lr.batch(jobs, tmp_path / "here", executor=Here())
    assert contents(tmp_path / "cluster") == contents(tmp_path / "here")
    assert result.count("refused") == 3


class _OfAnotherVersion(Executor):
    """Sends tasks as an older version of the program would."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return self._executor.submit(fn, replace(args[0], software={"version": "0.0.1"}))


@pytest.mark.long
def test_a_worker_with_other_software_ends_the_batch_with_one_error(jobs: list[lr.Job], tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="needs the extra cluster")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
        ) as machines,
        cluster(machines.scheduler_address, insecure=True) as executor,
        pytest.raises(LadarregError, match="runs other software"),
    ):
        lr.batch(jobs, tmp_path / "out", executor=_OfAnotherVersion(executor))
