"""`ladarreg batch JOBS -o OUT`."""

from __future__ import annotations

import os
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import tyro

from ..arguments import OptionalFloat, OptionalInt, OptionalPath, OptionalStr
from ..batch_table import batch_table
from ..exit_codes import ExitCode
from ..messages import one_line

if TYPE_CHECKING:
    from ladarreg_core.batches.jobs.run_folder import BatchResult

EXAMPLES = (
    "ladarreg batch jobs.csv -o results",
    "# each folder is a job: a scan with its photos, or a survey:",
    "ladarreg batch 'sites/*' -o results --workers 4",
    "# after an interruption, the same command goes on where it was",
    "# on the machines of a Dask cluster (docs/cluster.md):",
    "ladarreg batch jobs.csv -o out --scheduler tls://node1:8786 --tls tls",
)
_Names: TypeAlias = list[str]
_MAX_LINES = 12


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `batch`."""

    jobs: Annotated[tyro.conf.Positional[_Names], tyro.conf.arg(metavar="JOBS")]
    """A list (CSV or JSON) with columns scan and photo, or survey, and options of register; or folders, each with one
    job, also as a pattern."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """Output folder: a new one, or that of an earlier run, which is resumed."""
    workers: Annotated[OptionalInt, tyro.conf.arg(metavar="N")] = None
    """Number of jobs that are done at a time; default: one for each processor core."""
    memory_gb: Annotated[OptionalFloat, tyro.conf.arg(metavar="GB")] = None
    """Memory that a job may use; default: that of the machine."""
    scheduler: Annotated[OptionalStr, tyro.conf.arg(metavar="ADDRESS")] = None
    """Address of the scheduler of a Dask cluster that does the jobs, tls://HOST:PORT; default: this machine does."""
    tls: Annotated[OptionalPath, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder with ca.pem, cert.pem and key.pem for the cluster; default: as Dask is configured."""
    insecure_cluster: bool = False
    """Allow a scheduler at tcp://HOST:PORT, without encryption and certificates."""
    force: bool = False
    """Replace what OUT contains of other inputs or options, or OUT if it contains results and nothing else."""
    quiet: bool = False
    """Print no progress, and the verdict in one line."""
    json: bool = False
    """Print batch.json, and nothing else, on stdout; errors, too."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Do the jobs, write their results and the summary, and print the outcomes."""
    from ladarreg_core.batches.jobs.job_list import JobListError, read_jobs
    from ladarreg_core.batches.jobs.run import batch
    from ladarreg_core.errors import FormatError, OptionError
    from ladarreg_core.storage.manifest import visible_files

    started = time.perf_counter()
    if arguments.scheduler is not None and arguments.workers is not None:
        raise OptionError("--workers is for this machine; a cluster has the workers that have joined it: omit it")
    try:
        jobs = read_jobs(*arguments.jobs)
    except JobListError as error:
        if arguments.json or len(error.faults) == 1:
            raise
        for fault in error.faults:
            print(f"ladarreg: {one_line(fault)}", file=sys.stderr)
        raise FormatError(error.summary) from None
    with ExitStack() as stack:
        executor = None
        if arguments.scheduler is not None:
            from ladarreg_core.batches.jobs.cluster import cluster

            executor = stack.enter_context(
                cluster(arguments.scheduler, tls=arguments.tls, insecure=arguments.insecure_cluster)
            )
        elif arguments.tls is not None or arguments.insecure_cluster:
            raise OptionError("--tls and --insecure-cluster are for a cluster; give its --scheduler, or omit them")
        table = stack.enter_context(batch_table(quiet=arguments.quiet or arguments.json))
        result = batch(
            jobs, arguments.out, executor=executor, workers=arguments.workers, memory_gb=arguments.memory_gb,
            force=arguments.force, report=table.show,
        )  # fmt: skip
    files = visible_files(arguments.out)
    if arguments.json:
        from ..json_output import print_json

        print_json({**result.document, "output": {"folder": os.path.abspath(arguments.out), "files": files}})
    elif arguments.quiet:
        print(_verdict(result))
    else:
        print("\n".join(_lines(result)))
        print(f"Wrote    {', '.join(files)} in {arguments.out}")
        print(f"Took     {time.perf_counter() - started:.1f} s")
    return ExitCode.ACCEPTED if result.accepted else ExitCode.NOT_ACCEPTED


def _verdict(result: BatchResult) -> str:
    return (
        f"{result.count('accepted')} of {len(result.jobs)} jobs were accepted, {result.count('refused')} refused, "
        f"{result.count('failed')} failed."
    )


def _lines(result: BatchResult) -> list[str]:
    """Return the verdict and a line for each job that was not accepted, failures first."""
    lines = [_verdict(result)]
    others = [(name, one) for name, one in result.jobs.items() if one["outcome"] != "accepted"]
    others.sort(key=lambda item: item[1]["outcome"] != "failed")
    for name, one in others[:_MAX_LINES]:
        said = " ".join([one["verdict"], *one["reasons"][:1]])
        lines.append(f"{one['outcome'].capitalize():<8} {one_line(name)}: {one_line(said)}")
    if len(others) > _MAX_LINES:
        lines.append(f"         and {len(others) - _MAX_LINES} more: see index.html")
    return lines
