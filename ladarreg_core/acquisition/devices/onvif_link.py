"""Exchanges with an ONVIF device over HTTP: each signed in the device's own time, and logged without its signature."""

from __future__ import annotations

import http.client
import logging
import os
import secrets
import ssl
from collections import deque
from collections.abc import Callable
from datetime import datetime, timedelta
from urllib.parse import urlsplit
from xml.etree.ElementTree import Element

from ladarreg_core.acquisition.clock import Clock
from ladarreg_core.acquisition.devices.link import TRIES, Exchange, NoAnswerError, RoundTrip
from ladarreg_core.acquisition.devices.onvif_protocol import (
    NAMESPACES,
    OnvifError,
    OnvifRefusalError,
    Service,
    answer,
    device_time,
    hints,
    request,
    service_addresses,
    signed,
)
from ladarreg_core.errors import DeviceError

PASSWORD = "LADARREG_ONVIF_PASSWORD"
"""Environment variable of the password: a plan is kept with every run, and is no place for one."""
Post = Callable[[str, bytes, float], tuple[int, bytes]]
"""Sends a request to a URL, with a deadline in seconds; returns the status of HTTP and the answer."""
_ANSWER_S = 3.0
_RETRY_S = 0.3
_LONGEST_ANSWER = 1 << 20
_NONCE_BYTES = 16
_REMEMBERED = 64
_UNSIGNED = ("GetSystemDateAndTime",)
_LOG = logging.getLogger(__name__)


def post(url: str, body: bytes, deadline_s: float) -> tuple[int, bytes]:
    """Send a request by HTTP; a `Post`.

    Raises:
        NoAnswerError: if nothing answers, or not in time.
    """
    parts = urlsplit(url)
    try:
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        connection = kind(parts.hostname or "", parts.port, timeout=deadline_s)
        try:
            path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
            connection.request("POST", path, body, {"Content-Type": "application/soap+xml; charset=utf-8"})
            response = connection.getresponse()
            return response.status, response.read(_LONGEST_ANSWER)
        finally:
            connection.close()
    except ssl.SSLCertVerificationError as error:
        raise DeviceError(
            f"the certificate of the pan/tilt unit at {url} is not trusted ({error.verify_message}); use http, or "
            "name its certificate in the environment variable SSL_CERT_FILE"
        ) from error
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise NoAnswerError(
            f"the pan/tilt unit at {url} does not answer ({str(error)[:120] or type(error).__name__}); check its "
            "power, its address and the network"
        ) from error


class OnvifLink:
    """Exchanges requests and answers with a device; may be used from any thread.

    Args:
        url: of its device service.
        user: name at the device; empty: requests are not signed.
        clock: what deadlines and the times of exchanges are measured by.
        send: sends requests; by default over the network.
        password: None: from the environment.
    """

    def __init__(self, url: str, user: str, *, clock: Clock, send: Post = post, password: str | None = None) -> None:
        self.device, self.address, self.clock = "the pan/tilt unit", url, clock
        self.round_trip = RoundTrip()
        self._user, self._send = user, send
        self._password = os.environ.get(PASSWORD, "") if password is None else password
        self._exchanges: deque[Exchange] = deque(maxlen=_REMEMBERED)
        self._log: Callable[[str, Exchange], None] | None = None
        self._lost: DeviceError | None = None
        self._addresses = {NAMESPACES["device"]: url}
        self._device_time: tuple[datetime, float] | None = None
        self._set_time()
        self._addresses = {
            **service_addresses(
                self.ask("device", "GetServices", "<o:IncludeCapability>false</o:IncludeCapability>"), url
            ),
            **self._addresses,
        }

    def log_to(self, log: Callable[[str, Exchange], None]) -> None:
        """Give each exchange to `log` from now on, with the device's name; those that are remembered at once."""
        for each in tuple(self._exchanges.copy()):
            log(self.device, each)
        self._log = log

    def ask(
        self, service: Service, operation: str, content: str = "", *, tries: int = TRIES, deadline_s: float = _ANSWER_S
    ) -> Element:
        """Return what the device answers; a request that is damaged or not answered is sent again.

        Args:
            service: whose operation it is.
            operation: its name.
            content: XML within it.
            tries: how often it is sent, in all.
            deadline_s: for each answer.

        Raises:
            DeviceError: if it does not answer, or refuses.
        """
        for left in range(tries - 1, -1, -1):
            try:
                found = self._ask(service, operation, content, deadline_s)
                self._lost = None
                return found
            except OnvifRefusalError as error:
                if "NotAuthorized" in error.codes and left and self._user:
                    self._set_time()  # its clock may have been set meanwhile
                    continue
                advice = "; ".join(hints(error.codes))
                raise OnvifRefusalError(f"{error}{': ' + advice if advice else ''}", error.codes) from error
            except (OnvifError, NoAnswerError) as error:
                _LOG.info("%s: %s", operation, error)
                if not left:
                    self._lost = error if isinstance(error, NoAnswerError) else None
                    raise
                self.clock.sleep(_RETRY_S)
        raise AssertionError("the last try returns or raises")

    def require_present(self) -> None:
        """Raise what the last exchange did, if nothing answered it; without an exchange."""
        if self._lost is not None:
            raise self._lost

    def _set_time(self) -> None:
        begun = self.clock.now()
        found = device_time(self._ask("device", "GetSystemDateAndTime", "", _ANSWER_S))
        self._device_time = found, (begun + self.clock.now()) / 2

    def _ask(self, service: Service, operation: str, content: str, deadline_s: float) -> Element:
        url = self._addresses.get(NAMESPACES[service])
        if url is None:
            raise DeviceError(
                f"the device at {self.address} has no {service} service of ONVIF; give the address of a pan/tilt head"
            )
        security = ""
        if self._user and operation not in _UNSIGNED and self._device_time is not None:
            when, measured_s = self._device_time
            created = when + timedelta(seconds=self.clock.now() - measured_s)
            security = signed(self._user, self._password, nonce=secrets.token_bytes(_NONCE_BYTES), created=created)
        begun, data = self.clock.now(), b""
        try:
            status, data = self._send(url, request(service, operation, content, security=security), deadline_s)
        finally:
            took = self.clock.now() - begun
            self.round_trip.took(took)
            self._add(Exchange(begun, f"{operation} {content}".encode(), data, took))
        if status in (401, 403) and b"Envelope" not in data:
            raise OnvifRefusalError(
                f"the pan/tilt unit refused {operation} (HTTP {status}): switch on that it takes signed messages "
                "(WS-UsernameToken), often called ONVIF authentication",
                ("NotAuthorized",),
            )
        return answer(data, service, operation)

    def _add(self, exchange: Exchange) -> None:
        self._exchanges.append(exchange)
        if self._log is not None:
            self._log(self.device, exchange)
