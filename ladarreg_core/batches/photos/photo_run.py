"""Many photographs on one scan in one run: each with its verdict, those of one camera with one camera.

The scan is read once, and what it gives is kept on disk by content. The photographs of one camera are registered by
themselves first, their intrinsics are pooled, and then each is registered with the pooled camera; what disagreed or was
refused is searched anew. A photograph that fails stops no other one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, as_completed
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.batches.photos.executor import WorkerProcesses, usable_cores
from ladarreg_core.batches.photos.failures import failed, why_it_failed
from ladarreg_core.batches.photos.folder import PAGE_FILE, SUMMARY_FILE, BatchFolder
from ladarreg_core.batches.photos.photo_list import CameraGroup, PhotoEntry, camera_groups, photo_entries
from ladarreg_core.batches.photos.photo_summary import PhotosResult, summary_document
from ladarreg_core.batches.photos.photo_task import Output, PhotoTask, ScanFiles, estimate_in_worker, register_in_worker
from ladarreg_core.batches.photos.pooled_camera import CameraEstimate, PooledCamera, pool
from ladarreg_core.batches.photos.summary_page import write_summary_page
from ladarreg_core.errors import OptionError
from ladarreg_core.export.json import input_document, plain, write_result
from ladarreg_core.export.output_frame import FrameName, OutputFrame
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.scans.scan_request import ScanOptions
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan

T = TypeVar("T")
_FIRST, _DONE = "alone", "done"
"""Stages of a photograph in the journal: registered by itself, for its camera; registered and written."""
_DOING = "registered"
_LABELS = {_FIRST: "camera estimated", _DONE: "registered"}


def register_photos(
    scan: str | Path,
    photos: Sequence[str | Path],
    folder: str | Path,
    *,
    scan_options: Mapping[str, Any] | None = None,
    photo_options: Mapping[str, Any] | None = None,
    options: RegisterOptions | None = None,
    frame: FrameName = "scanner",
    processes: int | None = None,
    cache: ContentCache | None = None,
    force: bool = False,
    report: Report | None = None,
) -> PhotosResult:
    """Register photographs on one scan, and write their results and a summary of all into one folder.

    The folder has `adjustment.json`, the page `index.html`, and for each photograph a folder with what
    `export_registration` writes. Run again, it does what has not been done, or was done with other inputs or options.
    The result is the same whatever the number of processes. On systems that spawn processes, as all do here, a program
    calls this below `if __name__ == "__main__":`.

    Args:
        scan: file of the scan.
        photos: files of photographs; ones of the same body, lens, focal length and size, by EXIF, share one camera.
        folder: folder of the results: a new one, or that of an earlier run.
        scan_options: arguments of `read_scan`.
        photo_options: arguments of `read_photo` for all photographs.
        options: seed, thresholds and priors of all registrations.
        frame: of the models, as in `export_registration`.
        processes: number of worker processes; None: one for each processor core.
        cache: keeps the scan and what was made of it for further runs; None: only for this one.
        force: replace results of other inputs or options in the folder, or a folder of other results.
        report: receives the progress; may raise `Cancelled`: what was finished stays, and the run can be resumed.

    Raises:
        OptionError: if there is no photograph, an option is invalid, or the frame is `world` and the scan has none.
        FormatError: if the scan cannot be read.
        ExportError: if the folder must not be used or cannot be written.
    """
    entries = photo_entries(photos)
    if not entries:
        raise OptionError("there is no photo to register; give at least one")
    for path in (entry.path for entry in entries):
        if not path.is_file():
            raise OptionError(f"{path}: file not found; nothing was registered")
    if processes is not None and processes < 1:
        raise OptionError(f"the number of `processes` is {processes}; it must be at least 1")
    with ExitStack() as stack:
        inputs = [scan, *(entry.path for entry in entries)]
        opened = stack.enter_context(BatchFolder(folder, inputs=inputs, force=force))
        kept = cache or ContentCache(stack.enter_context(tempfile.TemporaryDirectory(prefix="ladarreg-")))
        run = _Run(
            opened, entries, camera_groups(entries, photo_options), dict(photo_options or {}),
            options or RegisterOptions(), frame, force, report,
        )  # fmt: skip
        read = run.read_scan(Path(scan), dict(scan_options or {}), kept)
        workers = stack.enter_context(WorkerProcesses(min(processes or usable_cores(), len(entries))))
        return run.finish(read, workers)


@dataclass(frozen=True, slots=True, eq=False)
class _ReadScan:
    """The scan as the tasks get it, and what the summary says of it."""

    files: ScanFiles
    inputs: list[dict[str, Any]]
    name: str
    notes: tuple[str, ...]
    world_from_scanner: Rigid | None


@dataclass(slots=True)
class _Run:
    """A run under way."""

    folder: BatchFolder
    entries: Sequence[PhotoEntry]
    groups: Sequence[CameraGroup]
    photo_options: dict[str, Any]
    options: RegisterOptions
    frame: FrameName
    force: bool
    report: Report | None
    inputs: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Name, size and SHA-256 of each photograph that can be read, by its id."""
    alone: dict[str, Registration] = field(default_factory=dict)
    """Registrations of photographs by themselves, of this run."""
    steps: int = 0
    done: int = 0

    def read_scan(self, path: Path, options: dict[str, Any], cache: ContentCache) -> _ReadScan:
        """Read the scan, or take it from the cache, and check what concerns the whole run."""
        files = [path, *options.get("more", ())]
        for file in files:
            if not Path(file).is_file():
                raise OptionError(f"{file}: file not found; give the file of a scan")
        inputs = [input_document(Path(file)) for file in files]
        stated = ScanOptions(**{name: value for name, value in options.items() if name != "more"}).given()
        key = ContentCache.key(kind="scan", files=[one["sha256"] for one in inputs], options=plain(stated))
        self._tell(0, f"reading {path.name}")
        scan = cache.get(key)
        if not isinstance(scan, Scan):
            scan = read_scan(path, report=self.report, **options)
            cache.put(key, scan)
        OutputFrame.of(scan, self.frame)  # refuse before the work
        read = ScanFiles(path, options, key, cache.folder, cache.most_bytes)
        return _ReadScan(read, inputs, scan.name, scan.notes, scan.world_from_scanner)

    def finish(self, scan: _ReadScan, workers: WorkerProcesses) -> PhotosResult:
        """Register all photographs and write the summary."""
        readable = [entry for entry in self.entries if entry.facts is not None]
        self.inputs = {entry.id: input_document(entry.path) for entry in readable}
        common = self._common(scan)
        keys = {entry.id: ContentCache.key(**common, photo=self.inputs[entry.id]["sha256"]) for entry in readable}
        self._refuse_changed(keys)
        pooling = [group for group in self.groups if group.may_pool]
        self.steps = len(readable) + sum(len(group.photos) for group in pooling)
        estimates = self._estimates(scan, pooling, keys, workers)
        cameras = {group.id: pool(self._of(group, estimates)) for group in pooling}
        results = self._results(scan, keys, cameras, estimates, workers)
        document = summary_document(
            self.entries, self.groups, cameras, results,
            scan={"inputs": scan.inputs, "name": scan.name, "notes": scan.notes},
            world_from_scanner=scan.world_from_scanner, options=asdict(self.options), inputs=self.inputs,
        )  # fmt: skip
        self._tell(self.steps, "writing the summary")
        self.folder.write(
            {
                SUMMARY_FILE: lambda path: write_result(path, document),
                PAGE_FILE: lambda path: write_summary_page(path, document, results),
            }
        )
        self._remove_others()
        return PhotosResult(self.folder.folder, document)

    def _common(self, scan: _ReadScan) -> dict[str, Any]:
        """Return what the results of all photographs depend on."""
        options = {name: value for name, value in self.photo_options.items() if value is not None}
        camera = options.get("camera")
        if isinstance(camera, str | Path):
            options["camera"] = input_document(Path(camera))["sha256"]
        elif camera is not None:
            options["camera"] = camera.as_fields()
        return {"scan": scan.files.key, "photo_options": plain(options), "options": plain(asdict(self.options))}

    def _refuse_changed(self, keys: Mapping[str, str]) -> None:
        """Refuse to replace what was done with other inputs or options, unless that is allowed."""
        done = self.folder.journal.names(_DONE)
        changed = [
            name for name, key in done.items()
            if key.partition("/")[0] != keys.get(name) and (self.folder.photos / name).exists()
        ]  # fmt: skip
        self.folder.require_replaceable(changed, force=self.force)

    def _estimates(
        self, scan: _ReadScan, groups: Sequence[CameraGroup], keys: Mapping[str, str], workers: WorkerProcesses
    ) -> dict[str, dict[str, Any]]:
        """Return what each photograph says of its camera by itself, by their ids; those that failed are left out."""
        found: dict[str, dict[str, Any]] = {}
        waiting: dict[Future[Any], PhotoEntry] = {}
        for entry in (entry for group in groups for entry in group.photos):
            known = self.folder.journal.find(_FIRST, entry.id, keys[entry.id])
            if known is not None:
                found[entry.id] = dict(known)
                self._advance(entry, _FIRST)
            else:
                waiting[workers.submit(estimate_in_worker, self._task(entry, scan))] = entry
        for future, entry in self._finished(waiting, _FIRST):
            try:
                result, estimate = future.result()
            except Exception:  # it is tried once more when its results are to be written, and recorded then
                continue
            self.alone[entry.id] = result
            found[entry.id] = {
                "pose": result.camera_from_scanner.matrix.tolist(),
                "estimate": None if estimate is None else estimate.as_fields(),
            }
            self.folder.journal.add(_FIRST, entry.id, keys[entry.id], found[entry.id])
        return found

    def _of(self, group: CameraGroup, estimates: Mapping[str, Mapping[str, Any]]) -> list[CameraEstimate]:
        found = (estimates.get(entry.id, {}).get("estimate") for entry in group.photos)
        return [CameraEstimate.from_fields(fields) for fields in found if fields is not None]

    def _results(
        self,
        scan: _ReadScan,
        keys: Mapping[str, str],
        cameras: Mapping[str, PooledCamera | None],
        estimates: Mapping[str, Mapping[str, Any]],
        workers: WorkerProcesses,
    ) -> dict[str, dict[str, Any]]:
        """Register and write every photograph, and return what the summary says of them, by their ids."""
        results: dict[str, dict[str, Any]] = {}
        waiting: dict[Future[Any], PhotoEntry] = {}
        whole = dict(keys)
        camera_of = {entry.id: cameras.get(group.id) for group in self.groups for entry in group.photos}
        for entry in self.entries:
            if entry.facts is None:
                results[entry.id] = failed(entry.fault, _DOING)
                continue
            pooled = camera_of[entry.id]
            whole[entry.id] += "/" + ContentCache.key(camera=_camera_fields(pooled, entry), frame=self.frame)
            known = self.folder.journal.find(_DONE, entry.id, whole[entry.id])
            if known is not None and self.folder.has_results(entry.id):
                results[entry.id] = dict(known)
                self._advance(entry, _DONE)
                continue
            task = self._task(entry, scan, pooled, estimates.get(entry.id))
            output = Output(folder=self.folder.photos / entry.id, frame=self.frame, force=True)
            waiting[workers.submit(register_in_worker, task, output)] = entry
        for future, entry in self._finished(waiting, _DONE):
            try:
                results[entry.id] = plain(future.result())
            except Exception as error:
                results[entry.id] = failed(why_it_failed(error), _DOING)
                self.folder.clear_leftovers()
            else:
                self.folder.journal.add(_DONE, entry.id, whole[entry.id], results[entry.id])
        return results

    def _task(
        self,
        entry: PhotoEntry,
        scan: _ReadScan,
        pooled: PooledCamera | None = None,
        alone: Mapping[str, Any] | None = None,
    ) -> PhotoTask:
        assert entry.facts is not None, "only photographs that can be read are registered"
        agrees = pooled is not None and entry.id in pooled.photos and alone is not None
        return PhotoTask(
            id=entry.id, path=entry.path, options=self.photo_options, orientation=entry.facts.orientation,
            scan=scan.files, registering=self.options, camera=pooled,
            start=Rigid.from_matrix(alone["pose"]) if agrees and alone is not None else None,
            found=self.alone.get(entry.id),
        )  # fmt: skip

    def _finished(self, waiting: Mapping[Future[T], PhotoEntry], stage: str) -> Iterator[tuple[Future[T], PhotoEntry]]:
        early = [future for future in waiting if future.done()]  # in their order: `as_completed` gives them in any
        for future in chain(early, as_completed({*waiting} - {*early})):
            yield future, waiting[future]  # and it is recorded
            self._advance(waiting[future], stage)

    def _advance(self, entry: PhotoEntry, stage: str) -> None:
        self.done += 1
        self._tell(self.done, f"{entry.path.name}: {_LABELS[stage]}")

    def _tell(self, done: int, label: str) -> None:
        if self.report is not None:
            self.report(Progress(done, self.steps, label))

    def _remove_others(self) -> None:
        """Remove the results of photographs that are not of this run, which was allowed."""
        ids = {entry.id for entry in self.entries}
        for name in self.folder.journal.names(_DONE):
            if name not in ids:
                self.folder.remove(name)


def _camera_fields(pooled: PooledCamera | None, entry: PhotoEntry) -> dict[str, Any] | None:
    """Return what the result of a photograph depends on of the pooled camera."""
    if pooled is None:
        return None
    how = {"agrees": entry.id in pooled.photos, "disagrees": entry.id in pooled.disagreeing}
    return {"values": pooled.values.tolist(), "covariance": pooled.covariance.tolist(), **how}
