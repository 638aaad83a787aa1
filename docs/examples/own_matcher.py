"""Register with the matches of a matcher of one's own: here OpenCV's SIFT, between laser intensity and photograph.

    python own_matcher.py scan.npz photo.png --camera camera.json

Any matcher will do that gives positions in the intensity image of the scan's grid, and in the photograph. Wrong matches
are expected; the images then decide whether the pose is right.
"""

from __future__ import annotations

import argparse

import cv2
import numpy as np

import ladarreg_core as lr

RATIO = 0.85  # of the distances to the best and the second-best descriptor


def matched(scan: lr.Scan, photo: lr.Photo) -> tuple[np.ndarray, np.ndarray]:
    """Return cells (M, 2) of the scan, (row, column), and pixels (M, 2) of the photograph, (u, v)."""
    sift = cv2.SIFT_create(6000, contrastThreshold=0.01)
    gray = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (lr.intensity_picture(scan), photo.pixels)]
    (scan_points, scan_words), (photo_points, photo_words) = (sift.detectAndCompute(one, None) for one in gray)
    pairs = cv2.BFMatcher().knnMatch(scan_words, photo_words, k=2)
    good = [best for best, second in pairs if best.distance < RATIO * second.distance]
    cells = np.array([scan_points[one.queryIdx].pt[::-1] for one in good])  # OpenCV says (column, row)
    return cells, np.array([photo_points[one.trainIdx].pt for one in good])


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("photo")
    parser.add_argument("--camera", help="a camera file; without one the focal length is that of EXIF")
    parser.add_argument("--json", help="write the result to this file")
    asked = parser.parse_args(words)

    scan, photo = lr.read_scan(asked.scan), lr.read_photo(asked.photo, camera=asked.camera)
    cells, uv = matched(scan, photo)
    print(f"{len(uv)} matches")
    # Few of such matches are right, too few for a verdict on matches alone; but the pose is refined against the images,
    # which can still confirm it.
    result = lr.register(scan, photo, cells=cells, uv=uv)
    print(result)
    print("\n".join(result.reasons))
    if asked.json:
        with open(asked.json, "w", encoding="utf-8") as file:
            file.write(result.to_json())
    return 0 if result.accepted else 3


if __name__ == "__main__":
    raise SystemExit(main())
