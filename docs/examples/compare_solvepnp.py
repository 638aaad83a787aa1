"""Compare a pose from given matches with that of OpenCV's solvePnPRansac from the same matches.

    python compare_solvepnp.py scan.npz photo.png matches.csv --camera camera.json --truth truth.json

The matches file is a CSV with a header: row,column,u,v of the scan's grid, or x,y,z,u,v in metres. What solvePnP does
not say: the standard deviations of the pose, and whether it is determined at all.
"""

from __future__ import annotations

import argparse

import cv2
import numpy as np

import ladarreg_core as lr


def solve_pnp(matches: lr.Matches, camera: lr.Camera) -> tuple[lr.Rigid, int]:
    """Return OpenCV's pose, camera from scanner, and its number of inliers."""
    lens = (camera.matrix, np.array(camera.distortion))
    found, turn, moved, inliers = cv2.solvePnPRansac(
        matches.points, matches.uv, *lens, iterationsCount=5000, reprojectionError=3.0
    )
    if not found:
        raise SystemExit("solvePnPRansac found no pose")
    kept = inliers[:, 0]
    turn, moved = cv2.solvePnPRefineLM(matches.points[kept], matches.uv[kept], *lens, turn, moved)
    return lr.Rigid.from_rotvec(turn, moved[:, 0]), len(inliers)


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("photo")
    parser.add_argument("matches")
    parser.add_argument("--camera", help="a camera file; without one the focal length is that of EXIF")
    parser.add_argument("--truth", help="a pose file, if the true pose is known")
    asked = parser.parse_args(words)

    scan, photo = lr.read_scan(asked.scan), lr.read_photo(asked.photo, camera=asked.camera)
    result = lr.register(scan, photo, picks=lr.read_matches(asked.matches, scan))
    print(result)
    theirs, inliers = solve_pnp(result.matches, photo.pinhole)
    ours = result.camera_from_scanner
    print(f"solvePnPRansac: {inliers} of {len(result.matches)} matches are inliers")
    apart_mm, apart_deg = 1000 * ours.distance_to(theirs), np.degrees(ours.angle_to(theirs))
    sigma_mm, sigma_deg = 1000 * result.sigma_position_m, np.degrees(result.sigma_angle_rad)
    print(f"the two poses are {apart_mm:.1f} mm and {apart_deg:.3f} deg apart")
    print(f"standard deviation of ours: {sigma_mm:.1f} mm and {sigma_deg:.3f} deg")
    if asked.truth:
        truth = lr.read_pose(asked.truth)
        for name, pose in (("ladarreg", ours), ("solvePnP", theirs)):
            off_mm, off_deg = 1000 * pose.distance_to(truth), np.degrees(pose.angle_to(truth))
            print(f"{name}: {off_mm:.1f} mm and {off_deg:.3f} deg from the truth")
    return 0 if result.accepted else 3


if __name__ == "__main__":
    raise SystemExit(main())
