"""The commands by which clients drive a pan/tilt unit and a scanner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from ladarreg_core.errors import OptionError
from ladarreg_core.project import edits

from .acquisition import Acquisition
from .clients import Client
from .files import Files

Fields = Mapping[str, Any]
Reply = dict[str, Any]


class Acquiring(Protocol):
    """The parts of the workbench that these commands use."""

    acquisition: Acquisition
    files: Files


def acquire_ports(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Return the serial ports of the server, and an example of a plan."""
    return context.acquisition.ports()


def acquire_check(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Return the faults of a plan, and what its run will be."""
    return context.acquisition.check(_plan(fields))


def acquire_keep(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Keep a plan that is being edited in the project."""
    context.acquisition.keep(_plan(fields))
    return {}


def acquire_connect(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Connect to the devices of a plan."""
    context.acquisition.connect(client, _plan(fields))
    return {}


def acquire_disconnect(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Stop everything and disconnect."""
    context.acquisition.disconnect(client)
    return {}


def acquire_jog(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Move the unit by some degrees."""
    pan, tilt = (edits.finite(fields.get(name)) for name in ("pan_deg", "tilt_deg"))
    if pan is None or tilt is None:
        raise OptionError("give the degrees to move, of pan and of tilt")
    context.acquisition.jog(client, pan, tilt)
    return {}


def acquire_start(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Begin a run, or go on with one of the project."""
    resume = fields.get("resume")
    if resume is not None and not isinstance(resume, str):
        raise OptionError("the run to go on with is the name of one")
    context.acquisition.start(client, {} if resume is not None else _plan(fields), resume=resume)
    return {}


def acquire_pause(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Have the run wait after the piece that is being measured."""
    context.acquisition.pause(client)
    return {}


def acquire_resume(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Have a run that waits go on."""
    context.acquisition.resume(client)
    return {}


def acquire_stop(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Halt the unit and switch the laser off at once."""
    context.acquisition.stop()
    return {}


def acquire_take_over(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Drive the devices from now on."""
    context.acquisition.take_over(client)
    return {}


def acquire_open(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Open the panorama of a finished run as the project's scan."""
    run = fields.get("run")
    context.acquisition.open_panorama(client, run if isinstance(run, str) else None)
    return {}


def acquire_photos(context: Acquiring, client: Client, fields: Fields) -> Reply:
    """Add the photographs of a run to the project."""
    run = fields.get("run")
    if not isinstance(run, str):
        raise OptionError("say whose photographs are wanted: give the name of a run")
    found = context.acquisition.photos(run)
    for path, name in found:
        context.files.open(path, name, "photo", None, client)
    return {"photos": len(found)}


ACQUISITION_COMMANDS = (
    acquire_ports, acquire_check, acquire_keep, acquire_connect, acquire_disconnect, acquire_jog, acquire_start,
    acquire_pause, acquire_resume, acquire_stop, acquire_take_over, acquire_open, acquire_photos,
)  # fmt: skip


def _plan(fields: Fields) -> Fields:
    plan = fields.get("plan")
    if not isinstance(plan, Mapping):
        raise OptionError("the plan is an object")
    return plan
