"""Lists of measurements: made of places in photographs and scan, written as CSV, JSON, GeoJSON or DXF."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from ladarreg_core.errors import DegenerateGeometryError, ExportError, OptionError
from ladarreg_core.export.dxf import DxfEntity, write_dxf
from ladarreg_core.export.json import write_document
from ladarreg_core.formats.documents.places_file import Place
from ladarreg_core.formats.parsing.untrusted import shown_name
from ladarreg_core.foundations.validation import require_choice, require_number
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.measuring.measurement import KINDS, Measurement, MeasurementKind, measure
from ladarreg_core.inspection.measuring.points import PICKED_PX, MeasuredPoints
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.storage.atomic_write import write_bytes

SUFFIXES = (".csv", ".json", ".geojson", ".dxf")
"""How the names of the files end that `write_measurements` writes."""
_CRS = re.compile(r"[A-Za-z][A-Za-z0-9]{0,15}:[A-Za-z0-9._-]{1,32}")
_TEXT_SHARE = 0.02  # height of texts in drawings, of the extent of the points


@dataclass(frozen=True, slots=True, eq=False)
class NamedMeasurement:
    """One entry of a list."""

    name: str
    """Its name in the list."""
    kind: MeasurementKind
    """What was to be measured."""
    measurement: Measurement | None
    """None: it was refused."""
    refusal: str = ""
    """Why it was refused."""
    scan: str = ""
    """Name of the scan that it was measured on; empty: there is one only."""
    own_frame: bool = False
    """Whether its coordinates are in the frame of that scan's own scanner: it is not known where that stands."""

    def as_fields(self) -> dict[str, Any]:
        """Return the entry as JSON-ready values."""
        of = {"scan": self.scan, "frame": "its own scanner"} if self.own_frame else {"scan": self.scan}
        fields = {"name": self.name, **(of if self.scan else {})}
        if self.measurement is None:
            return {**fields, "kind": self.kind, "refused": self.refusal}
        return {**fields, **self.measurement.as_fields()}


def in_frame(
    entry: NamedMeasurement,
    world_from_scanner: Rigid | None,
    *,
    name: str,
    more_flags: Sequence[str] = (),
    sigma_m: float = 0.0,
    sigma_rad: float = 0.0,
) -> NamedMeasurement:
    """Return an entry that was measured in the scanner frame, by another name.

    Args:
        entry: the entry.
        world_from_scanner: the frame of the result; None: the scanner's.
        name: its name in the list.
        more_flags: what is doubtful besides.
        sigma_m: standard deviation of the scanner's position there, m, of all axes together.
        sigma_rad: of its direction, rad.
    """
    if entry.measurement is None:
        return replace(entry, name=name)
    found = entry.measurement
    if world_from_scanner is not None:
        moved = found.points.moved(world_from_scanner, sigma_m=sigma_m, sigma_rad=sigma_rad)
        # a rigid motion changes no length; the side of a plane that is up is that of the scanner
        found = measure("point", moved) if entry.kind == "point" else replace(found, points=moved)
    flags = tuple(dict.fromkeys((*entry.measurement.flags, *more_flags)))
    return replace(entry, name=name, measurement=replace(found, flags=flags))


def measure_places(
    scan: Scan,
    photos: Mapping[str, PoseResult],
    places: Sequence[Place],
    *,
    kind: MeasurementKind | None = None,
    sigma_px: float = PICKED_PX,
    world_from_scanner: Rigid | None = None,
) -> list[NamedMeasurement]:
    """Measure what a list of places asks for.

    Args:
        scan: the scan.
        photos: registered photographs on it, by their names.
        places: the points, in order; those with the same `measurement` belong together. Points as coordinates are in
            the frame of the results.
        kind: what is measured where the places do not say; None: they must.
        sigma_px: standard deviation of picked pixels and cells along each axis.
        world_from_scanner: the frame of the results; None: the scanner's.

    Returns:
        An entry for each measurement, in the order of their first places; what cannot be measured is refused with a
        reason, and the others are measured.

    Raises:
        OptionError: if a photograph is not known, a kind is unknown, missing or contradictory, or `sigma_px` negative.
        ExportError: if the pose of a photograph was refused.
    """
    require_number(sigma_px, "sigma_px", least=0)
    points = _points(scan, photos, places, sigma_px, world_from_scanner)
    viewpoint = np.zeros(3) if world_from_scanner is None else world_from_scanner.translation
    groups: dict[str, list[int]] = {}
    for number, place in enumerate(places):
        groups.setdefault(place.measurement, []).append(number)
    kinds = {name: _kind(name, [places[k].kind for k in rows], kind) for name, rows in groups.items()}
    found = []
    for name, rows in groups.items():
        # points of their own each become a measurement
        sets = [rows] if kinds[name] != "point" else [[row] for row in rows]
        for count, some in enumerate(sets, start=1):
            label = name or kinds[name]
            label = label if len(sets) == 1 else f"{label} {count}"
            try:
                made = measure(kinds[name], points.subset(some), viewpoint=viewpoint)
                found.append(NamedMeasurement(label, kinds[name], made))
            except DegenerateGeometryError as error:
                found.append(NamedMeasurement(label, kinds[name], None, str(error)))
    return found


