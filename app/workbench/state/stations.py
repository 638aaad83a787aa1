"""The stations of a project, for pages: where they stand, how well that is known, and the jobs on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.palette import STATIONS as COLORS
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.project import station_edits
from ladarreg_core.project.station_edits import is_stale, place_of, stated_station

from ...argument_names import as_fields
from ...jobs.inputs import Workspace
from ...jobs.runner import JobContext, JobRunner
from ...jobs.stations import StationJobs
from ...session.cache import IdentityCache
from ...session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.project.document import Document, PhotoCheck, StationEntry
    from ladarreg_core.project.history import Author
    from ladarreg_core.project.source import Source
    from ladarreg_core.registration.stations.registration import PoseUse

    from ...scene import StationShown
    from ...slices.several import Station, StationPair, StationsStep
    from ...slices.several import Stations as StationsSlice

_MAX_POINTS = 200_000
"""Most points of all stations together in a 3-D view."""


class Stations:
    """The stations and their jobs.

    Args:
        workspace: provides the project.
        runner: runs the jobs.
    """

    def __init__(self, workspace: Workspace, runner: JobRunner) -> None:
        self._workspace, self._runner = workspace, runner
        self._jobs = StationJobs(workspace)
        self._slices = IdentityCache()

    @property
    def session(self) -> Session:
        """The session."""
        return self._workspace.session

    def slice(self) -> StationsSlice | None:
        """Return the slice `stations`; None without a further station."""
        document = self.session.document
        if document.scan is None or not document.stations:
            return None
        checks = () if document.survey is None else document.survey.checks
        stale = ",".join(str(k) for k, check in enumerate(checks) if self._is_stale(check))
        rests_on = document.scan, document.stations, document.survey, document.adjusted, stale
        return self._slices.get(("stations", *rests_on), partial(self._made, document, document.scan))

    def _made(self, document: Document, scan: Source) -> StationsSlice:
        survey = document.survey
        names = {} if survey is None else dict(enumerate(one["name"] for one in survey.fields["stations"]))
        listed = [_station(document, None, scan, None)]
        for number, station in enumerate(document.stations):
            listed.append(_station(document, station, station.source, COLORS[number % len(COLORS)]))
        found: StationsSlice = {
            "stations": listed, "stale": is_stale(document), "registered": survey is not None,
            **_progress(document, listed),
            "pairs": [], "loops": [], "reasons": [], "checks": [],
        }  # fmt: skip
        if survey is not None:
            found["pairs"] = [_pair(pair, names) for pair in survey.fields["pairs"]]
            found["loops"] = [
                {
                    "stations": [names[k] for k in loop["stations"]],
                    "error_mm": loop["error_mm"], "error_deg": loop["error_deg"],
                }
                for loop in survey.fields["loops"]
            ]  # fmt: skip
            found["reasons"] = survey.fields["reasons"]
            found["checks"] = [
                {
                    "photo": check.photo,
                    "name": check.name,
                    "station": check.scan.name,
                    "outcome": check.outcome,
                    "sentence": as_fields(check.sentence),
                    "fraction": check.fraction,
                    "stale": self._is_stale(check),
                }
                for check in survey.checks
            ]
        return found

    def _is_stale(self, check: PhotoCheck) -> bool:
        """Return whether the photograph has another pose by now."""
        entry = self.session.document.photo(check.photo)
        return entry is None or entry.pose is None or entry.pose.name != check.pose

    def shown(self) -> tuple[StationShown, ...]:
        """Return the stations whose place is known, for the 3-D scene; those that cannot be read are left out."""
        from ...scene import StationShown

        document, loader = self.session.document, self._workspace.loader
        placed = [
            (number, station, place)
            for number, station in enumerate(document.stations)
            if (place := place_of(document, station)) is not None
        ]
        found = []
        for number, station, place in placed:
            try:
                points = loader.station_points(station.source)
            except LadarregError:
                continue  # the list of stations states it when they are registered
            step = -(-len(points) * len(placed) // _MAX_POINTS)
            found.append(StationShown(station.id, points[:: max(1, step)], place, COLORS[number % len(COLORS)]))
        return tuple(found)

    def register(self, poses: object, author: Author) -> str:
        """Start registering the stations and return the job's id; raises `LadarregError` if it cannot begin."""
        from ladarreg_core.registration.stations.registration import POSE_USES

        self._jobs.require_stations()
        require_choice(poses, POSE_USES, "'Poses in the files'")

        work = partial(self._jobs.register, poses=cast("PoseUse", poses))
        return self._start("register_stations", "Register stations", work, author)

    def check_photos(self, author: Author) -> str:
        """Start verifying the photographs at the other stations; raises as `register`."""
        self._jobs.require_survey()
        return self._start("check_at_stations", "Check photographs at the stations", self._jobs.check_photos, author)

    def remove(self, station: object, author: Author) -> None:
        """Remove a station from the project; raises `OptionError` if it is not there."""
        name = station_edits.require_station(self.session.document, station).source.name
        self.session.commit(
            f"Remove station {name}", lambda d: station_edits.without_station(d, station), author=author
        )

    def place(self, station: object, rough: Rigid | None, author: Author) -> None:
        """Give a station a rough place, or take it away; raises `OptionError` if it is not there."""
        name = station_edits.require_station(self.session.document, station).source.name
        label = f"{'Place' if rough is not None else 'Forget the place of'} station {name}"
        self.session.commit(
            label, lambda d: station_edits.with_rough_place(d, station, rough), author=author,
            merge_key=f"station {station}",
        )  # fmt: skip

    def show(self, station: object, author: Author) -> None:
        """Show another station's scan; raises `LadarregError` if it cannot be read."""
        source = station_edits.require_station(self.session.document, station).source
        self._workspace.loader.preload_scan(source)
        self.session.commit(
            f"Show station {source.name}", lambda d: station_edits.with_station_shown(d, station), author=author
        )

    def _start(self, kind: str, label: str, work: Callable[[JobContext], str], author: Author) -> str:
        return self._runner.start(kind, work, label=label, photo="", author=author)


