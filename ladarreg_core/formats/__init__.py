"""Readers and writers of files; formats are recognised by content.

The names below are imported when they are first used: a process that only passes files on loads no reader.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ladarreg_core.formats.cameras.camera_file import read_camera as read_camera
    from ladarreg_core.formats.documents.matches_file import read_matches as read_matches
    from ladarreg_core.formats.documents.pose_file import read_pose as read_pose
    from ladarreg_core.formats.documents.registration_file import read_registration as read_registration
    from ladarreg_core.formats.e57_images import extract_images as extract_images
    from ladarreg_core.formats.file_info import FileInfo as FileInfo
    from ladarreg_core.formats.photo_file import read_photo as read_photo
    from ladarreg_core.formats.registry import FORMATS as FORMATS
    from ladarreg_core.formats.registry import describe as describe
    from ladarreg_core.formats.registry import listed_kind as listed_kind
    from ladarreg_core.formats.registry import read_scan as read_scan
    from ladarreg_core.formats.registry import recognise as recognise
    from ladarreg_core.formats.survey import survey_file as survey_file

_MODULE_OF = {
    "FORMATS": "registry",
    "FileInfo": "file_info",
    "describe": "registry",
    "extract_images": "e57_images",
    "listed_kind": "registry",
    "read_camera": "cameras.camera_file",
    "read_matches": "documents.matches_file",
    "read_photo": "photo_file",
    "read_pose": "documents.pose_file",
    "read_registration": "documents.registration_file",
    "read_scan": "registry",
    "recognise": "registry",
    "survey_file": "survey",
}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value
