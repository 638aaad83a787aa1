"""The part of ONVIF that drives a pan/tilt head: requests to XML, XML to what it states; no I/O.

Messages are SOAP 1.2. A device has services (device, media, PTZ), each at an address of its own. A movement is asked
for with the token of a media profile that has a PTZ configuration, in one of the coordinate systems (spaces) that the
node behind it lists: degrees, in which X grows to the right and Y upward, or parts of its full range from -1 to 1,
which say nothing about degrees. The position that it states is always in the default space of the configuration.

Requests are signed by a digest of a nonce, the time and the password. A device refuses a time too far from its own,
so it states its time without authentication.

Source: ONVIF PTZ Service Specification 25.12 (5.2 nodes, 5.3 configurations, 5.4 moves and status, 5.8 predefined
spaces) with `ptz.wsdl`, `common.xsd`, `onvif.xsd`, `devicemgmt.wsdl` and `media.wsdl`; ONVIF Core Specification; OASIS
Web Services Security UsernameToken Profile 1.0.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal
from urllib.parse import urlsplit, urlunsplit
from xml.etree import ElementTree
from xml.sax.saxutils import escape, quoteattr

from ladarreg_core.errors import DeviceError, DeviceGlitchError, FormatError
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.formats.parsing.xml_file import parsed_xml

Service = Literal["device", "media", "ptz"]
NAMESPACES: dict[str, str] = {
    "device": "http://www.onvif.org/ver10/device/wsdl",
    "media": "http://www.onvif.org/ver10/media/wsdl",
    "ptz": "http://www.onvif.org/ver20/ptz/wsdl",
    "tt": "http://www.onvif.org/ver10/schema",
    "s": "http://www.w3.org/2003/05/soap-envelope",
}
_WSS = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-"
_SPACES = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/"
DEGREES, GENERIC = _SPACES + "SphericalPositionSpaceDegrees", _SPACES + "PositionGenericSpace"
SPEED_DEGREES = _SPACES + "SpeedSpaceDegrees"
Range = tuple[float, float]


class OnvifError(DeviceGlitchError):
    """An answer that the specification does not have."""


class OnvifRefusalError(DeviceError):
    """A fault that the device states: asking again does not mend it.

    Args:
        text: what happened.
        codes: of the fault, the specific one last, e.g. `("Sender", "NotAuthorized")`.
    """

    def __init__(self, text: str, codes: tuple[str, ...]) -> None:
        super().__init__(text)
        self.codes = codes


@dataclass(frozen=True, slots=True)
class Vector:
    """A position in a space of the head."""

    x: float
    y: float
    space: str


@dataclass(frozen=True, slots=True)
class PtzProfile:
    """A media profile by which the head is moved."""

    token: str
    node: str
    space: str
    """In which positions are stated: the default of its configuration."""


@dataclass(frozen=True, slots=True)
class PtzNode:
    """What a head can do."""

    positions: dict[str, tuple[Range, Range]]
    """Ranges of X and Y of each space for absolute positions, by its URI."""
    speeds: dict[str, Range]
    """Range of each space for speeds."""


@dataclass(frozen=True, slots=True)
class PtzStatus:
    """Where a head is."""

    position: Vector | None
    moves: bool | None
    """Whether it moves; None: it does not say, or does not know."""
    error: str


# -- requests ----------------------------------------------------------------------------------------------------------


def request(service: Service, operation: str, content: str = "", *, security: str = "") -> bytes:
    """Return a request.

    Args:
        service: whose operation it is.
        operation: its name.
        content: XML within it, prefixes `o` of the service and `tt` of the schema.
        security: header by `signed`; empty: unsigned.
    """
    header = f"<s:Header>{security}</s:Header>" if security else ""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><s:Envelope xmlns:s="{NAMESPACES["s"]}" '
        f'xmlns:o="{NAMESPACES[service]}" xmlns:tt="{NAMESPACES["tt"]}">{header}<s:Body><o:{operation}>{content}'
        f"</o:{operation}></s:Body></s:Envelope>"
    ).encode()


def signed(user: str, password: str, *, nonce: bytes, created: datetime) -> str:
    """Return the header that signs a request.

    Args:
        user: name at the device.
        password: its password.
        nonce: random bytes, never used before.
        created: the time of the device, UTC.
    """
    stamp = created.strftime("%Y-%m-%dT%H:%M:%S.") + f"{created.microsecond // 1000:03d}Z"
    digest = hashlib.sha1(nonce + stamp.encode() + password.encode(), usedforsecurity=False).digest()
    return (
        f'<w:Security xmlns:w="{_WSS}wssecurity-secext-1.0.xsd" xmlns:u="{_WSS}wssecurity-utility-1.0.xsd" '
        f's:mustUnderstand="true"><w:UsernameToken><w:Username>{escape(user)}</w:Username>'
        f'<w:Password Type="{_WSS}username-token-profile-1.0#PasswordDigest">{_base64(digest)}</w:Password>'
        f'<w:Nonce EncodingType="{_WSS}soap-message-security-1.0#Base64Binary">{_base64(nonce)}</w:Nonce>'
        f"<u:Created>{stamp}</u:Created></w:UsernameToken></w:Security>"
    )


def of_profile(token: str, content: str = "") -> str:
    """Return the content of a request about a profile."""
    return f"<o:ProfileToken>{escape(token)}</o:ProfileToken>{content}"


def absolute_move(token: str, to: Vector, *, speed_deg_s: float | None) -> str:
    """Return the content of `AbsoluteMove`, at a speed if one is given."""
    speed = "" if speed_deg_s is None else (
        f"<o:Speed>{_vector(Vector(speed_deg_s, speed_deg_s, SPEED_DEGREES))}</o:Speed>"
    )  # fmt: skip
    return of_profile(token, f"<o:Position>{_vector(to)}</o:Position>{speed}")


def stop(token: str) -> str:
    """Return the content of `Stop`, which stops pan and tilt, and leaves the lens alone."""
    return of_profile(token, "<o:PanTilt>true</o:PanTilt><o:Zoom>false</o:Zoom>")


# -- answers -----------------------------------------------------------------------------------------------------------


def answer(data: bytes, service: Service, operation: str) -> ElementTree.Element:
    """Return what an answer contains.

    Args:
        data: the answer, whatever it is.
        service: that was asked.
        operation: that was asked for.

    Raises:
        OnvifRefusalError: if it is a fault.
        OnvifError: if it is no answer to that.
    """
    try:
        root = parsed_xml(data, "an answer of a pan/tilt head")
    except FormatError as error:
        raise OnvifError(f"the pan/tilt unit sent {_shown(data)} in answer to {operation}: {error}") from error
    body = root.find("s:Body", NAMESPACES) if root.tag == f"{{{NAMESPACES['s']}}}Envelope" else None
    if body is None:
        raise OnvifError(
            f"the pan/tilt unit sent {_shown(data)} in answer to {operation}, which is no message of SOAP 1.2; check "
            "that the address is that of its ONVIF device service"
        )
    fault = body.find("s:Fault", NAMESPACES)
    if fault is not None:
        codes = tuple(
            (each.text or "").strip().rpartition(":")[2] for each in fault.iterfind("s:Code//s:Value", NAMESPACES)
        )
        said = "; ".join(one_line(each.text or "", 200) for each in fault.iterfind("s:Reason/s:Text", NAMESPACES))
        raise OnvifRefusalError(
            f"the pan/tilt unit refused {operation}: {' '.join(codes) or 'no code'}{f' ({said})' if said else ''}",
            codes,
        )
    found = body.find(f"{service}:{operation}Response", NAMESPACES)
    if found is None:
        raise OnvifError(f"the pan/tilt unit sent {_shown(data)} in answer to {operation}; check its address")
    return found


def device_time(found: ElementTree.Element) -> datetime:
    """Return the time of the device, UTC, in the answer to `GetSystemDateAndTime`."""
    at = "device:SystemDateAndTime/tt:UTCDateTime/"
    names = ("Date/tt:Year", "Date/tt:Month", "Date/tt:Day", "Time/tt:Hour", "Time/tt:Minute", "Time/tt:Second")
    try:
        year, month, day, hour, minute, second = (int(_text(found, f"{at}tt:{name}")) for name in names)
        return datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC)
    except ValueError as error:
        raise OnvifError("the pan/tilt unit states no time (UTCDateTime); set its clock") from error


def service_addresses(found: ElementTree.Element, asked_at: str) -> dict[str, str]:
    """Return the address of each service by its namespace, in the answer to `GetServices`.

    The host is the one that was asked: a device behind a router states the one that it has itself.
    """
    here = urlsplit(asked_at)
    addresses = {}
    for service in found.iterfind("device:Service", NAMESPACES):
        there = urlsplit(_text(service, "device:XAddr"))
        moved = here.netloc if there.path else ""
        addresses[_text(service, "device:Namespace")] = urlunsplit(
            (here.scheme, moved, there.path or here.path, there.query, "")
        )
    return addresses


def device_model(found: ElementTree.Element) -> str:
    """Return maker, model and firmware, in the answer to `GetDeviceInformation`."""
    names = ("Manufacturer", "Model", "FirmwareVersion")
    parts = [" ".join(_text(found, f"device:{name}").split()) for name in names]
    return " ".join(filter(None, parts))[:120] or "ONVIF head"


def ptz_profiles(found: ElementTree.Element) -> list[PtzProfile]:
    """Return the profiles that have a PTZ configuration, in the answer to `GetProfiles`."""
    profiles = []
    for each in found.iterfind("media:Profiles", NAMESPACES):
        configuration = each.find("tt:PTZConfiguration", NAMESPACES)
        if configuration is not None:
            # The schema has the name of the element so.
            space = _text(configuration, "tt:DefaultAbsolutePantTiltPositionSpace") or GENERIC
            profiles.append(PtzProfile(each.get("token", ""), _text(configuration, "tt:NodeToken"), space))
    return profiles


def ptz_nodes(found: ElementTree.Element) -> dict[str, PtzNode]:
    """Return the nodes by their tokens, in the answer to `GetNodes`."""
    nodes = {}
    for each in found.iterfind("ptz:PTZNode", NAMESPACES):
        spaces = "tt:SupportedPTZSpaces/tt:"
        positions = {
            _text(one, "tt:URI"): (_range(one, "tt:XRange"), _range(one, "tt:YRange"))
            for one in each.iterfind(f"{spaces}AbsolutePanTiltPositionSpace", NAMESPACES)
        }
        speeds = {
            _text(one, "tt:URI"): _range(one, "tt:XRange")
            for one in each.iterfind(f"{spaces}PanTiltSpeedSpace", NAMESPACES)
        }
        nodes[each.get("token", "")] = PtzNode(positions, speeds)
    return nodes


def ptz_status(found: ElementTree.Element, default_space: str) -> PtzStatus:
    """Return where the head is, in the answer to `GetStatus`."""
    status = found.find("ptz:PTZStatus", NAMESPACES)
    if status is None:
        raise OnvifError("the pan/tilt unit answered GetStatus by no status")
    at = status.find("tt:Position/tt:PanTilt", NAMESPACES)
    position = None
    if at is not None:
        x, y = _number(at.get("x")), _number(at.get("y"))
        if not (math.isfinite(x) and math.isfinite(y)):
            raise OnvifError("the pan/tilt unit states a position that is no number")
        position = Vector(x, y, at.get("space") or default_space)
    move = _text(status, "tt:MoveStatus/tt:PanTilt").upper()
    moves = {"IDLE": False, "MOVING": True}.get(move)
    return PtzStatus(position, moves, one_line(_text(status, "tt:Error"), 120))


def _text(element: ElementTree.Element, path: str) -> str:
    found = element.find(path, NAMESPACES)
    return (found.text or "").strip() if found is not None else ""


def _range(element: ElementTree.Element, path: str) -> Range:
    low, high = (_number(_text(element, f"{path}/tt:{end}")) for end in ("Min", "Max"))
    if not low <= high:
        raise OnvifError("the pan/tilt unit states a range that is none")
    return low, high


def _number(text: str | None) -> float:
    """Return a number as XML Schema has it, which writes infinity as INF."""
    try:
        return float(text or "")
    except ValueError:
        raise OnvifError(f"the pan/tilt unit states {one_line(text or '', 40)!r} where a number is due") from None


def _vector(at: Vector) -> str:
    return f'<tt:PanTilt x="{at.x:.6f}" y="{at.y:.6f}" space={quoteattr(at.space)}/>'


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _shown(data: bytes) -> str:
    text = data[:80].decode("utf-8", "replace")
    return f'"{one_line(text, 60)}"' if data else "nothing"


def hints(codes: tuple[str, ...]) -> Iterator[str]:
    """Yield what to do about the codes of a fault."""
    known = {
        "NotAuthorized": "set 'user' of the plan's unit, and its password in LADARREG_ONVIF_PASSWORD; a user must be "
        "allowed to move the head",
        "ActionNotSupported": "the head does not have this operation; it has to be a PTZ device of ONVIF",
        "InvalidPosition": "it does not reach that position: correct 'range_deg' of the plan's unit",
    }
    yield from (known[code] for code in codes if code in known)