def _progress(document: Document, listed: Sequence[Station]) -> StationsStep:
    """Return the tick of the step with its sentences."""
    from ladarreg_core.project.work_steps import stations_step

    current = document.survey is not None and not is_stale(document)
    done, status, missing = stations_step([one["state"] for one in listed], current=current)
    return {"done": done, "status": status, "missing": missing}


def _station(
    document: Document, station: StationEntry | None, source: Source, color: tuple[int, int, int] | None
) -> Station:
    """Return an entry of the list; `station` is None for the scan that is shown."""
    from ladarreg_core.frames import Rigid

    found: Station = {
        "id": None if station is None else station.id, "name": source.name, "files": list(source.names),
        "index": source.index,
        "colour": None if color is None else "#{:02x}{:02x}{:02x}".format(*color),
        "state": "waiting", "sigma_mm": None, "sigma_deg": None, "place": None, "rough": False,
    }  # fmt: skip
    stated = stated_station(document.survey, source)
    if stated is not None:
        found["state"] = stated["state"]
        found["sigma_mm"], found["sigma_deg"] = _largest(stated["sigma_mm"]), _largest(stated["sigma_deg"])
    adjusted = None if document.adjusted is None else document.adjusted.scan(source)
    if stated is None and adjusted is not None and adjusted.world_from_scanner is not None:
        found["state"] = "fixed" if adjusted.sigma_m is None else "registered"
        found["sigma_mm"] = None if adjusted.sigma_m is None else 1000 * adjusted.sigma_m
        found["sigma_deg"] = None if adjusted.sigma_rad is None else float(np.degrees(adjusted.sigma_rad))
    place = Rigid.identity() if station is None else place_of(document, station)
    if place is not None:
        x, y, z = place.translation.tolist()
        yaw = float(np.degrees(np.arctan2(place.rotation[1, 0], place.rotation[0, 0])))
        found["place"] = {"x": x, "y": y, "z": z, "yaw_deg": yaw}
    found["rough"] = station is not None and station.rough is not None
    return found


def _largest(values: Sequence[float | None] | None) -> float | None:
    known = [value for value in values or () if value is not None]
    return max(known) if values and len(known) == len(values) else None


def _pair(pair: Mapping[str, Any], names: Mapping[int, str]) -> StationPair:
    return {
        "first": names[pair["first"]], "second": names[pair["second"]], "verdict": pair["verdict"],
        "reasons": [as_fields(reason) for reason in pair["reasons"]], "overlap": pair["evidence"]["overlap"],
        "sigma_mm": pair["sigma_mm"], "sigma_deg": pair["sigma_deg"],
    }  # fmt: skip
