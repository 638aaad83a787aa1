"""How often somebody may be wrong."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict, deque
from collections.abc import Callable

_MOST_ADDRESSES = 4096


class Attempts:
    """Counts wrong tokens by address, and forgets them after a while.

    Args:
        most: wrong tokens that an address may show within `window_s`.
        window_s: how long a wrong token counts, s.
        clock: monotonic time, s.
    """

    def __init__(self, *, most: int = 10, window_s: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._window_s, self._clock = most, window_s, clock
        self._wrong: OrderedDict[str, deque[float]] = OrderedDict()

    def wait_s(self, address: str) -> float:
        """Return how long an address has to wait until it may try again, s; 0 if it may now."""
        times = self._recent(_household(address))
        return times[-self._most] + self._window_s - self._clock() if len(times) >= self._most else 0.0

    def wrong(self, address: str) -> None:
        """Note that an address showed a wrong token."""
        household = _household(address)
        times = self._recent(household)
        times.append(self._clock())
        self._wrong[household] = times
        self._wrong.move_to_end(household)
        while len(self._wrong) > _MOST_ADDRESSES:
            self._wrong.popitem(last=False)

    def _recent(self, household: str) -> deque[float]:
        times = self._wrong.get(household, deque(maxlen=self._most))
        while times and times[0] <= self._clock() - self._window_s:
            times.popleft()
        return times


def _household(address: str) -> str:
    """Return what one person may have many of: the network of an IPv6 address."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if parsed.version == 4:
        return address
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return str(ipaddress.ip_network((parsed, 64), strict=False))