def _kind(name: str, stated: Sequence[str], default: MeasurementKind | None) -> MeasurementKind:
    words = {word for word in stated if word} or ({default} if default else set())
    what = f"the measurement {name!r}" if name else "what is measured"
    if len(words) != 1:
        said = "not stated" if not words else f"both {' and '.join(sorted(words))}"
        raise OptionError(f"{what} is {said}; state one of {', '.join(KINDS)} by `kind`, or in the column 'kind'")
    (word,) = words
    require_choice(word, KINDS, what)
    return cast(MeasurementKind, word)


def _points(
    scan: Scan, photos: Mapping[str, PoseResult], places: Sequence[Place], sigma_px: float, world: Rigid | None
) -> MeasuredPoints:
    """Return the points of all places, in their order, in the frame of the results."""
    parts: list[MeasuredPoints] = []
    order: list[int] = []
    for where, photo, sigma in dict.fromkeys((place.where, place.photo, place.sigma) for place in places):
        rows = [k for k, place in enumerate(places) if (place.where, place.photo, place.sigma) == (where, photo, sigma)]
        at = np.array([places[k].at for k in rows], np.float64)
        if where == "point":
            parts.append(MeasuredPoints.given(at))
        else:
            if where == "cell":
                found = MeasuredPoints.of_scan(scan, cells=at, sigma_cells=sigma_px)
            elif where == "ray":
                found = MeasuredPoints.of_scan(scan, rays=at, sigma_cells=sigma_px, sigma_rad=sigma)
            else:
                name = _photo(photo, photos)
                picked_px = max(sigma_px, sigma)
                found = MeasuredPoints.of_photo(scan, photos[name], at, sigma_uv_px=picked_px, name=name)
            parts.append(found if world is None else found.moved(world))
        order += rows
    found = MeasuredPoints.joined(parts).subset(np.argsort(order).tolist())
    names = tuple(place.name or name for place, name in zip(places, found.names, strict=True))
    return replace(found, names=names)


def _photo(name: str, photos: Mapping[str, PoseResult]) -> str:
    if not name and len(photos) == 1:
        return next(iter(photos))
    if name in photos:
        return name
    listed = ", ".join(photos) or "none"
    raise OptionError(f"there is no photograph {name!r}; name one of {listed} in the column 'photo'")


def write_measurements(
    path: str | Path, entries: Sequence[NamedMeasurement], *, frame: str = "scanner", crs: str | None = None
) -> None:
    """Write a list of measurements; the name's suffix says how: .csv, .json, .geojson or .dxf.

    Where they are of several scans, each states its scan; those in a frame of their own are in no drawing.

    Args:
        path: the file; an existing one is not replaced.
        entries: the measurements; refused ones are listed as such, drawings leave them out.
        frame: of the coordinates: `scanner` or `world`, stated in the file.
        crs: coordinate reference system of the world, such as EPSG:25832; None: none is stated.

    Raises:
        OptionError: if the suffix is another one, or a reference system is stated for another frame than the world.
        ExportError: if the file exists or cannot be written.
    """
    target, suffix = Path(path), Path(path).suffix.lower()
    check_target(path, frame=frame, crs=crs)
    if suffix == ".csv":
        write_bytes(target, _csv(entries, frame).encode())
    elif suffix == ".json":
        write_document(target, {"version": 1, "frame": frame, "crs": crs, "unit": "m, m2, deg",
                                "measurements": [one.as_fields() for one in entries]})  # fmt: skip
    elif suffix == ".geojson":
        write_bytes(target, (json.dumps(_geojson(entries, frame, crs), allow_nan=False, indent=1) + "\n").encode())
    else:
        write_dxf(target, _drawing(entries), comment=f"frame: {frame}" + (f", {crs}" if crs else ""))


