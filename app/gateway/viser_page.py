"""viser's page as the workbench shows it: the scene alone, and cached by the browser.

viser's page has its own panel, start page and notices, which the workbench's page replaces. Its websocket's address is
its own without the last slash, so that every client has a page of its own, `viser/ID/`; the 0.7 MB are in `viser/page`,
which all of them share.
"""

from __future__ import annotations

import gzip
import hashlib
import json
from dataclasses import dataclass

from .page.folder import static_text

PAGE_NAME = "page"
_HEAD = b"<head>"
# viser reconnects only while its window has the focus, which a frame rarely has.
_SCRIPT = "document.hasFocus = () => true;"
_SHELL = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>3-D model</title>
<style>html {{ background: #0f1115; }}</style>
<script>
(async () => {{
  const reader = (await fetch({address})).body.getReader();
  const pieces = [];
  for (let got = 0; ;) {{
    const {{ done, value }} = await reader.read();
    if (done) break;
    pieces.push(value);
    got += value.length;
    parent.postMessage({{ viewer: [got, {size}] }}, location.origin);
  }}
  const text = await new Blob(pieces).text();
  document.open();
  document.write(text);
  document.close();
}})();
</script>
</html>
"""


@dataclass(frozen=True)
class ViserPage:
    """viser's page with the additions."""

    plain: bytes
    """As it is."""
    packed: bytes
    """Compressed by gzip."""
    digest: str
    """Changes whenever the page does."""

    @staticmethod
    def of(original: bytes) -> ViserPage:
        """Add style and script to viser's own page."""
        added = f"<style>{static_text('viser.css')}</style><script>{_SCRIPT}</script>".encode()
        plain = original.replace(_HEAD, _HEAD + added, 1)
        return ViserPage(plain, gzip.compress(plain, mtime=0), hashlib.sha256(plain).hexdigest()[:16])

    @property
    def shell(self) -> str:
        """The page of one client, which loads the shared page in its place."""
        return _SHELL.format(address=json.dumps(f"../{PAGE_NAME}?{self.digest}"), size=len(self.plain))
