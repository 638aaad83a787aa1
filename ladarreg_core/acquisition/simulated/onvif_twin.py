"""The simulated head that speaks ONVIF: another controller on the axes of the simulated pan/tilt unit.

Written from the specification alone, without the driver's reader, so that an error is not made twice.
"""

from __future__ import annotations

import base64
import hashlib
import math
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Self
from xml.etree import ElementTree

from ladarreg_core.acquisition.simulated.flir_twin import FlirTwin

_ENVELOPE = "http://www.w3.org/2003/05/soap-envelope"
_TOKEN_AGE_S = 5.0
_BEGUN = datetime(2020, 1, 1, tzinfo=UTC)  # its clock was never set
_SPACES = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/"
_PROFILE, _NODE = "Profile_1", "PtzNode_1"
_POLL_S = 0.02
_LONGEST = 1 << 16


class OnvifTwin:
    """The simulated head: requests in, answers out.

    Failures on request: `silent` answers nothing, `rubbish` answers what is no XML; axes that get stuck or slip are
    those of the unit.

    Args:
        unit: whose axes it drives.
        user: who may use it; empty: everybody.
        password: of the user.
        has_degrees: whether it has positions in degrees, and speeds, beside those in parts of its full range.
    """

    name = "onvif"

    def __init__(self, unit: FlirTwin, *, user: str = "", password: str = "", has_degrees: bool = True) -> None:
        self.silent = self.rubbish = False
        self._unit, self._user, self._password, self._has_degrees = unit, user, password, has_degrees
        self._one = threading.Lock()

    def answer(self, request: bytes, now_s: float) -> tuple[int, bytes] | None:
        """Return the status of HTTP and the answer; None if it stays silent."""
        with self._one:
            if self.silent:
                return None
            if self.rubbish:
                return 200, b"\x00\xff<<busy>>"
            try:
                return self._answered(ElementTree.fromstring(request), now_s)
            except (ElementTree.ParseError, ValueError, AttributeError, TypeError, KeyError) as error:
                return _fault("Sender", "WellFormed", str(error))

    def _answered(self, envelope: ElementTree.Element, now_s: float) -> tuple[int, bytes]:
        body = envelope.find(f"{{{_ENVELOPE}}}Body")
        if body is None or len(body) != 1:
            raise ValueError("no body with one request")
        asked = body[0]
        name = asked.tag.rpartition("}")[2]
        if name == "GetSystemDateAndTime":
            return 200, _response("device", name, self._time(now_s))
        if self._user and not self._knows(envelope, now_s):
            return _fault("Sender", "NotAuthorized", "sender not authorized")
        low, high = self._unit.range_deg
        pan_tilt = [math.degrees(angle) for angle in self._unit.angles_at([now_s])[0]]
        match name:
            case "GetServices":
                return 200, _response("device", name, "".join(map(_service, _NAMESPACES)))
            case "GetDeviceInformation":
                said = {"Manufacturer": "ladarreg", "Model": "simulated ONVIF head", "FirmwareVersion": "1"}
                return 200, _response("device", name, "".join(f"<r:{k}>{v}</r:{k}>" for k, v in said.items()))
            case "GetProfiles":
                return 200, _response("media", name, _PROFILES.format(space=self._space))
            case "GetNodes":
                return 200, _response("ptz", name, self._nodes(low, high))
            case "GetStatus":
                return 200, _response("ptz", name, self._status(pan_tilt, now_s))
            case "Stop":
                self._unit.stop(now_s)
                return 200, _response("ptz", name, "")
            case "AbsoluteMove":
                return self._moved(asked, now_s)
        return _fault("Receiver", "ActionNotSupported", f"no {name}")

    @property
    def _space(self) -> str:
        return _SPACES + ("SphericalPositionSpaceDegrees" if self._has_degrees else "PositionGenericSpace")

    def _knows(self, envelope: ElementTree.Element, now_s: float) -> bool:
        found = {each.tag.rpartition("}")[2]: (each.text or "").strip() for each in envelope.iter()}
        if not {"Username", "Password", "Nonce", "Created"} <= found.keys():
            return False
        joined = base64.b64decode(found["Nonce"]) + found["Created"].encode() + self._password.encode()
        age = (_now(now_s) - datetime.fromisoformat(found["Created"])).total_seconds()
        return (
            found["Username"] == self._user
            and base64.b64decode(found["Password"]) == hashlib.sha1(joined, usedforsecurity=False).digest()
            and abs(age) <= _TOKEN_AGE_S
        )

    def _time(self, now_s: float) -> str:
        now = _now(now_s)
        return (
            "<r:SystemDateAndTime><tt:DateTimeType>Manual</tt:DateTimeType><tt:DaylightSavings>false</tt:DaylightSavings>"
            f"<tt:UTCDateTime><tt:Time><tt:Hour>{now.hour}</tt:Hour><tt:Minute>{now.minute}</tt:Minute>"
            f"<tt:Second>{now.second}</tt:Second></tt:Time><tt:Date><tt:Year>{now.year}</tt:Year>"
            f"<tt:Month>{now.month}</tt:Month><tt:Day>{now.day}</tt:Day></tt:Date></tt:UTCDateTime>"
            "</r:SystemDateAndTime>"
        )

    def _nodes(self, low: tuple[float, float], high: tuple[float, float]) -> str:
        spaces = [("AbsolutePanTiltPositionSpace", "PositionGenericSpace", [(-1.0, 1.0), (-1.0, 1.0)])]
        spaces.append(("PanTiltSpeedSpace", "GenericSpeedSpace", [(0.0, 1.0)]))
        if self._has_degrees:  # X grows to the right
            ranges = [(-high[0], -low[0]), (low[1], high[1])]
            spaces.append(("AbsolutePanTiltPositionSpace", "SphericalPositionSpaceDegrees", ranges))
            spaces.append(("PanTiltSpeedSpace", "SpeedSpaceDegrees", [self._unit.speeds_deg_s]))
        listed = "".join(
            f"<tt:{kind}><tt:URI>{_SPACES}{name}</tt:URI>"
            + "".join(
                f"<tt:{axis}Range><tt:Min>{least}</tt:Min><tt:Max>{most}</tt:Max></tt:{axis}Range>"
                for axis, (least, most) in zip("XY", ranges, strict=False)
            )
            + f"</tt:{kind}>"
            for kind, name, ranges in spaces
        )
        return f'<r:PTZNode token="{_NODE}"><tt:SupportedPTZSpaces>{listed}</tt:SupportedPTZSpaces></r:PTZNode>'

    def _status(self, pan_tilt: list[float], now_s: float) -> str:
        x, y = -pan_tilt[0], pan_tilt[1]
        if not self._has_degrees:
            x, y = self._parts(x, y)
        move = "MOVING" if self._unit.moving(now_s) else "IDLE"
        return (
            f'<r:PTZStatus><tt:Position><tt:PanTilt x="{x:.6g}" y="{y:.6g}" space="{self._space}"/></tt:Position>'
            f"<tt:MoveStatus><tt:PanTilt>{move}</tt:PanTilt></tt:MoveStatus>"
            f"<tt:UtcTime>{_now(now_s):%Y-%m-%dT%H:%M:%SZ}</tt:UtcTime></r:PTZStatus>"
        )

    def _moved(self, asked: ElementTree.Element, now_s: float) -> tuple[int, bytes]:
        named = {each.tag.rpartition("}")[2]: each for each in asked}
        to = named["Position"][0].attrib
        x, y, space = float(to["x"]), float(to["y"]), to.get("space", self._space)
        low, high = self._unit.range_deg
        if space.endswith("PositionGenericSpace"):
            x, y = (-high[0] + (x + 1) / 2 * (high[0] - low[0])), low[1] + (y + 1) / 2 * (high[1] - low[1])
        elif not (space.endswith("SphericalPositionSpaceDegrees") and self._has_degrees):
            return _fault("Sender", "SpaceNotSupported", space)
        if not (low[0] - 0.01 <= -x <= high[0] + 0.01 and low[1] - 0.01 <= y <= high[1] + 0.01):
            return _fault("Sender", "InvalidPosition", f"{x:g}, {y:g}")
        if "Speed" in named:
            self._unit.set_speed(float(named["Speed"][0].attrib["x"]))
        self._unit.go_to("P", math.radians(-x), now_s)
        self._unit.go_to("T", math.radians(y), now_s)
        return 200, _response("ptz", "AbsoluteMove", "")

    def _parts(self, x: float, y: float) -> tuple[float, float]:
        low, high = self._unit.range_deg
        return 2 * (x + high[0]) / (high[0] - low[0]) - 1, 2 * (y - low[1]) / (high[1] - low[1]) - 1


