"""Time and memory of the export of a large scan: python -m benchmarks.export [FOLDER] [--cells 10] [--to laz,ply,e57].

The scan is a dome made by `benchmarks.shared.dome` in the folder, unless it is there already, with its photograph and
the true pose. Ladarreg exports it in a fresh process; the peers then write the same arrays, read from what ladarreg
wrote, in others: laspy alone the LAZ, pye57 alone the points of the E57. Also measured: how long a cancelled export
takes to end, and what it leaves. Times are wall-clock and of the processor; the load before the run is printed, since
other programs mislead by a factor.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

MAX_SECONDS, MAX_BYTES = 15.0, 1.5e9


def handed_over(folder: Path) -> Any:
    """Read the dome and return it with its photograph at the true pose."""
    import ladarreg_core as lr
    from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
    from ladarreg_core.formats.documents.pose_file import read_pose
    from ladarreg_core.matches import Matches

    scan = lr.read_scan(folder / "scan.e57")
    photo = lr.read_photo(folder / "photo.png", camera=folder / "camera.json")
    none = np.zeros(0)
    result = lr.Registration(
        camera_from_scanner=read_pose(folder / "truth.json"),
        camera=photo.camera,
        matches=Matches.none(),
        inliers=np.zeros(0, np.bool_),
        residuals_px=np.zeros((0, 2)),
        residuals_m=none,
        stereo_depth_error_m=none,
        covariance=np.diag([1e-8] * 3 + [1e-6] * 3),
        chi2_per_dof=1.0,
        sigma_px=0.5,
        sigma_range_m=0.002,
        accepted=True,
        evidence="image",
        method="auto",
    )
    one = RegisteredPhoto("photo", photo, result, folder / "photo.png", folder / "camera.json")
    return RegisteredScan(scan, (one,), folder / "scan.e57")


def ours(folder: Path, targets: list[str], cancel_at: float | None) -> dict[str, Any]:
    """Export in this process."""
    from ladarreg_core.errors import Cancelled
    from ladarreg_core.export.targets.pipeline import export_to
    from ladarreg_core.foundations.progress import Progress

    handed = handed_over(folder)
    before = _peak_bytes()
    out = folder / "out"
    seconds: dict[str, float] = {}
    begun = last = time.perf_counter()
    longest, label, asked = 0.0, "colours", None

    def report(progress: Progress) -> None:
        nonlocal last, longest, label, asked
        now = time.perf_counter()
        longest, last = max(longest, now - last), now
        seconds[label] = seconds.get(label, 0.0) + (now - begun - sum(seconds.values()))
        label = progress.label
        if cancel_at is not None and now - begun > cancel_at:
            asked = asked or now
            raise Cancelled("stopped")

    cpu = time.process_time()
    cancelled = False
    try:
        export_to(out, handed, targets, report=report, force=True)
    except Cancelled:
        cancelled = True
    end = time.perf_counter()
    return {
        "seconds": end - begun,
        "cpu_s": time.process_time() - cpu,
        "longest_silence_s": longest,
        "after_cancel_s": None if asked is None else end - asked,
        "cancelled": cancelled,
        "left": sorted(path.name for path in folder.iterdir() if path.name.startswith(".out")),
        "peak_bytes": _peak_bytes(),
        "read_peak_bytes": before,
        "sizes_mb": {p.name: round(p.stat().st_size / 1e6, 1) for p in out.rglob("*") if p.is_file()}
        if out.exists()
        else {},
        "by_label_s": {name: round(value, 2) for name, value in seconds.items()},
        "points": int(np.count_nonzero(handed.scan.valid)),
    }


def peer(folder: Path, target: str) -> dict[str, Any]:
    """Write the arrays of an export again with the library alone."""
    if target == "laz":
        import laspy

        (file,) = (folder / "out" / "laz").glob("*.laz")
        data = laspy.read(file)
        begun, cpu = time.perf_counter(), time.process_time()
        data.write(folder / "peer.laz", laz_backend=laspy.LazBackend.LazrsParallel)
    else:
        import pye57

        (file,) = (folder / "out" / "e57").glob("*.e57")
        source = pye57.E57(str(file))
        values = source.read_scan_raw(0)
        rotation, translation = source.get_header(0).rotation, source.get_header(0).translation
        source.close()
        begun, cpu = time.perf_counter(), time.process_time()
        written = pye57.E57(str(folder / "peer.e57"), mode="w")
        known = {name: column for name, column in values.items() if name in pye57.e57.SUPPORTED_POINT_FIELDS}
        written.write_scan_raw(known, rotation=rotation, translation=translation)
        written.close()
    result = {"seconds": time.perf_counter() - begun, "cpu_s": time.process_time() - cpu}
    (folder / f"peer.{target}").unlink()
    return result


def _peak_bytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0


def _in_process(*words: str) -> dict[str, Any]:
    """Run a part in a fresh process."""
    command = [sys.executable, "-m", "benchmarks.export", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr[-2000:])
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--cells", type=float, default=10.0, help="millions")
    parser.add_argument("--to", default="laz,ply,e57")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--part", help=argparse.SUPPRESS)
    parser.add_argument("--cancel-at", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        targets = options.to.split(",")
        found = (
            ours(options.folder, targets, options.cancel_at)
            if options.part == "ours"
            else peer(options.folder, targets[0])
        )
        print(json.dumps(found))
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "scan.e57").exists():
            from benchmarks.shared.dome import dome_shape, make_dome

            make_dome(folder, dome_shape(options.cells * 1e6))
        print(f"load before: {os.getloadavg()[0]:.2f}")
        place = str(folder)
        rows: dict[str, list[dict[str, Any]]] = {}
        for _ in range(options.rounds):
            rows.setdefault("ladarreg", []).append(_in_process(place, "--part", "ours", "--to", options.to))
            for name in sorted({"laz", "e57"} & set(options.to.split(","))):
                rows.setdefault(f"{name} alone", []).append(_in_process(place, "--part", "peer", "--to", name))
        for name, found in rows.items():
            wall, cpu = (float(np.median([one[key] for one in found])) for key in ("seconds", "cpu_s"))
            print(f"{name:<12} {wall:6.1f} s wall, {cpu:6.1f} s of the processor (median of {len(found)})")
        best = rows["ladarreg"][0]
        wall = float(np.median([one["seconds"] for one in rows["ladarreg"]]))
        peak, after = (best[key] / 1e9 for key in ("peak_bytes", "read_peak_bytes"))
        print(f"{best['points']:,} points; peak {peak:.2f} GB, after reading {after:.2f}")
        print(f"by step, s: {best['by_label_s']}; sizes, MB: {best['sizes_mb']}")
        print(f"longest time without a report: {best['longest_silence_s']:.2f} s")
        for key, what in (("seconds", "wall"), ("cpu_s", "of the processor")):
            peers = sum(float(np.median([one[key] for one in rows[name]])) for name in rows if name != "ladarreg")
            mine = float(np.median([one[key] for one in rows["ladarreg"]]))
            print(f"ratio to the libraries alone, {what}: {mine / max(peers, 1e-9):.2f}")
        stopped = [
            _in_process(place, "--part", "ours", "--to", options.to, "--cancel-at", str(at)) for at in (1.0, wall / 2)
        ]
        for one in (each for each in stopped if each["cancelled"]):
            print(f"cancelled: ended after {one['after_cancel_s']:.2f} s, left {one['left'] or 'nothing new'}")
        for text, value, most in (("seconds", wall, MAX_SECONDS), ("bytes", best["peak_bytes"], MAX_BYTES)):
            print(f"{text}: {value:.4g}; asked: at most {most:.4g}: {'met' if value <= most else 'not met'}")


if __name__ == "__main__":
    main()
