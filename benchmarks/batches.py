"""Many small pairs in one batch: what it costs, how it grows, and whether anything is lost when it is killed.

    python -m benchmarks.batches [--jobs N] [--kills N] [--coordinator-kills N] [--growth 10 30 100] [--peers]

1. Processor time a pair: the batch, against the single command once for each pair, and with `--peers` joblib over the
   Python interface, all in the same run.
2. Kills: the same batch with workers and the batch itself killed at random moments. Nothing may be lost, nothing done
   twice in the results, and all must be the same in every byte as undisturbed.
3. Growth: processor time of batches of different sizes, and the exponent.

The pairs are simulated, with a camera file, as small as they are still registered, and differ by their seeds; a third
of the jobs share each scan.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate.ladar import Ladar
from testing.jobs import contents
from testing.scenes.photo_set import simulate_photo_set, write_photo_set

ROOMS = ("a", "b", "c")
_SCENE, _SEED, _PHOTOS = "boxes", 5, 3  # whose last photograph is accepted
_SMALLER = 0.4  # than `small_photo_set`, in rows and columns
_COMMAND_RUNS = 4
_BETWEEN_KILLS_S = (0.5, 4.0)
_TICK_S = 0.05


def write_list(folder: Path, jobs: int, *, rooms: Path) -> Path:
    """Write a list of so many pairs, and return it."""
    rows = ["scan,photo,name,seed,camera"]
    for number in range(jobs):
        room = rooms / ROOMS[number % len(ROOMS)]
        rows.append(f"{room}/scan.npz,{room}/IMG_{_PHOTOS:04}.jpg,job-{number:05},{number},{room}/camera.json")
    path = folder / f"{jobs}.csv"
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def write_rooms(folder: Path) -> None:
    """Write the scan and photographs of a room several times."""
    step = float(np.radians(0.11 / _SMALLER))
    size = (int(350 * _SMALLER), int(500 * _SMALLER))
    ladar = Ladar(geometry=AzimuthElevation(*size, d_azimuth_rad=step, d_elevation_rad=step))
    focal = 609.0 * _SMALLER
    camera = Camera(
        int(480 * _SMALLER), int(320 * _SMALLER), focal, focal, 241.0 * _SMALLER, 157.0 * _SMALLER, (-0.02, 0, 0, 0)
    )
    found = simulate_photo_set(_SCENE, seed=_SEED, photos=_PHOTOS, camera=camera, ladar=ladar)
    for room in ROOMS:
        (folder / room).mkdir(parents=True)
        write_photo_set(folder / room, found)
        (folder / room / "camera.json").write_text(json.dumps(camera.as_fields()), encoding="utf-8")


def command(words: Sequence[str | Path]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "ladarreg", *map(str, words)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )


def used_by(words: Sequence[str | Path]) -> float:
    """Run a command, and return its processor time with that of its processes, s."""
    import resource

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = command(words)
    _, error = process.communicate()
    if process.returncode not in (0, 3):
        raise SystemExit(error.decode())
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def used_by_joblib(jobs: Path, folder: Path, workers: int) -> float:
    """Return the processor time of the same pairs by joblib over the Python interface, s."""
    code = (
        "import csv, sys, joblib, ladarreg_core as lr\n"
        "def one(row):\n"
        "    scan, photo = lr.read_scan(row['scan']), lr.read_photo(row['photo'], camera=row['camera'])\n"
        "    found = lr.register(scan, photo, options=lr.RegisterOptions(seed=int(row['seed'])))\n"
        f"    lr.export_registration(f'{folder}/' + row['name'], found, scan, photo)\n"
        "if __name__ == '__main__':\n"
        f"    rows = list(csv.DictReader(open({str(jobs)!r})))\n"
        f"    joblib.Parallel(n_jobs={workers})(joblib.delayed(one)(row) for row in rows)\n"
    )
    script = folder.parent / "by_joblib.py"
    script.write_text(code, encoding="utf-8")
    import resource

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, str(script)], check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def children_of(pid: int) -> list[int]:
    """Return the worker processes of a batch."""
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in path.read_text().split():
            try:
                if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
                    found.append(int(child))
            except OSError:
                continue
    return found


def done_in(folder: Path) -> list[str]:
    """Return the names of the jobs in the manifest, one for each record."""
    path = folder / "manifest.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)[1:] if path.exists() else []
    records = [json.loads(line) for line in lines if line.endswith(b"\n")]
    return [one["name"] for one in records if one["result"]["outcome"] != "failed"]  # failed ones are tried again


def run_with_kills(words: Sequence[str | Path], folder: Path, kills: int, own_kills: int, seed: int) -> tuple[int, int]:
    """Run a batch until it is done, and kill workers and the batch itself at random moments meanwhile.

    Returns:
        How many workers and how many batches were killed.
    """
    rng = random.Random(seed)
    killed, stopped = 0, 0
    process = command(words)
    next_kill = time.monotonic() + rng.uniform(*_BETWEEN_KILLS_S)
    while process.poll() is None:
        if time.monotonic() >= next_kill and killed + stopped < kills + own_kills:
            own = rng.random() < own_kills / (kills + own_kills)
            workers = children_of(process.pid)
            if own and stopped < own_kills and done_in(folder):
                process.send_signal(signal.SIGKILL)
                process.wait()
                stopped += 1
                process = command(words)
            elif workers and killed < kills:
                os.kill(rng.choice(workers), signal.SIGKILL)
                killed += 1
            next_kill = time.monotonic() + rng.uniform(*_BETWEEN_KILLS_S)
        time.sleep(_TICK_S)
    if process.returncode not in (0, 3):
        raise SystemExit(process.communicate()[1].decode())
    return killed, stopped


def kills(home: Path, rooms: Path, asked: argparse.Namespace) -> str:
    """Return what was lost, done twice or different after so many kills."""
    jobs = write_list(home, asked.jobs, rooms=rooms)
    calm, wild = home / "calm", home / "wild"
    words = ["batch", jobs, "--workers", str(asked.workers), "--quiet", "-o"]
    used_by([*words, calm])
    killed, stopped = run_with_kills([*words, wild], wild, asked.kills, asked.coordinator_kills, asked.seed)
    one, other = contents(calm), contents(wild)
    different = [name for name in {*one} | {*other} if one.get(name) != other.get(name)]
    outcomes = json.loads((wild / "batch.json").read_text(encoding="utf-8"))["outcomes"]
    twice = [name for name, count in Counter(done_in(wild)).items() if count > 1]
    lost = asked.jobs - len({*done_in(wild)})
    return (
        f"{asked.jobs} jobs, {killed} workers and {stopped} batches killed: {lost} lost, {len(twice)} recorded twice, "
        f"{len(different)} of {len(one)} files different; outcomes {outcomes}"
    )


def cost(home: Path, rooms: Path, asked: argparse.Namespace) -> str:
    """Return the processor time of a pair by the batch, by the command and by joblib."""
    jobs = write_list(home, asked.jobs, rooms=rooms)
    rows = [line.split(",") for line in jobs.read_text(encoding="utf-8").splitlines()[1 : 1 + _COMMAND_RUNS]]
    single = [
        used_by(["register", scan, photo, "--seed", seed, "--camera", camera, "-o", home / f"single-{name}", "--quiet"])
        for scan, photo, name, seed, camera in rows
    ]
    together = used_by(["batch", jobs, "-o", home / "cost", "--workers", str(asked.workers), "--quiet"]) / asked.jobs
    alone = sum(single) / len(single)
    text = f"processor time a pair: command {alone:.2f} s, batch {together:.2f} s ({together / alone:.2f} of it)"
    if asked.peers:
        peer = used_by_joblib(jobs, home / "joblib", asked.workers) / asked.jobs
        text += f", joblib over the interface {peer:.2f} s ({peer / alone:.2f})"
    return text


def growth(home: Path, rooms: Path, asked: argparse.Namespace) -> str:
    """Return the processor time of batches of different sizes, and the exponent."""
    found = []
    for jobs in asked.growth:
        path, out = write_list(home, jobs, rooms=rooms), home / f"growth-{jobs}"
        found.append((jobs, used_by(["batch", path, "-o", out, "--workers", str(asked.workers), "--quiet"])))
        shutil.rmtree(out)
    listed = ", ".join(f"{jobs} jobs {used:.1f} s" for jobs, used in found)
    if len(found) < 2:
        return f"growth: {listed}"
    (few, first), (many, last) = found[0], found[-1]
    return f"growth: {listed}; exponent {math.log(last / first) / math.log(many / few):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--coordinator-kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--growth", type=int, nargs="*", default=[10, 30, 100, 300])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--peers", action="store_true")
    parser.add_argument("--only", choices=("cost", "kills", "growth"))
    asked = parser.parse_args()
    parts = {"cost": cost, "kills": kills, "growth": growth}
    with tempfile.TemporaryDirectory() as made:
        home = Path(made)
        write_rooms(home / "rooms")
        for name, part in parts.items():
            if asked.only in (None, name):
                (home / name).mkdir()
                print(part(home / name, home / "rooms", asked), flush=True)


if __name__ == "__main__":
    main()
