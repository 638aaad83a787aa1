"""The table of export targets, in the order in which they are listed."""

from __future__ import annotations

from collections.abc import Sequence

from ladarreg_core.errors import OptionError
from ladarreg_core.export.registered_scan import RegisteredScan, RegisteredSurvey
from ladarreg_core.export.targets.colmap import colmap_files, colmap_refusal
from ladarreg_core.export.targets.e57 import e57_files, e57_refusal
from ladarreg_core.export.targets.kalibr import kalibr_files, kalibr_refusal
from ladarreg_core.export.targets.laz import laz_files, laz_refusal
from ladarreg_core.export.targets.measurements import MeasurementList, measurements_files
from ladarreg_core.export.targets.model import glb_files, obj_files
from ladarreg_core.export.targets.nerfstudio import nerfstudio_files
from ladarreg_core.export.targets.opencv import opencv_files, opencv_refusal
from ladarreg_core.export.targets.ply import ply_files
from ladarreg_core.export.targets.potree import potree_files
from ladarreg_core.export.targets.report import report_files
from ladarreg_core.export.targets.results import results_files
from ladarreg_core.export.targets.ros import ros_files, ros_refusal
from ladarreg_core.export.targets.stations import StationScans, stations_files, stations_refusal
from ladarreg_core.export.targets.target import Target
from ladarreg_core.export.targets.tiles import tiles_files

TARGETS: tuple[Target, ...] = (
    Target(
        name="results",
        title="Results",
        purpose="Pose, report, matches, pictures, coloured cloud and model of a photograph, to look at and to open "
        "again.",
        files=results_files,
        stands_alone=True,
        shows_refused=True,
        shows_drawn=True,
        together=True,
    ),
    Target(
        name="colmap",
        title="COLMAP",
        purpose="Photographs, cameras, poses and the laser's points as a reconstruction, for COLMAP and the programs "
        "that read it.",
        files=colmap_files,
        refusal=colmap_refusal,
        reads=(RegisteredScan, RegisteredSurvey),
    ),
    Target(
        name="nerfstudio",
        title="Splatting",
        purpose="Photographs, poses, depth maps from the laser, masks and an initial cloud for nerfstudio and other "
        "programs for Gaussian splats.",
        files=nerfstudio_files,
        reads=(RegisteredScan, RegisteredSurvey),
    ),
    Target(
        name="e57",
        title="E57",
        purpose="The scan's file as it was, plus colours and the photographs with their poses: for CloudCompare, ReCap "
        "and other programs for laser scans.",
        files=e57_files,
        reads=(RegisteredScan, RegisteredSurvey, StationScans),
        needs="a registered photograph, or stations that are registered to each other",
        refusal=e57_refusal,
    ),
    Target(
        name="ros",
        title="ROS 2",
        purpose="Calibrations, static transforms, a URDF and a recording (MCAP) of cloud and photographs, for ROS 2, "
        "RViz and Foxglove.",
        files=ros_files,
        refusal=ros_refusal,
    ),
    Target(
        name="laz",
        title="LAS / LAZ",
        purpose="The coloured cloud as LAS 1.4, compressed: CloudCompare, QGIS, PDAL, and surveying programs.",
        files=laz_files,
        without_photos=True,
        refusal=laz_refusal,
    ),
    Target(
        name="ply",
        title="PLY cloud",
        purpose="The coloured cloud with intensity, label and uncertainty as fields: CloudCompare, MeshLab, Open3D.",
        files=ply_files,
        without_photos=True,
    ),
    Target(
        name="opencv",
        title="OpenCV",
        purpose="One YAML a photograph with camera matrix, distortion and pose, for programs that call OpenCV.",
        files=opencv_files,
        refusal=opencv_refusal,
    ),
    Target(
        name="kalibr",
        title="Kalibr",
        purpose="Camchains with intrinsics and the relative poses of several cameras, for Kalibr and odometry.",
        files=kalibr_files,
        refusal=kalibr_refusal,
    ),
    Target(
        name="glb",
        title="Textured model, glTF",
        purpose="One file with the mesh and the photographs at their own resolution, for Blender, three.js, Unity and "
        "most viewers.",
        files=glb_files,
    ),
    Target(
        name="obj",
        title="Textured model, OBJ",
        purpose="The same model as OBJ with materials and pictures, for MeshLab, CloudCompare, Rhino and CAD programs.",
        files=obj_files,
    ),
    Target(
        name="tiles",
        title="3D Tiles",
        purpose="The textured model in tiles from coarse to fine, which viewers on the web (Cesium, three.js) load as "
        "they are seen.",
        files=tiles_files,
    ),
    Target(
        name="potree",
        title="Potree",
        purpose="The coloured cloud as an octree with the photographs, flat and 360-degree ones, standing in it, for "
        "Potree in a web page.",
        files=potree_files,
        reads=(RegisteredScan, RegisteredSurvey),
    ),
    Target(
        name="report",
        title="Report",
        purpose="One HTML page a photograph with verdict, figures and pictures, to read, print and sign.",
        files=report_files,
        shows_refused=True,
    ),
    Target(
        name="stations",
        title="Stations",
        purpose="All scans that were registered to each other, each with its pose, and how well they fit.",
        files=stations_files,
        reads=(StationScans,),
        needs="stations that are registered to each other",
        stands_alone=True,
        refusal=stations_refusal,
    ),
    Target(
        name="measurements",
        title="Measurements",
        purpose="What was measured in the workbench, with standard deviations: CSV for tables, DXF for CAD, GeoJSON "
        "for GIS, JSON for programs.",
        files=measurements_files,
        reads=(MeasurementList,),
        needs="measurements, which are made in the workbench",
        stands_alone=True,
    ),
)


def targets_of(names: Sequence[str]) -> tuple[Target, ...]:
    """Return targets by their names, in the order of the table.

    Raises:
        OptionError: if a name is unknown, or there is none.
    """
    known = {target.name: target for target in TARGETS}
    for name in names:
        if name not in known:
            raise OptionError(f"{name!r:.60} is not an export target; use one or several of {', '.join(known)}")
    if not names:
        raise OptionError(f"there is no export target; give one or several of {', '.join(known)}")
    return tuple(target for target in TARGETS if target.name in names)
