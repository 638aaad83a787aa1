"""How measurements are drawn in pictures."""

from __future__ import annotations
