"""Register every photograph of a folder with one scan, and write what was accepted.

    python photo_folder.py scan.e57 photos/ -o results/ --camera camera.json

Every photograph gets its own folder of results; those that were accepted are also exported together, so that each point
is coloured by the photograph that shows it best.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import ladarreg_core as lr

PICTURES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("photos", type=Path, help="a folder")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--camera", type=Path, help="a camera file; without one the focal length is that of EXIF")
    parser.add_argument("--to", default="ply", help="targets of the common export, e.g. laz,colmap,report")
    asked = parser.parse_args(words)

    scan = lr.read_scan(asked.scan)
    print(scan)
    registered: list[lr.RegisteredPhoto] = []
    for file in sorted(path for path in asked.photos.iterdir() if path.suffix.lower() in PICTURES):
        photo = lr.read_photo(file, camera=asked.camera)
        result = lr.register(scan, photo)
        print(f"{file.name}: {result}")
        lr.export_registration(asked.out / file.stem, result, scan, photo, inputs=[asked.scan, file])
        if result.accepted:
            registered.append(lr.RegisteredPhoto(file.stem, photo, result, file=file, camera_file=asked.camera))
        else:
            print(f"  {result.reasons[0]}")  # a refused registration is a result, too: it says why
    if not registered:
        return 3
    handed = lr.RegisteredScan(scan, registered, scan_file=asked.scan)
    lr.export_to(asked.out / "together", handed, asked.to.split(","))
    seen = (handed.colors.labels == lr.Label.SEEN).sum() / scan.valid.sum()
    print(f"{len(registered)} photographs colour {seen:.0%} of the returns; see {asked.out / 'together'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
