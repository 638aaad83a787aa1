"""The commands on the stations of a project."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from ladarreg_core.project import station_edits

from .clients import Client
from .stations import Stations

Fields = Mapping[str, Any]
Reply = dict[str, Any]


class WithStations(Protocol):
    """The part of the workbench that these commands use."""

    stations: Stations


def register_stations(context: WithStations, client: Client, fields: Fields) -> Reply:
    """Register the stations to each other; `poses` says what those in their files are used for."""
    return {"job": context.stations.register(fields.get("poses", "refine"), client.author)}


def check_at_stations(context: WithStations, client: Client, fields: Fields) -> Reply:
    """Verify the registered photographs at the other stations."""
    return {"job": context.stations.check_photos(client.author)}


def export_stations(context: WithStations, client: Client, fields: Fields) -> Reply:
    """Export all stations with their poses, as a zip."""
    return {"job": context.stations.export(client.author)}


def place_station(context: WithStations, client: Client, fields: Fields) -> Reply:
    """Give a station a rough place where its search begins, or take it away."""
    place = fields.get("place")
    rough = station_edits.rough_pose(place if isinstance(place, Mapping) else {}) if place is not None else None
    context.stations.place(fields.get("station"), rough, client.author)
    return {}


def show_station(context: WithStations, client: Client, fields: Fields) -> Reply:
    """Show another station's scan, to which photographs are registered from now on."""
    context.stations.show(fields.get("station"), client.author)
    return {}


def remove_station(context: WithStations, client: Client, fields: Fields) -> Reply:
    """Remove a station from the project."""
    context.stations.remove(fields.get("station"), client.author)
    return {}


STATION_COMMANDS = (
    register_stations, check_at_stations, export_stations, place_station, show_station, remove_station,
)  # fmt: skip
