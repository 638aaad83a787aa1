"""Register laser scans with photographs taken from somewhere else, and know how good the result is.

Everything public is reached from here and imported when it is first used, so that `import ladarreg_core` costs
nothing.
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING, Any

from ladarreg_core.foundations.version import VERSION

if TYPE_CHECKING:
    from ladarreg_core.batches.jobs.cluster import cluster as cluster
    from ladarreg_core.batches.jobs.job import Job as Job
    from ladarreg_core.batches.jobs.job_list import read_jobs as read_jobs
    from ladarreg_core.batches.jobs.run import BatchProgress as BatchProgress
    from ladarreg_core.batches.jobs.run import batch as batch
    from ladarreg_core.batches.jobs.run_folder import BatchResult as BatchResult
    from ladarreg_core.batches.photos.photo_run import register_photos as register_photos
    from ladarreg_core.batches.photos.photo_summary import PhotosResult as PhotosResult
    from ladarreg_core.camera import Camera as Camera
    from ladarreg_core.camera import EquirectangularCamera as EquirectangularCamera
    from ladarreg_core.camera import FisheyeCamera as FisheyeCamera
    from ladarreg_core.camera import camera_from_json as camera_from_json
    from ladarreg_core.errors import Cancelled as Cancelled
    from ladarreg_core.errors import LadarregError as LadarregError
    from ladarreg_core.export.outputs.rig_folder import read_rig as read_rig
    from ladarreg_core.export.registered_scan import RegisteredPhoto as RegisteredPhoto
    from ladarreg_core.export.registered_scan import RegisteredScan as RegisteredScan
    from ladarreg_core.export.targets.folder import export_registration as export_registration
    from ladarreg_core.export.targets.pipeline import export_to as export_to
    from ladarreg_core.formats import read_camera as read_camera
    from ladarreg_core.formats import read_matches as read_matches
    from ladarreg_core.formats import read_photo as read_photo
    from ladarreg_core.formats import read_pose as read_pose
    from ladarreg_core.formats import read_registration as read_registration
    from ladarreg_core.formats import read_scan as read_scan
    from ladarreg_core.foundations.progress import Progress as Progress
    from ladarreg_core.frames import Rigid as Rigid
    from ladarreg_core.frames import ThesisParameters as ThesisParameters
    from ladarreg_core.fusion.fused_model import FusedModel as FusedModel
    from ladarreg_core.fusion.fused_model import fuse as fuse
    from ladarreg_core.inspection.measuring.change import Change as Change
    from ladarreg_core.inspection.measuring.change import change as change
    from ladarreg_core.inspection.measuring.change_files import write_change as write_change
    from ladarreg_core.inspection.measuring.developable import Cylinder as Cylinder
    from ladarreg_core.inspection.measuring.developable import Plane as Plane
    from ladarreg_core.inspection.measuring.measurement import Measurement as Measurement
    from ladarreg_core.inspection.measuring.measurement import measure as measure
    from ladarreg_core.inspection.measuring.measurement_list import write_measurements as write_measurements
    from ladarreg_core.inspection.measuring.points import MeasuredPoints as MeasuredPoints
    from ladarreg_core.inspection.measuring.rectified import RectifiedView as RectifiedView
    from ladarreg_core.inspection.measuring.rectified import rectify as rectify
    from ladarreg_core.inspection.measuring.section import section as section
    from ladarreg_core.inspection.measuring.view_files import write_view as write_view
    from ladarreg_core.inspection.notebook import views as views
    from ladarreg_core.inspection.notebook.progress import NotebookProgress as NotebookProgress
    from ladarreg_core.matches import Matches as Matches
    from ladarreg_core.matches import Pick as Pick
    from ladarreg_core.matches import picks_of_arrays as picks_of_arrays
    from ladarreg_core.matching.auto_options import AutoOptions as AutoOptions
    from ladarreg_core.matching.image_check import ImageCheck as ImageCheck
    from ladarreg_core.matching.image_check import with_image_check as with_image_check
    from ladarreg_core.matching.images.kept_channels import Channels as Channels
    from ladarreg_core.photo import Photo as Photo
    from ladarreg_core.pose.estimate import PoseOptions as PoseOptions
    from ladarreg_core.pose.estimate import estimate_pose as estimate_pose
    from ladarreg_core.registration.comparison import compare as compare
    from ladarreg_core.registration.given import given_pose as given_pose
    from ladarreg_core.registration.given import verify_pose as verify_pose
    from ladarreg_core.registration.register import RegisterOptions as RegisterOptions
    from ladarreg_core.registration.register import register as register
    from ladarreg_core.registration.rig.options import RigOptions as RigOptions
    from ladarreg_core.registration.rig.registration import register_rig as register_rig
    from ladarreg_core.registration.rig.results import RigPair as RigPair
    from ladarreg_core.registration.rig.results import RigResult as RigResult
    from ladarreg_core.registration.rig.unit_camera import UnitCamera as UnitCamera
    from ladarreg_core.registration.rig.unit_camera import register_unit_camera as register_unit_camera
    from ladarreg_core.registration.stations.registration import register_scans as register_scans
    from ladarreg_core.registration.stations.results import StationNetwork as StationNetwork
    from ladarreg_core.registration.stations.results import StationPair as StationPair
    from ladarreg_core.registration.stations.survey_target import SurveyTarget as SurveyTarget
    from ladarreg_core.registration.stations.target_names import name_targets as name_targets
    from ladarreg_core.registration.stations.target_pose import TargetNetwork as TargetNetwork
    from ladarreg_core.registration.stations.target_pose import TargetRegistration as TargetRegistration
    from ladarreg_core.registration.stations.target_pose import register_targets as register_targets
    from ladarreg_core.registration.stations.target_search import find_targets as find_targets
    from ladarreg_core.registration.stations.targets import fit_target as fit_target
    from ladarreg_core.results.compared_blocks import ComparedBlocks as ComparedBlocks
    from ladarreg_core.results.registration import PoseResult as PoseResult
    from ladarreg_core.results.registration import Registration as Registration
    from ladarreg_core.results.steps import Step as Step
    from ladarreg_core.scan import Scan as Scan
    from ladarreg_core.simulate import simulate_case as simulate_case
    from ladarreg_core.surface.perspective import View as View
    from ladarreg_core.surface.perspective import perspective_view as perspective_view
    from ladarreg_core.surface.texture.best_photo import PosedPhoto as PosedPhoto
    from ladarreg_core.surface.texture.photo_points import PhotoPoints as PhotoPoints
    from ladarreg_core.surface.texture.photo_points import PhotoPointsWithNormals as PhotoPointsWithNormals
    from ladarreg_core.surface.texture.photo_points import xyz_of_photo as xyz_of_photo
    from ladarreg_core.surface.texture.registered_texture import Label as Label
    from ladarreg_core.surface.texture.registered_texture import RegisteredTexture as RegisteredTexture
    from ladarreg_core.surface.texture.registered_texture import intensity_picture as intensity_picture
    from ladarreg_core.surface.texture.registered_texture import texture_scan as texture_scan
    from ladarreg_core.survey.adjust import adjust as adjust
    from ladarreg_core.survey.adjustment import AdjustedLine as AdjustedLine
    from ladarreg_core.survey.adjustment import AdjustedTie as AdjustedTie
    from ladarreg_core.survey.adjustment import Adjustment as Adjustment
    from ladarreg_core.survey.audit import Audit as Audit
    from ladarreg_core.survey.audit import audit as audit
    from ladarreg_core.survey.outputs import write_adjustment as write_adjustment
    from ladarreg_core.survey.parts import ScanLine as ScanLine
    from ladarreg_core.survey.parts import SurveyCamera as SurveyCamera
    from ladarreg_core.survey.parts import SurveyLine as SurveyLine
    from ladarreg_core.survey.parts import SurveyPhoto as SurveyPhoto
    from ladarreg_core.survey.parts import SurveyScan as SurveyScan
    from ladarreg_core.survey.parts import SurveyTie as SurveyTie
    from ladarreg_core.survey.survey import Survey as Survey

__version__ = VERSION

_HOMES = {
    "AdjustedLine": "survey.adjustment",
    "AdjustedTie": "survey.adjustment",
    "Adjustment": "survey.adjustment",
    "Audit": "survey.audit",
    "AutoOptions": "matching.auto_options",
    "BatchProgress": "batches.jobs.run",
    "BatchResult": "batches.jobs.run_folder",
    "Camera": "camera",
    "Cancelled": "errors",
    "Change": "inspection.measuring.change",
    "Channels": "matching.images.kept_channels",
    "ComparedBlocks": "results.compared_blocks",
    "Cylinder": "inspection.measuring.developable",
    "EquirectangularCamera": "camera",
    "FisheyeCamera": "camera",
    "FusedModel": "fusion.fused_model",
    "ImageCheck": "matching.image_check",
    "Job": "batches.jobs.job",
    "Label": "surface.texture.registered_texture",
    "LadarregError": "errors",
    "Matches": "matches",
    "MeasuredPoints": "inspection.measuring.points",
    "Measurement": "inspection.measuring.measurement",
    "NotebookProgress": "inspection.notebook.progress",
    "Photo": "photo",
    "PhotoPoints": "surface.texture.photo_points",
    "PhotoPointsWithNormals": "surface.texture.photo_points",
    "PhotosResult": "batches.photos.photo_summary",
    "Pick": "matches",
    "Plane": "inspection.measuring.developable",
    "PoseOptions": "pose.estimate",
    "PoseResult": "results.registration",
    "PosedPhoto": "surface.texture.best_photo",
    "Progress": "foundations.progress",
    "RectifiedView": "inspection.measuring.rectified",
    "RegisterOptions": "registration.register",
    "RegisteredPhoto": "export.registered_scan",
    "RegisteredScan": "export.registered_scan",
    "RegisteredTexture": "surface.texture.registered_texture",
    "Registration": "results.registration",
    "RigOptions": "registration.rig.options",
    "RigPair": "registration.rig.results",
    "RigResult": "registration.rig.results",
    "Rigid": "frames",
    "Scan": "scan",
    "ScanLine": "survey.parts",
    "StationNetwork": "registration.stations.results",
    "StationPair": "registration.stations.results",
    "Step": "results.steps",
    "Survey": "survey.survey",
    "SurveyCamera": "survey.parts",
    "SurveyLine": "survey.parts",
    "SurveyPhoto": "survey.parts",
    "SurveyScan": "survey.parts",
    "SurveyTie": "survey.parts",
    "SurveyTarget": "registration.stations.survey_target",
    "TargetNetwork": "registration.stations.target_pose",
    "TargetRegistration": "registration.stations.target_pose",
    "ThesisParameters": "frames",
    "View": "surface.perspective",
    "adjust": "survey.adjust",
    "audit": "survey.audit",
    "batch": "batches.jobs.run",
    "camera_from_json": "camera",
    "cluster": "batches.jobs.cluster",
    "change": "inspection.measuring.change",
    "compare": "registration.comparison",
    "estimate_pose": "pose.estimate",
    "export_registration": "export.targets.folder",
    "export_to": "export.targets.pipeline",
    "find_targets": "registration.stations.target_search",
    "fit_target": "registration.stations.targets",
    "fuse": "fusion.fused_model",
    "given_pose": "registration.given",
    "intensity_picture": "surface.texture.registered_texture",
    "measure": "inspection.measuring.measurement",
    "name_targets": "registration.stations.target_names",
    "perspective_view": "surface.perspective",
    "picks_of_arrays": "matches",
    "read_camera": "formats",
    "read_jobs": "batches.jobs.job_list",
    "read_matches": "formats",
    "read_photo": "formats",
    "read_pose": "formats",
    "read_registration": "formats",
    "read_rig": "export.outputs.rig_folder",
    "read_scan": "formats",
    "rectify": "inspection.measuring.rectified",
    "register": "registration.register",
    "register_photos": "batches.photos.photo_run",
    "register_rig": "registration.rig.registration",
    "register_unit_camera": "registration.rig.unit_camera",
    "UnitCamera": "registration.rig.unit_camera",
    "register_scans": "registration.stations.registration",
    "register_targets": "registration.stations.target_pose",
    "section": "inspection.measuring.section",
    "simulate_case": "simulate",
    "texture_scan": "surface.texture.registered_texture",
    "verify_pose": "registration.given",
    "views": "inspection.notebook.views",
    "with_image_check": "matching.image_check",
    "write_adjustment": "survey.outputs",
    "write_change": "inspection.measuring.change_files",
    "write_measurements": "inspection.measuring.measurement_list",
    "write_view": "inspection.measuring.view_files",
    "xyz_of_photo": "surface.texture.photo_points",
}
__all__ = sorted(_HOMES)

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = importlib.import_module(f"{__name__}.{_HOMES[name]}")
    value = getattr(home, name, home)  # `views` is a module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
