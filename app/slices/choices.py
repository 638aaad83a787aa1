"""Literal types that slices share with the rest of the program."""

from __future__ import annotations

from typing import Literal

InputKind = Literal["whole", "coordinates", "names", "text", "duration", "temperature_unit", "switch"]
"""Kind of a field for what a file does not state."""
JobState = Literal["waiting", "running", "paused", "done", "failed", "stopped"]
Control = Literal["pause", "stop", "speed", "step"]
"""What a job lets people do with it."""
ModelDetail = Literal["coarse", "standard", "dense"]
SmoothingShow = Literal["before", "after", "difference"]
SettingOf = Literal["corners", "match", "cull", "constrained", "lines", "simplex", "reject", "robust", "all"]
"""The step that a setting belongs to."""
AcquisitionState = Literal["off", "connecting", "disconnecting", "ready", "jogging", "running", "paused", "fault"]