class OnvifServer:
    """Serves a simulated head by HTTP on this machine; a context manager.

    Args:
        twin: the head.
        now_s: returns the simulated time, s.
    """

    def __init__(self, twin: OnvifTwin, now_s: Callable[[], float]) -> None:
        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                request = self.rfile.read(min(int(self.headers.get("Content-Length", 0)), _LONGEST))
                answered = twin.answer(request, now_s())
                if answered is None:
                    self.close_connection = True
                    return
                status, data = answered
                self.send_response(status)
                self.send_header("Content-Type", "application/soap+xml; charset=utf-8")
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/onvif/device_service"
        """Address of its device service."""

    def __enter__(self) -> Self:
        threading.Thread(target=self._server.serve_forever, args=(_POLL_S,), daemon=True, name="onvif head").start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()


_NAMESPACES = {
    "device": "http://www.onvif.org/ver10/device/wsdl", "media": "http://www.onvif.org/ver10/media/wsdl",
    "ptz": "http://www.onvif.org/ver20/ptz/wsdl",
}  # fmt: skip
_PROFILES = (
    f'<r:Profiles token="{_PROFILE}"><tt:Name>1</tt:Name><tt:PTZConfiguration token="c"><tt:NodeToken>{_NODE}'
    "</tt:NodeToken><tt:DefaultAbsolutePantTiltPositionSpace>{space}</tt:DefaultAbsolutePantTiltPositionSpace>"
    "</tt:PTZConfiguration></r:Profiles>"
)


