"""What every answer tells the browser not to do."""

from __future__ import annotations

from .forwarded import Asked
from .options import is_loopback

PAGE_POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; style-src 'self'; script-src 'self'; connect-src 'self'; "
    "frame-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
"""Of everything but viser."""
# viser's page is one inline script that unpacks, by WebAssembly, the script and the style that it adds to itself:
# neither a hash nor a nonce can name them. Its decoders and textures are fetched from blobs and data. Without
# 'unsafe-eval' its console shows one EvalError, of the sorter of Gaussian splats; splats and Plotly do not work, and no
# message can bring a script.
VISER_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval'; worker-src blob:; style-src 'unsafe-inline'; "
    "img-src blob: data:; connect-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
"""Of viser's page."""
_DAY_S = 86_400


def is_visers(path: str) -> bool:
    """Tell whether a path leads to viser."""
    return path == "/viser" or path.startswith("/viser/")


def security_headers(path: str, asked: Asked, *, tls: bool) -> dict[str, str]:
    """Return the headers that an answer gets where it does not set them itself.

    Args:
        path: what was asked for.
        asked: who asks.
        tls: whether the gateway speaks TLS itself.
    """
    headers = {
        "content-security-policy": VISER_POLICY if is_visers(path) else PAGE_POLICY,
        "x-content-type-options": "nosniff",
        "x-frame-options": "SAMEORIGIN",
        "referrer-policy": "no-referrer",
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-resource-policy": "same-origin",
        "permissions-policy": "camera=(), display-capture=(), geolocation=(), microphone=(), payment=(), usb=()",
        "cache-control": "no-store",
    }
    # It holds for all ports of a name: not for localhost, where others serve without TLS, and not for long.
    if tls and not is_loopback(asked.name):
        headers["strict-transport-security"] = f"max-age={_DAY_S}"
    return headers
