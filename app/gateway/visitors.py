"""Which open pages belong to which browser."""

from __future__ import annotations

from collections import defaultdict

from .protocol import Client


class Visitors:
    """The pages that are open now; used by the event loop only."""

    def __init__(self) -> None:
        self._pages: defaultdict[str, list[Client]] = defaultdict(list)

    def enter(self, browser: str, client: Client) -> None:
        """Note that a browser opened a page."""
        self._pages[browser].append(client)

    def leave(self, browser: str, client: Client) -> None:
        """Note that a browser closed a page."""
        self._pages[browser] = [other for other in self._pages[browser] if other is not client]
        if not self._pages[browser]:
            del self._pages[browser]

    def newest(self, browser: str) -> Client | None:
        """Return the page that a browser opened last and has open still."""
        pages = self._pages.get(browser)
        return pages[-1] if pages else None
