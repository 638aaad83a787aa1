"""Colour the points of a LAS or LAZ file with a registered photograph; everything else in the file is kept.

    python colour_las.py cloud.laz photo.jpg -o coloured/ --camera camera.json

A LAS file does not say where the scanner stood: give it by --origin, or leave it to be estimated from the points. With
--pose the pose is not searched for; the file then says 'given, not verified'.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import laspy

import ladarreg_core as lr


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cloud", type=Path)
    parser.add_argument("photo", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--camera", type=Path, help="a camera file; without one the focal length is that of EXIF")
    parser.add_argument("--origin", type=float, nargs=3, metavar=("X", "Y", "Z"), help="where the scanner stood")
    parser.add_argument("--pose", type=Path, help="a pose file")
    asked = parser.parse_args(words)

    how = {} if asked.origin is None else {"origin": tuple(asked.origin)}
    scan = lr.read_scan(asked.cloud, **how)
    print(scan, *scan.notes, sep="\n  ")
    photo = lr.read_photo(asked.photo, camera=asked.camera)
    known = None if asked.pose is None else lr.read_pose(asked.pose)
    result = lr.register(scan, photo) if known is None else lr.given_pose(scan, photo, known)
    print(result, *result.reasons, sep="\n  ")
    if not result.is_shown:
        return 3
    one = lr.RegisteredPhoto(asked.photo.stem, photo, result, file=asked.photo)
    lr.export_to(asked.out, lr.RegisteredScan(scan, [one], scan_file=asked.cloud, scan_options=how), ["laz"])
    for file in sorted((asked.out / "laz").glob("*.la[sz]")):
        with laspy.open(file) as written:
            points = written.read()
        seen = (points.label == lr.Label.SEEN).mean()
        print(f"{file}: {len(points):,} points, {seen:.0%} of them seen by the photograph")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