def check_target(path: str | Path, *, frame: str = "scanner", crs: str | None = None) -> None:
    """Refuse a file that `write_measurements` would refuse, before the work.

    Raises:
        OptionError: if its suffix is another one, or a reference system is no code or not of the world.
        ExportError: if it exists, or its folder does not.
    """
    target = Path(path)
    require_choice(target.suffix.lower(), SUFFIXES, f"the suffix of {shown_name(path)}")
    if target.exists():
        raise ExportError(f"{shown_name(path)} exists; give another name, or remove it first")
    if not target.absolute().parent.is_dir():
        raise ExportError(f"the folder of {shown_name(path)} does not exist; create it, or give another one")
    if crs is None:
        return
    if not _CRS.fullmatch(crs):
        raise OptionError(f"the reference system is {crs[:60]!r}; give authority and code, such as EPSG:25832")
    if frame != "world":
        raise OptionError("a reference system is that of the world; choose the frame 'world', too")


def _csv(entries: Sequence[NamedMeasurement], frame: str) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    several = any(one.scan for one in entries)
    scans = ["scan", "frame"] if several else []
    writer.writerow(["name", "kind", "value", "unit", "sigma", "low_95", "high_95", "points", "flags", *scans])
    for one in entries:
        m = one.measurement
        of = [_cell(one.scan), "its own scanner" if one.own_frame else frame] if several else []
        if m is None:
            writer.writerow([_cell(one.name), one.kind, "", "", "", "", "", "", f"refused: {one.refusal}", *of])
            continue
        low, high = m.interval
        numbers = [_numbers(value) for value in (m.value, m.sigma, low, high)]
        places = "; ".join(_numbers(row) for row in m.points.xyz)
        writer.writerow([_cell(one.name), one.kind, numbers[0], m.unit, *numbers[1:], places, "; ".join(m.flags), *of])
    return text.getvalue()


def _cell(text: str) -> str:
    """Return a text that a spreadsheet does not take for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@") else text


def _numbers(values: Any) -> str:
    return " ".join("" if np.isnan(value) else f"{value:.6f}" for value in np.atleast_1d(values))


def _geojson(entries: Sequence[NamedMeasurement], frame: str, crs: str | None) -> dict[str, Any]:
    features = []
    for one in entries:
        m = one.measurement
        fields = one.as_fields()
        points = fields.pop("points", [])
        geometry = None
        if m is not None and not one.own_frame:
            geometry = {"type": "LineString", "coordinates": points}
            if m.kind == "point":
                geometry = {"type": "Point", "coordinates": points[0]}
            elif m.kind == "area":
                geometry = {"type": "Polygon", "coordinates": [[*points, points[0]]]}
            elif m.kind == "height":
                geometry = {"type": "MultiPoint", "coordinates": points}
        features.append({"type": "Feature", "geometry": geometry, "properties": fields})
    document: dict[str, Any] = {"type": "FeatureCollection", "frame": frame, "features": features}
    if crs is not None:
        authority, code = crs.split(":")
        document["crs"] = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{authority.upper()}::{code}"}}
    return document


def _drawing(entries: Sequence[NamedMeasurement]) -> list[DxfEntity]:
    shown = [(one, one.measurement) for one in entries if one.measurement is not None and not one.own_frame]
    every = np.concatenate([m.points.xyz for _, m in shown] or [np.zeros((1, 3))])
    height = max(float(np.ptp(every, axis=0).max()) * _TEXT_SHARE, 0.01)
    drawn: list[DxfEntity] = []
    for one, m in shown:
        xyz = m.points.xyz
        if m.kind in ("point", "height"):
            drawn += [DxfEntity(row[None], m.kind) for row in xyz]
        else:
            drawn.append(DxfEntity(xyz, m.kind, closed=m.kind == "area"))
        label = one.name if m.kind == "point" else f"{one.name}: {m.described}"
        middle = xyz[:1] if m.kind in ("point", "height") else xyz.mean(axis=0, keepdims=True)
        drawn.append(DxfEntity(middle, f"{m.kind}_text", text=label, height=height))
    return drawn