def _now(now_s: float) -> datetime:
    return _BEGUN + timedelta(seconds=now_s)


def _service(service: str) -> str:
    return (
        f"<r:Service><r:Namespace>{_NAMESPACES[service]}</r:Namespace>"
        f"<r:XAddr>http://127.0.0.1/onvif/{service}_service</r:XAddr></r:Service>"
    )


def _response(service: str, operation: str, content: str) -> bytes:
    return (
        f'<e:Envelope xmlns:e="{_ENVELOPE}" xmlns:r="{_NAMESPACES[service]}" xmlns:tt="http://www.onvif.org/ver10/schema">'
        f"<e:Body><r:{operation}Response>{content}</r:{operation}Response></e:Body></e:Envelope>"
    ).encode()


def _fault(code: str, subcode: str, reason: str) -> tuple[int, bytes]:
    text = "".join(c for c in reason if c.isalnum() or c in " .,-:/")
    return 400 if code == "Sender" else 500, (
        f'<e:Envelope xmlns:e="{_ENVELOPE}" xmlns:ter="http://www.onvif.org/ver10/error"><e:Body><e:Fault><e:Code>'
        f"<e:Value>e:{code}</e:Value><e:Subcode><e:Value>ter:{subcode}</e:Value></e:Subcode></e:Code><e:Reason>"
        f'<e:Text xml:lang="en">{text}</e:Text></e:Reason></e:Fault></e:Body></e:Envelope>'
    ).encode()
