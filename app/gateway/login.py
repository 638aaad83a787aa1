"""The token, and the cookie that stands for it."""

from __future__ import annotations

import hashlib
import hmac
import secrets

from ladarreg_core.errors import OptionError

SHORTEST = 12
"""Characters that a token needs at least."""
_UNGUESSABLE = 22
"""Characters of base64 that hold 128 random bits."""
_ID_BYTES = 16


def new_token() -> str:
    """Return a token that nobody can guess."""
    return secrets.token_urlsafe(24)


def checked_token(token: str) -> str:
    """Return a token that somebody chose.

    Raises:
        OptionError: if it is short, or cannot stand in an address.
    """
    if len(token) < SHORTEST:
        raise OptionError(
            f"the token has {len(token)} characters; it needs {SHORTEST} at least, or leave it out for a random one"
        )
    if not (token.isascii() and token.isprintable()) or " " in token:
        raise OptionError("the token holds a space or a letter that is not ASCII; use letters, digits and - . _ ~")
    return token


class Door:
    """Who is let in: whoever shows the token, and the browsers that have shown it.

    A cookie is a browser's random number and a code of it that only the token makes: no cookie gives the token away,
    browsers can be told apart, and with a token of one's own a browser stays known when the program starts anew.

    Args:
        token: what opens the door.
        port: where the gateway listens: browsers share cookies between the ports of a host.
    """

    def __init__(self, token: str, *, port: int) -> None:
        self.cookie_name = f"ladarreg-{port}"
        self.unguessable = len(token) >= _UNGUESSABLE
        """Whether the token is so long that trying does not help."""
        self._token = hashlib.sha256(token.encode()).digest()
        self._key = hmac.digest(token.encode(), b"ladarreg cookie", "sha256")

    def knows(self, token: str) -> bool:
        """Tell whether this is the token, in the same time for every wrong one."""
        return hmac.compare_digest(hashlib.sha256(token.encode(errors="replace")).digest(), self._token)

    def new_cookie(self) -> str:
        """Return the cookie of a browser that has shown the token."""
        browser = secrets.token_hex(_ID_BYTES)
        return f"{browser}.{self._code(browser)}"

    def browser(self, cookies: str) -> str | None:
        """Return whose cookie is among these, None if there is none that we made.

        Args:
            cookies: the header Cookie.
        """
        for part in cookies.split(";"):
            name, _, value = part.strip().partition("=")
            browser, _, code = value.strip().strip('"').partition(".")
            if name == self.cookie_name and hmac.compare_digest(
                code.encode(errors="replace"), self._code(browser).encode()
            ):
                return browser
        return None

    def _code(self, browser: str) -> str:
        return hmac.new(self._key, browser.encode(errors="replace"), "sha256").hexdigest()
