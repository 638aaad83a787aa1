"""Textures of printed, painted and natural surfaces, drawn in inks."""

from __future__ import annotations

import cv2
import numpy as np

from ladarreg_core.simulate.worlds.materials import Ink, InkMixer
from ladarreg_core.simulate.worlds.world import Picture, Texture

PITCH_M = 0.0016
"""Texel size of objects; below a pixel of either sensor at 2 m."""
COARSE_M = 0.004
"""Texel size of floors and walls."""
SKIN_K = 12.0
"""Temperature of skin over a room of 21 C."""

_SCREEN_K, _LEAVES_K, _COLD_GLASS_K = 13.0, -1.2, -4.0  # over the air: lit screen, transpiring leaves, glass in winter

_FONTS = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SIMPLEX)
_SYLLABLES = tuple("ba co de fi gu ha jo ka le mi no pa ri su ta ve wi xo yu za lor men tis ral".split())  # noqa: SIM905


class Printer:
    """Draws the textures of one scene; equal seeds give equal textures in the same order."""

    def __init__(self, rng: np.random.Generator, inks: InkMixer) -> None:
        self.rng = rng
        self.inks = inks

    # -- parts -------------------------------------------------------------------------------------------------

    def sheet(self, width_m: float, height_m: float, ink: Ink, *, pitch_m: float = PITCH_M) -> Picture:
        """Return an empty picture of this size in one ink."""
        w, h = max(4, round(width_m / pitch_m)), max(4, round(height_m / pitch_m))
        # Filling one word per texel is five times as fast as four bytes.
        return np.full((h, w), np.array(ink, np.uint8).view(np.uint32)[0]).view(np.uint8).reshape(h, w, 4)

    def word(self) -> str:
        """Return an invented word."""
        count = int(self.rng.integers(1, 4))
        text = "".join(str(self.rng.choice(_SYLLABLES)) for _ in range(count))
        return text.upper() if self.rng.random() < 0.5 else text.capitalize()

    def grain(self, picture: Picture, strength: float, *, cells: float = 40.0) -> Picture:
        """Return the picture with soft patches of wear, equal for camera and laser."""
        h, w = picture.shape[:2]
        coarse, fine = (
            self.rng.standard_normal((max(2, round(h / scale)), max(2, round(w / scale))), dtype=np.float32)
            for scale in (cells, cells / 6)
        )
        field = 0.6 * cv2.resize(coarse, fine.shape[::-1], interpolation=cv2.INTER_LINEAR) + 0.4 * fine
        gain = np.clip(128 * (1 + strength * np.clip(field, -2, 2)), 0, 255).astype(np.uint8)
        gains = cv2.merge([cv2.resize(gain, (w, h), interpolation=cv2.INTER_LINEAR)] * 4)
        return np.asarray(cv2.multiply(picture, gains, scale=1 / 128), dtype=np.uint8)

    def write(self, picture: Picture, text: str, box: tuple[int, int, int, int], ink: Ink) -> None:
        """Write text as large as fits into (left, top, width, height), texels."""
        left, top, width, height = box
        font = _FONTS[int(self.rng.integers(len(_FONTS)))]
        (tw, th), base = cv2.getTextSize(text, font, 1.0, 1)
        scale = min(width / max(tw, 1), height / max(th + base, 1))
        if scale <= 0.05:
            return
        thickness = max(1, round(scale * 1.6))
        origin = (left, top + round((th + base / 2) * scale))
        cv2.putText(picture, text, origin, font, scale * 0.94, ink, thickness, cv2.LINE_AA)

    def lines(self, picture: Picture, box: tuple[int, int, int, int], ink: Ink, *, height: int) -> None:
        """Fill a box with ragged lines of words, `height` texels each."""
        left, top, width, tall = box
        for y in range(top, top + tall - height, max(2, round(height * 1.7))):
            x, end = left, left + round(width * self.rng.uniform(0.55, 1.0))
            if height >= 7:
                text = self.word()
                while len(text) * height * 0.7 < end - left:
                    text += " " + self.word()
                self.write(picture, text, (left, y, end - left, height), ink)
                continue
            while x < end:
                n = int(self.rng.integers(2, 9)) * max(1, height // 2)
                picture[y : y + height, x : min(x + n, end)] = ink
                x += n + max(2, height)

    def shapes(self, picture: Picture, box: tuple[int, int, int, int], count: int) -> None:
        """Scatter discs, bars, triangles and rings over a box."""
        left, top, width, height = box
        view = picture[top : top + height, left : left + width]
        size = min(width, height)
        for _ in range(count):
            ink = self.inks.any()
            cx, cy = int(self.rng.integers(width)), int(self.rng.integers(height))
            r = max(2, int(size * self.rng.uniform(0.06, 0.3)))
            kind = int(self.rng.integers(5))
            if kind == 0:
                cv2.circle(view, (cx, cy), r, ink, -1, cv2.LINE_AA)
            elif kind == 1:
                cv2.circle(view, (cx, cy), r, ink, max(2, r // 4), cv2.LINE_AA)
            elif kind == 2:
                cv2.rectangle(view, (cx - r, cy - r // 2), (cx + r, cy + r // 2), ink, -1)
            elif kind == 3:
                points = self.rng.integers(-r, r + 1, (3, 2)) + np.array([cx, cy])
                cv2.fillPoly(view, [points.astype(np.int32)], ink, cv2.LINE_AA)
            else:
                cv2.line(
                    view,
                    (cx - r, cy),
                    (cx + r, cy + int(self.rng.integers(-r, r + 1))),
                    ink,
                    max(2, r // 5),
                    cv2.LINE_AA,
                )

    def _inset(self, picture: Picture, share: float) -> tuple[int, int, int, int]:
        h, w = picture.shape[:2]
        m = round(min(h, w) * share)
        return m, m, max(1, w - 2 * m), max(1, h - 2 * m)

    # -- rooms -------------------------------------------------------------------------------------------------

    def wall(self, width_m: float, height_m: float) -> Texture:
        """Return a wall: painted, papered in stripes, tiled half-way, or of bricks."""
        kind = int(self.rng.integers(4))
        base = self.inks.bright() if self.rng.random() < 0.7 else self.inks.muted()
        picture = self.sheet(width_m, height_m, base, pitch_m=COARSE_M)
        h, w = picture.shape[:2]
        if kind == 1:
            step, other = round(self.rng.uniform(0.08, 0.3) / COARSE_M), self.inks.bright()
            for x in range(0, w, 2 * step):
                picture[:, x : x + step] = other
        elif kind == 2:
            self._courses(picture, 0.15, 0.15, self.inks.muted(), top=round(h * self.rng.uniform(0.4, 0.6)), stagger=0)
        elif kind == 3:
            self._courses(picture, 0.24, 0.075, self.inks.of((168, 88, 66)), top=0, stagger=0.5)
        if kind < 2:
            rail = round(h * self.rng.uniform(0.55, 0.7))
            picture[rail:] = (picture[rail:] * np.float32(self.rng.uniform(0.6, 0.95))).astype(np.uint8)
            picture[rail : rail + 8] = self.inks.muted()
        return Texture(self.grain(picture, 0.03, cells=120))

    def floor(self, width_m: float, height_m: float) -> Texture:
        """Return a floor: planks, checks or carpet."""
        kind = int(self.rng.integers(3))
        if kind == 0:
            light, dark = self.inks.wood()
            picture = self.sheet(width_m, height_m, light, pitch_m=COARSE_M)
            self._courses(picture, 1.1, 0.14, dark, top=0, stagger=0.37, joint=1)
            return Texture(self.grain(picture, 0.06, cells=30), gloss=0.15)
        picture = self.sheet(width_m, height_m, self.inks.muted(), pitch_m=COARSE_M)
        if kind == 1:
            step = round(self.rng.uniform(0.25, 0.45) / COARSE_M)
            h, w = picture.shape[:2]
            odd = ((np.arange(h)[:, None] // step + np.arange(w) // step) % 2).astype(bool)
            picture[odd] = self.inks.dark() if self.rng.random() < 0.5 else self.inks.muted()
            return Texture(self.grain(picture, 0.04, cells=step), gloss=0.2)
        return Texture(self.grain(picture, 0.12, cells=9))

    def _courses(
        self, picture: Picture, length_m: float, height_m: float, ink: Ink, *, top: int, stagger: float, joint: int = 2
    ) -> None:
        """Draw bricks, tiles or planks, each of its own tone; joints keep the background."""
        h, w = picture.shape[:2]
        length, height = max(4, round(length_m / COARSE_M)), max(4, round(height_m / COARSE_M))
        for course, y in enumerate(range(top, h, height)):
            for x in range(-round(course * stagger * length) % length - length, w, length):
                tone = np.clip(np.array(ink) * np.float32(self.rng.uniform(0.72, 1.12)), 0, 255)
                picture[y + joint : y + height, max(0, x + joint) : max(0, x + length)] = tone.astype(np.uint8)

    def door(self, width_m: float, height_m: float) -> Texture:
        """Return a door with panels and a handle."""
        ink = self.inks.muted()
        picture = self.sheet(width_m, height_m, ink, pitch_m=0.0025)
        h, w = picture.shape[:2]
        shade = tuple(round(v * 0.7) for v in ink)
        for top, bottom in ((0.06, 0.42), (0.5, 0.93)):
            for left, right in ((0.1, 0.46), (0.54, 0.9)):
                corners = (int(w * left), int(h * top)), (int(w * right), int(h * bottom))
                cv2.rectangle(picture, *corners, shade, 5)
        cv2.rectangle(picture, (int(w * 0.88), int(h * 0.46)), (int(w * 0.97), int(h * 0.48)), self.inks.dark(), -1)
        cv2.rectangle(picture, (0, 0), (w - 1, h - 1), self.inks.bright(), 14)
        return Texture(self.grain(picture, 0.03), gloss=0.2)

    def window(self, width_m: float, height_m: float) -> Texture:
        """Return a window with bars, and a view of hills and houses; its glass returns no laser light."""

        def glass(r: int, g: int, b: int) -> Ink:
            return r, g, b, 2

        picture = self.sheet(width_m, height_m, glass(170, 200, 235), pitch_m=0.003)
        h, w = picture.shape[:2]
        ridge = np.stack([np.linspace(0, w, 9), h * self.rng.uniform(0.35, 0.6, 9)], axis=-1)
        hill = np.concatenate([ridge, [[w, h], [0, h]]]).astype(np.int32)
        cv2.fillPoly(picture, [hill], glass(70, int(self.rng.integers(95, 140)), 70))
        for _ in range(int(self.rng.integers(3, 7))):
            x, y = int(self.rng.integers(w)), int(h * self.rng.uniform(0.45, 0.8))
            s = int(w * self.rng.uniform(0.06, 0.16))
            r, g, b = (int(v) for v in self.rng.integers(90, 220, 3))
            cv2.rectangle(picture, (x, y), (x + s, y + s), glass(r, g, b), -1)
            roof = np.array([[x - s // 5, y], [x + s + s // 5, y], [x + s // 2, y - s // 2]], dtype=np.int32)
            cv2.fillPoly(picture, [roof], glass(150, 60, 50))
        bar, frame = max(6, w // 40), self.inks.of((235, 235, 230))
        for i in range(1, int(self.rng.integers(2, 4))):
            x = w * i // 3
            picture[:, x - bar // 2 : x + bar // 2] = frame
        picture[h // 3 - bar // 2 : h // 3 + bar // 2] = frame
        cv2.rectangle(picture, (0, 0), (w - 1, h - 1), frame, 3 * bar)
        return Texture(picture, glow=0.35, excess_k=_COLD_GLASS_K)

    # -- print -------------------------------------------------------------------------------------------------

    def poster(self, width_m: float, height_m: float) -> Texture:
        """Return a poster, map, notice or diagram."""
        picture = self.sheet(width_m, height_m, self.inks.any())
        h, w = picture.shape[:2]
        left, top, width, height = self._inset(picture, 0.06)
        kind = int(self.rng.integers(4))
        if kind == 0:
            self.shapes(picture, (0, h // 5, w, h - h // 5), 14)
            self.write(picture, self.word(), (left, top, width, h // 7), self.inks.dark())
        elif kind == 1:
            picture[:] = self.inks.bright()
            self.write(picture, self.word(), (left, top, width, h // 9), self.inks.vivid())
            self.lines(picture, (left, top + h // 7, width // 2, height - h // 7), self.inks.dark(), height=9)
            self.shapes(picture, (left + width * 11 // 20, top + h // 6, width * 9 // 20, height * 2 // 3), 8)
        elif kind == 2:
            n = int(self.rng.integers(3, 6))
            for i in range(n):
                for j in range(n):
                    cell = picture[top + height * i // n : top + height * (i + 1) // n - 4]
                    cell[:, left + width * j // n : left + width * (j + 1) // n - 4] = self.inks.any()
            self.shapes(picture, (left, top, width, height), 5)
        else:
            for i in range(int(self.rng.integers(5, 9)), 0, -1):
                centre = (int(w * self.rng.uniform(0.2, 0.8)), int(h * self.rng.uniform(0.2, 0.8)))
                cv2.circle(picture, centre, int(min(h, w) * 0.11 * i), self.inks.any(), -1, cv2.LINE_AA)
            self.write(picture, self.word(), (left, h * 3 // 4, width, h // 6), self.inks.bright())
        cv2.rectangle(picture, (0, 0), (w - 1, h - 1), self.inks.any(), max(2, w // 60))
        return Texture(picture, gloss=0.08 if self.rng.random() < 0.5 else 0.0)

    def page(self, width_m: float, height_m: float) -> Texture:
        """Return a written page."""
        picture = self.sheet(width_m, height_m, self.inks.bright())
        box = self._inset(picture, 0.09)
        self.lines(picture, box, self.inks.dark(), height=int(self.rng.integers(3, 10)))
        if self.rng.random() < 0.6:
            h, w = picture.shape[:2]
            self.shapes(picture, (w // 2, h // 2, w // 3, h // 3), 4)
        return Texture(picture)

    def pinboard(self, width_m: float, height_m: float) -> Texture:
        """Return a board with notes pinned on it."""
        picture = self.grain(self.sheet(width_m, height_m, self.inks.of((176, 132, 88)), pitch_m=0.002), 0.08, cells=6)
        h, w = picture.shape[:2]
        for _ in range(int(self.rng.integers(9, 16))):
            s, t = int(w * self.rng.uniform(0.08, 0.2)), int(h * self.rng.uniform(0.14, 0.3))
            x, y = int(self.rng.integers(10, max(11, w - s - 10))), int(self.rng.integers(10, max(11, h - t - 10)))
            picture[y : y + t, x : x + s] = self.inks.bright() if self.rng.random() < 0.6 else self.inks.vivid()
            ink, tall = self.inks.dark(), int(self.rng.integers(3, 11))
            self.lines(picture, (x + s // 8, y + t // 8, s * 3 // 4, t * 3 // 4), ink, height=tall)
        cv2.rectangle(picture, (0, 0), (w - 1, h - 1), self.inks.wood()[0], 14)
        return Texture(picture)

    def label(self, picture: Picture) -> None:
        """Stick a label with text and a bar code somewhere on a picture."""
        h, w = picture.shape[:2]
        s, t = int(w * self.rng.uniform(0.3, 0.5)), int(h * self.rng.uniform(0.25, 0.45))
        if min(s, t) < 20:
            return
        x, y = int(self.rng.integers(0, w - s)), int(self.rng.integers(0, h - t))
        sticker = picture[y : y + t, x : x + s]
        sticker[:] = self.inks.bright()
        ink = self.inks.dark()
        self.lines(sticker, (s // 12, t // 12, s * 5 // 6, t // 2), ink, height=max(4, t // 9))
        bars = np.repeat(self.rng.random(s) < 0.5, int(self.rng.integers(2, 5)))[: s * 5 // 6]
        code = sticker[t * 2 // 3 : t * 11 // 12, s // 12 : s // 12 + len(bars)]
        code[:, bars[: code.shape[1]]] = ink

    def carton(self, width_m: float, height_m: float) -> Texture:
        """Return the side of a carton: cardboard or coloured, with print, tape and labels."""
        if self.rng.random() < 0.55:
            base = self.inks.of(tuple(int(v) for v in np.array([188, 148, 104]) * self.rng.uniform(0.75, 1.1)))  # type: ignore[arg-type]
        else:
            base = self.inks.muted() if self.rng.random() < 0.5 else self.inks.vivid()
        picture = self.grain(self.sheet(width_m, height_m, base), 0.04, cells=25)
        h, w = picture.shape[:2]
        kind = int(self.rng.integers(5))
        if kind == 0:
            self.write(picture, self.word(), (w // 10, h // 6, w * 4 // 5, h // 3), self.inks.any())
        elif kind == 1:
            self.shapes(picture, (0, 0, w, h), 7)
        elif kind == 2:
            step = max(6, round(self.rng.uniform(0.03, 0.08) / PITCH_M))
            odd = ((np.arange(h)[:, None] // step + np.arange(w) // step) % 2).astype(bool)
            picture[odd] = self.inks.any()
        elif kind == 3:
            ink = self.inks.any()
            picture[h // 3 : h * 2 // 3] = ink
            self.write(picture, self.word(), (w // 8, h * 3 // 8, w * 3 // 4, h // 4), self.inks.bright())
        if self.rng.random() < 0.6:
            self.label(picture)
        if self.rng.random() < 0.5:
            x = w // 2 - max(4, w // 20)
            tape = picture[:, x : x + max(8, w // 10)]
            tape[:] = (0.6 * tape + 0.4 * np.array(self.inks.bright())).astype(np.uint8)
        return Texture(picture, gloss=0.1 if kind == 1 else 0.0)

    def spine(self, width_m: float, height_m: float) -> Texture:
        """Return the spine of a book or a binder."""
        picture = self.sheet(width_m, height_m, self.inks.any())
        h, w = picture.shape[:2]
        for _ in range(int(self.rng.integers(1, 4))):
            y, t = int(self.rng.integers(h)), int(self.rng.integers(2, max(3, h // 7)))
            picture[y : y + t] = self.inks.any()
        if w >= 9 and self.rng.random() < 0.8:
            strip = np.full((w, h * 2 // 3, 4), picture[h // 2, 0], np.uint8)
            self.write(strip, self.word() + " " + self.word(), (2, w // 6, h * 2 // 3 - 4, w * 2 // 3), self.inks.any())
            picture[h // 6 : h // 6 + strip.shape[1], :] = strip.transpose(1, 0, 2)[:, ::-1][: h - h // 6]
        return Texture(picture, gloss=0.1)

    # -- materials ---------------------------------------------------------------------------------------------

    def wood(self, width_m: float, height_m: float, tones: tuple[Ink, Ink] | None = None) -> Texture:
        """Return a board; its grain runs along the longer side."""
        light, dark = tones or self.inks.wood()
        h, w = max(4, round(height_m / 0.0025)), max(4, round(width_m / 0.0025))
        along, across = max(h, w), min(h, w)
        wave = np.cumsum(self.rng.standard_normal(along)) * 0.25
        wave = (wave - np.linspace(wave[0], wave[-1], along)).astype(np.float32)
        position = np.arange(across, dtype=np.float32)[:, None] + wave
        ring = 0.5 + 0.5 * np.sin(
            position * np.float32(self.rng.uniform(0.25, 0.6)) + 2 * np.sin(position * np.float32(0.07))
        )
        mix = np.linspace(0, 1, 64)[:, None] ** 2
        tones64 = ((1 - mix) * np.array(light) + mix * np.array(dark)).astype(np.uint8).view(np.uint32).ravel()
        board = tones64[(ring * 63).astype(np.uint8)]
        board = np.ascontiguousarray(board if w >= h else board.T).view(np.uint8).reshape(h, w, 4)
        return Texture(self.grain(board, 0.04), gloss=0.1)

    def plain(
        self, ink: Ink, *, metal: float = 0.0, gloss: float = 0.0, glow: float = 0.0, excess_k: float = 0.0
    ) -> Texture:
        """Return a texture of one ink, slightly worn."""
        picture = self.grain(np.full((48, 48, 4), ink, np.uint8), 0.03, cells=12)
        return Texture(picture, metal=metal, gloss=gloss, glow=glow, excess_k=excess_k)

    def fabric(self, width_m: float, height_m: float, *, pitch_m: float = 0.003, excess_k: float = 0.0) -> Texture:
        """Return cloth: plain, striped, checked or with a print on its front."""
        base, other = self.inks.muted() if self.rng.random() < 0.5 else self.inks.vivid(), self.inks.any()
        picture = self.sheet(width_m, height_m, base, pitch_m=pitch_m)
        h, w = picture.shape[:2]
        step = max(3, round(self.rng.uniform(0.02, 0.06) / pitch_m))
        y, x = np.mgrid[:h, :w] // step
        kind = int(self.rng.integers(4))
        if kind == 0:
            picture[(y % 2).astype(bool)] = other
        elif kind == 1:
            both = (0.5 * np.array(base) + 0.5 * np.array(other)).astype(np.uint8)
            picture[((x % 2) ^ (y % 2)).astype(bool)] = both
            picture[((x % 2) & (y % 2)).astype(bool)] = other
        elif kind == 2:
            s, t = w // 6, h // 4
            chest = picture[h // 5 : h // 5 + t, w // 2 - s // 2 : w // 2 - s // 2 + s]
            chest[:] = other
            self.shapes(picture, (w // 2 - s // 2, h // 5, s, t), 4)
            self.write(picture, self.word(), (w // 2 - s // 2, h // 5 + t, s, t // 2), other)
        return Texture(self.grain(picture, 0.07, cells=7), excess_k=excess_k)

    def screen(self, width_m: float, height_m: float) -> Texture:
        """Return a lit screen with windows of text and a diagram."""
        picture = self.sheet(width_m, height_m, self.inks.of((30, 60, 110)))
        h, w = picture.shape[:2]
        for _ in range(int(self.rng.integers(3, 6))):
            s, t = int(w * self.rng.uniform(0.3, 0.6)), int(h * self.rng.uniform(0.3, 0.6))
            x, y = int(self.rng.integers(0, w - s)), int(self.rng.integers(0, h - t))
            pale = self.rng.random() < 0.6
            pane = picture[y : y + t, x : x + s]
            pane[:] = self.inks.bright() if pale else self.inks.dark()
            pane[: max(3, t // 10)] = self.inks.vivid()
            ink = self.inks.dark() if pale else self.inks.bright()
            self.lines(pane, (s // 12, t // 6, s * 5 // 6, t * 3 // 4), ink, height=int(self.rng.integers(3, 9)))
            if self.rng.random() < 0.4:
                self.shapes(pane, (s // 2, t // 4, s // 2, t * 3 // 4), 5)
        # The laser hits the glass, not the image behind it.
        picture[..., 3] = int(self.rng.integers(12, 90))
        return Texture(picture, gloss=0.3, glow=0.35, excess_k=_SCREEN_K)

    def keys(self, width_m: float, height_m: float) -> Texture:
        """Return a keyboard."""
        picture = self.sheet(width_m, height_m, self.inks.dark())
        h, w = picture.shape[:2]
        key = self.inks.muted()
        for i in range(5):
            for j in range(15):
                y, x = h * i // 5 + 2, w * j // 15 + 1
                picture[y : h * (i + 1) // 5 - 1, x : w * (j + 1) // 15 - 1] = key
        return Texture(picture)

    def wrap(self, around_m: float, height_m: float) -> Texture:
        """Return the wrap of a mug, a can or a drum: bands and a printed front."""
        picture = self.sheet(around_m, height_m, self.inks.any())
        h, w = picture.shape[:2]
        for _ in range(int(self.rng.integers(1, 4))):
            y = int(self.rng.integers(h))
            picture[y : y + max(3, h // 9)] = self.inks.any()
        s = w // 3
        patch = picture[h // 4 : h * 3 // 4, w // 2 - s // 2 : w // 2 - s // 2 + s]
        patch[:] = self.inks.bright()
        self.write(picture, self.word(), (w // 2 - s // 2 + 3, h // 3, s - 6, h // 4), self.inks.vivid())
        return Texture(picture, gloss=0.25)

    def ball(self, around_m: float) -> Texture:
        """Return a beach ball's segments."""
        picture = self.sheet(around_m, around_m / 2, self.inks.any())
        w = picture.shape[1]
        n = int(self.rng.integers(4, 9))
        for i in range(n):
            picture[:, w * i // n : w * (i + 1) // n] = self.inks.any()
        return Texture(picture, gloss=0.3)

    def leaves(self, around_m: float) -> Texture:
        """Return foliage."""
        picture = self.sheet(around_m, around_m / 2, self.inks.of((45, 85, 40)), pitch_m=0.003)
        h, w = picture.shape[:2]
        tones = [self.inks.of((int(30 + 60 * t), int(80 + 80 * t), int(30 + 40 * t))) for t in self.rng.random(4)]
        for _ in range(h * w // 60):
            centre = (int(self.rng.integers(w)), int(self.rng.integers(h)))
            axes = (int(self.rng.integers(3, 9)), int(self.rng.integers(2, 4)))
            ink = tones[int(self.rng.integers(4))]
            cv2.ellipse(picture, centre, axes, float(self.rng.uniform(0, 180)), 0, 360, ink, -1)
        return Texture(picture, excess_k=_LEAVES_K)

    def face(self, skin: Ink) -> Texture:
        """Return a head: eyes, brows, mouth in front, hair on top and behind."""
        picture = np.full((160, 320, 4), skin, np.uint8)
        hair, dark = self.inks.of(_hair(self.rng)), self.inks.dark()
        picture[: int(self.rng.integers(30, 50))] = hair
        picture[:110, :95] = hair
        picture[:110, 225:] = hair
        for side in (-1, 1):
            cv2.ellipse(picture, (160 + side * 20, 74), (9, 5), 0, 0, 360, self.inks.of((240, 240, 240)), -1)
            cv2.circle(picture, (160 + side * 20, 74), 4, dark, -1)
            cv2.line(picture, (160 + side * 10, 62), (160 + side * 30, 60), hair, 4)
        cv2.line(picture, (160, 78), (156, 92), tuple(round(v * 0.8) for v in skin), 3)
        cv2.ellipse(picture, (160, 108), (14, 4), 0, 0, 360, self.inks.of((150, 60, 60)), -1)
        if self.rng.random() < 0.3:
            picture[112:135, 120:200] = hair
        return Texture(picture, excess_k=SKIN_K)


def _hair(rng: np.random.Generator) -> tuple[int, int, int]:
    tones = [(30, 24, 20), (80, 52, 30), (150, 110, 60), (120, 60, 30), (150, 150, 150)]
    return tones[int(rng.integers(len(tones)))]
