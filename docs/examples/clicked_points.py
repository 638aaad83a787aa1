"""Print the coordinates of pixels of a registered photograph, each with its standard deviation.

    python clicked_points.py scan.e57 photo.jpg --camera camera.json --at 412.5,230 --at 118,77
    python clicked_points.py scan.e57 results/registration.json --at 412.5,230

Give the registration.json of earlier results instead of the photograph, and nothing is registered again. Pixel (0, 0)
is the centre of the top-left one.
"""

from __future__ import annotations

import argparse

import numpy as np

import ladarreg_core as lr


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("photo", help="a photograph, or the registration.json of one")
    parser.add_argument("--camera", help="a camera file; without one the focal length is that of EXIF")
    parser.add_argument("--at", action="append", required=True, metavar="U,V", help="a pixel; give as many as you like")
    parser.add_argument("--click-px", type=float, default=0.5, help="standard deviation of a click, pixels")
    asked = parser.parse_args(words)

    scan = lr.read_scan(asked.scan)
    if asked.photo.endswith(".json"):
        result = lr.read_registration(asked.photo)
    else:
        result = lr.register(scan, lr.read_photo(asked.photo, camera=asked.camera))
    print(result)
    if not result.is_shown:
        return 3
    uv = np.array([[float(number) for number in pixel.split(",")] for pixel in asked.at])
    frame = "scanner" if scan.world_from_scanner is None else "world"
    xyz, sigma = lr.xyz_of_photo(scan, result, at=uv, frame=frame, sigma_uv_px=asked.click_px)
    print(f"   u       v          X          Y          Z  ({frame}, m)   sigma")
    for (u, v), point, spread in zip(uv, xyz, sigma, strict=True):
        if np.isnan(point).any():
            print(f"{u:7.1f} {v:7.1f}  the laser saw no surface there")
        else:
            print(f"{u:7.1f} {v:7.1f} {point[0]:10.3f} {point[1]:10.3f} {point[2]:10.3f} {1000 * spread:16.1f} mm")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
