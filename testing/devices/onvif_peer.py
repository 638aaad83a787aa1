"""A pan/tilt head that speaks ONVIF, and readers of both directions, written from the specification alone.

Nothing here is taken from `ladarreg_core`: what the driver, its twin and this module have in common are the documents.
Requests are read with a DOM and answers are filled into templates, in whatever prefixes and white space a maker likes.

Source: ONVIF PTZ Service Specification 25.12 (nodes, configurations, AbsoluteMove, Stop, GetStatus, predefined
spaces), the schemas `ptz.wsdl` 20.12, `common.xsd` 22.12, `onvif.xsd` and `devicemgmt.wsdl` beside it; ONVIF Core
Specification (SOAP 1.2, faults, user authentication); OASIS Web Services Security UsernameToken Profile 1.0.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from datetime import datetime, timedelta
from xml.dom import minidom
from xml.sax.saxutils import quoteattr

SOAP = "http://www.w3.org/2003/05/soap-envelope"
TT = "http://www.onvif.org/ver10/schema"
PTZ = "http://www.onvif.org/ver20/ptz/wsdl"
DEVICE = "http://www.onvif.org/ver10/device/wsdl"
MEDIA = "http://www.onvif.org/ver10/media/wsdl"
WSSE = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-wssecurity-secext-1.0.xsd"
WSU = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-wssecurity-utility-1.0.xsd"
SPACES = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/"
GENERIC, DEGREES = SPACES + "PositionGenericSpace", SPACES + "SphericalPositionSpaceDegrees"
GENERIC_SPEED, SPEED_DEGREES = SPACES + "GenericSpeedSpace", SPACES + "SpeedSpaceDegrees"


@dataclass
class PeerPtz:
    """The device of the specification: a request in, an answer out. It is there at once."""

    user: str = ""
    """None is set: everybody may do everything."""
    password: str = ""
    clock: datetime = datetime(2026, 1, 2, 3, 4, 5)
    """Its own UTC, which may be years off."""
    profile: str = "Profile_1"
    prefixes: tuple[str, str, str] = ("s", "tt", "p")
    """For the envelope, the schema and the service."""
    gap: str = ""
    """White space between elements."""
    degrees: tuple[float, float, float, float] | None = (-180.0, 180.0, -90.0, 45.0)
    """Ranges of X and Y of its space in degrees; None: only the generic one."""
    default_space: str = GENERIC
    has_move_status: bool = True
    x: float = 0.0
    y: float = 0.0
    """Where it is, of the generic space."""
    moving: str = "IDLE"
    error: str = ""
    stops: int = 0
    last_speed: tuple[float, float, str] | None = None

    # -- what it is asked -------------------------------------------------------------------------------------------

    def answer(self, request: bytes) -> tuple[int, bytes]:
        """Return the status of HTTP and the answer."""
        document = minidom.parseString(request)
        root = document.documentElement
        if root.namespaceURI != SOAP or root.localName != "Envelope":
            return 400, self._fault("Sender", "WellFormed", "no envelope of SOAP 1.2")
        body = children(root, SOAP, "Body")[0]
        asked = children(body)[0]
        name, space = asked.localName, asked.namespaceURI
        if (space, name) == (DEVICE, "GetSystemDateAndTime"):
            return 200, self._envelope(DEVICE, self._date_and_time())
        if self.user and not self._is_known(root):
            return 400, self._fault("Sender", "NotAuthorized", "wrong user name, password or time")
        if (space, name) == (DEVICE, "GetServices"):
            return 200, self._envelope(DEVICE, self._services())
        if (space, name) == (DEVICE, "GetDeviceInformation"):
            return 200, self._envelope(DEVICE, self._information())
        if (space, name) == (MEDIA, "GetProfiles"):
            return 200, self._envelope(MEDIA, self._profiles())
        if space != PTZ:
            return 500, self._fault("Receiver", "ActionNotSupported", name)
        if name == "GetNodes":
            return 200, self._envelope(PTZ, self._nodes())
        token = text(asked, PTZ, "ProfileToken")
        if token != self.profile:
            return 400, self._fault("Sender", "NoProfile", f"no profile {token}")
        if name == "GetStatus":
            return 200, self._envelope(PTZ, self._status())
        if name == "Stop":
            if text(asked, PTZ, "PanTilt", "true") in ("true", "1"):
                self.stops += 1
            return 200, self._envelope(PTZ, f"<{self._p('StopResponse')}/>")
        if name == "AbsoluteMove":
            return self._move(asked)
        return 500, self._fault("Receiver", "ActionNotSupported", name)

    def _is_known(self, root: minidom.Element) -> bool:
        headers = children(root, SOAP, "Header")
        tokens = [
            token for header in headers for security in children(header, WSSE, "Security")
            for token in children(security, WSSE, "UsernameToken")
        ]  # fmt: skip
        if len(tokens) != 1:
            return False
        nonce, created = text(tokens[0], WSSE, "Nonce"), text(tokens[0], WSU, "Created")
        password = children(tokens[0], WSSE, "Password")[0]
        if not password.getAttribute("Type").endswith("#PasswordDigest"):
            return False
        joined = base64.b64decode(nonce) + created.encode() + self.password.encode()
        if base64.b64encode(hashlib.sha1(joined).digest()).decode() != text(tokens[0], WSSE, "Password"):
            return False
        when = datetime.strptime(created.split(".")[0].rstrip("Z"), "%Y-%m-%dT%H:%M:%S")
        return abs(when - self.clock) < timedelta(seconds=60) and text(tokens[0], WSSE, "Username") == self.user

    def _move(self, asked: minidom.Element) -> tuple[int, bytes]:
        position = children(asked, PTZ, "Position")[0]
        vectors = children(position, TT, "PanTilt")
        x, y, space = vector(vectors[0])
        space = space or self.default_space
        if space == DEGREES and self.degrees is not None:
            x, y = self.to_generic(x, y)
        elif space != GENERIC:
            return 400, self._fault("Sender", "SpaceNotSupported", space)
        if max(abs(x), abs(y)) > 1 + 1e-6:
            return 400, self._fault("Sender", "InvalidPosition", "out of bounds")
        speeds = [v for speed in children(asked, PTZ, "Speed") for v in children(speed, TT, "PanTilt")]
        self.last_speed = vector(speeds[0]) if speeds else None
        self.x, self.y = x, y
        return 200, self._envelope(PTZ, f"<{self._p('AbsoluteMoveResponse')}></{self._p('AbsoluteMoveResponse')}>")

    def to_generic(self, x: float, y: float) -> tuple[float, float]:
        """Return degrees as parts of the full range, -1 to 1."""
        assert self.degrees is not None
        left, right, low, high = self.degrees
        return 2 * (x - left) / (right - left) - 1, 2 * (y - low) / (high - low) - 1

    def in_degrees(self) -> tuple[float, float]:
        """Return where it is in degrees: X grows to the right of its picture, Y upward."""
        assert self.degrees is not None
        left, right, low, high = self.degrees
        return left + (self.x + 1) / 2 * (right - left), low + (self.y + 1) / 2 * (high - low)

    # -- what it answers --------------------------------------------------------------------------------------------

    def _t(self, name: str) -> str:
        return f"{self.prefixes[1]}:{name}" if self.prefixes[1] else name

    def _p(self, name: str) -> str:
        return f"{self.prefixes[2]}:{name}"

    def _inside(self, name: str, *parts: str, attributes: str = "") -> str:
        return f"<{self._t(name)}{attributes}>{self.gap}{self.gap.join(parts)}{self.gap}</{self._t(name)}>"

    def _value(self, name: str, value: object) -> str:
        return f"<{self._t(name)}>{value}</{self._t(name)}>"

    def _envelope(self, service: str, content: str) -> bytes:
        s, tt, p = self.prefixes
        schema = f'xmlns:{tt}="{TT}"' if tt else f'xmlns="{TT}"'
        text = (
            f'<?xml version="1.0" encoding="UTF-8"?>\n<{s}:Envelope xmlns:{s}="{SOAP}" {schema} xmlns:{p}="{service}">'
            f"{self.gap}<{s}:Header/>{self.gap}<{s}:Body>{self.gap}{content}{self.gap}</{s}:Body></{s}:Envelope>"
        )
        return text.encode()

    def _fault(self, code: str, subcode: str, reason: str) -> bytes:
        s = self.prefixes[0]
        text = (
            f'<{s}:Envelope xmlns:{s}="{SOAP}" xmlns:ter="http://www.onvif.org/ver10/error"><{s}:Body><{s}:Fault>'
            f"<{s}:Code><{s}:Value>{s}:{code}</{s}:Value><{s}:Subcode><{s}:Value>ter:{subcode}</{s}:Value>"
            f'</{s}:Subcode></{s}:Code><{s}:Reason><{s}:Text xml:lang="en">{reason}</{s}:Text></{s}:Reason>'
            f"</{s}:Fault></{s}:Body></{s}:Envelope>"
        )
        return text.encode()

    def _response(self, name: str, *parts: str) -> str:
        return f"<{self._p(name)}>{self.gap}{self.gap.join(parts)}{self.gap}</{self._p(name)}>"

    def _date_and_time(self) -> str:
        now = self.clock
        time = self._inside(
            "Time", self._value("Hour", now.hour), self._value("Minute", now.minute), self._value("Second", now.second)
        )
        date = self._inside(
            "Date", self._value("Year", now.year), self._value("Month", now.month), self._value("Day", now.day)
        )
        where = f"<{self._p('SystemDateAndTime')}>"
        return self._response(
            "GetSystemDateAndTimeResponse",
            where + self._value("DateTimeType", "NTP") + self._value("DaylightSavings", "false")
            + self._inside("UTCDateTime", time, date) + where.replace("<", "</"),
        )  # fmt: skip

    def _services(self) -> str:
        def one(space: str, path: str) -> str:
            p = self._p
            return (
                f"<{p('Service')}><{p('Namespace')}>{space}</{p('Namespace')}>"
                f"<{p('XAddr')}>http://10.0.0.9:8899{path}</{p('XAddr')}></{p('Service')}>"
            )

        return self._response("GetServicesResponse", one(DEVICE, "/d"), one(MEDIA, "/m"), one(PTZ, "/ptz"))

    def _information(self) -> str:
        fields = {"Manufacturer": "Peer", "Model": "P & T", "FirmwareVersion": "1.2", "SerialNumber": "7"}
        escaped = {name: value.replace("&", "&amp;") for name, value in fields.items()}
        parts = [f"<{self._p(name)}>{value}</{self._p(name)}>" for name, value in escaped.items()]
        return self._response("GetDeviceInformationResponse", *parts)

    def _profiles(self) -> str:
        configuration = self._inside(
            "PTZConfiguration", self._value("Name", "c"), self._value("UseCount", 1), self._value("NodeToken", "Node"),
            self._value("DefaultAbsolutePantTiltPositionSpace", self.default_space), attributes=' token="C"',
        )  # fmt: skip
        bare = f'<{self._p("Profiles")} token="no_ptz" fixed="true"><{self._t("Name")}>a</{self._t("Name")}>'
        full = f'<{self._p("Profiles")} fixed="true" token={quoteattr(self.profile)}>{configuration}'
        end = f"</{self._p('Profiles')}>"
        return self._response("GetProfilesResponse", bare + end, full + end)

    def _space(self, name: str, uri: str, ranges: tuple[float, ...]) -> str:
        parts = [self._value("URI", uri)]
        for axis, k in (("XRange", 0), ("YRange", 2)):
            if len(ranges) > k:
                parts.append(self._inside(axis, self._value("Min", ranges[k]), self._value("Max", ranges[k + 1])))
        return self._inside(name, *parts)

    def _nodes(self) -> str:
        spaces = [self._space("AbsolutePanTiltPositionSpace", GENERIC, (-1.0, 1.0, -1.0, 1.0))]
        if self.degrees is not None:
            spaces.append(self._space("AbsolutePanTiltPositionSpace", DEGREES, self.degrees))
        spaces.append(self._space("PanTiltSpeedSpace", GENERIC_SPEED, (0.0, 1.0)))
        if self.degrees is not None:
            spaces.append(self._space("PanTiltSpeedSpace", SPEED_DEGREES, (0.1, 80.0)))
        node = (
            f'<{self._p("PTZNode")} token="Node">{self._inside("SupportedPTZSpaces", *spaces)}'
            f"{self._value('MaximumNumberOfPresets', 0)}{self._value('HomeSupported', 'false')}</{self._p('PTZNode')}>"
        )
        return self._response("GetNodesResponse", node)

    def _status(self) -> str:
        x, y = self.in_degrees() if self.default_space == DEGREES else (self.x, self.y)
        at = f'<{self._t("PanTilt")} x="{x:.7g}" y="{y:.7g}" space="{self.default_space}"/>'
        parts = [self._inside("Position", at, f'<{self._t("Zoom")} x="0"/>')]
        if self.has_move_status:
            parts.append(self._inside("MoveStatus", self._value("PanTilt", self.moving), self._value("Zoom", "IDLE")))
        if self.error:
            parts.append(self._value("Error", self.error))
        parts.append(self._value("UtcTime", self.clock.strftime("%Y-%m-%dT%H:%M:%SZ")))
        return self._response("GetStatusResponse", f"<{self._p('PTZStatus')}>{''.join(parts)}</{self._p('PTZStatus')}>")


# -- reading -----------------------------------------------------------------------------------------------------------


def children(element: minidom.Element, space: str | None = None, name: str | None = None) -> list[minidom.Element]:
    """Return the elements directly below one, of a name if it is given."""
    found = [node for node in element.childNodes if node.nodeType == node.ELEMENT_NODE]
    return [n for n in found if name is None or (n.localName == name and n.namespaceURI == space)]


def text(element: minidom.Element, space: str, name: str, default: str = "") -> str:
    """Return the text of the element of a name directly below one."""
    found = children(element, space, name)
    return "".join(node.data for node in found[0].childNodes).strip() if found else default


def vector(element: minidom.Element) -> tuple[float, float, str]:
    """Return x, y and the space of a `Vector2D`."""
    return float(element.getAttribute("x")), float(element.getAttribute("y")), element.getAttribute("space")


def status_in(answer: bytes) -> tuple[float, float, str, str | None]:
    """Return x, y, space and the movement of pan and tilt in the answer to `GetStatus`."""
    root = minidom.parseString(answer).documentElement
    found = root.getElementsByTagNameNS(PTZ, "PTZStatus")[0]
    at = children(children(found, TT, "Position")[0], TT, "PanTilt")[0]
    moves = children(found, TT, "MoveStatus")
    return (*vector(at), text(moves[0], TT, "PanTilt") if moves else None)
