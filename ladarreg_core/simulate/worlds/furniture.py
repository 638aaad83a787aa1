"""Furniture, clutter and people; each stands at a placement, its front towards the placement's -x."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.simulate.worlds.textures import SKIN_K, Printer
from ladarreg_core.simulate.worlds.world import Placement, Texture, WorldBuilder

# Temperatures over the air, K, of electronics, lamps, clothed people and hot water.
_CASE_K, _SHADE_K = 6.0, 22.0
_SHIRT_K, _TROUSERS_K, _SHOES_K = 7.0, 5.5, 2.5
_PIPE_K, _PIPE_RADIUS_M = 18.0, 0.022


@dataclass(frozen=True)
class Workshop:
    """Tools and options with which objects are built."""

    builder: WorldBuilder
    printer: Printer
    heated: bool = False
    """Whether there are heating pipes."""

    @property
    def rng(self) -> np.random.Generator:
        """The random generator of the scene."""
        return self.printer.rng

    def cylinder(
        self, at: Placement, radius_m: float, height_m: float, texture: Texture, *, top_radius_m: float | None = None
    ) -> None:
        """Add an upright closed cylinder or cone."""
        top = radius_m if top_radius_m is None else top_radius_m
        profile = [(0.0, radius_m), (height_m, top), (height_m, top * 0.02)]
        self.builder.lathe(
            at.points([0, 0, 0]), at.points([0, 0, height_m]), profile, texture, front=at.vectors([-1, 0, 0])
        )

    def ball(self, at: Placement, radius_m: float, texture: Texture, *, stretch: float = 1.0) -> None:
        """Add a ball, or an upright ellipsoid, that lies on its placement."""
        polar = np.linspace(-np.pi / 2, np.pi / 2, 15)
        profile = [(radius_m * stretch * (1 + np.sin(p)), radius_m * np.cos(p)) for p in polar]
        tip = at.points([0, 0, 2 * radius_m * stretch])
        self.builder.lathe(at.points([0, 0, 0]), tip, profile, texture, front=at.vectors([-1, 0, 0]))

    def limb(
        self, base: ArrayLike, tip: ArrayLike, radii_m: tuple[float, float], texture: Texture, *, squash: float = 1.0
    ) -> None:
        """Add a capsule between two points (3,), of one radius at each."""
        a, b = np.asarray(base, dtype=np.float64), np.asarray(tip, dtype=np.float64)
        length, (r0, r1) = float(np.linalg.norm(b - a)), radii_m
        polar = np.linspace(-np.pi / 2, 0, 5)
        profile = [(r0 * np.sin(p), r0 * np.cos(p)) for p in polar]
        profile += [(length - r1 * np.sin(p), r1 * np.cos(p)) for p in polar[::-1]]
        front = (0.0, 1.0, 0.0) if abs((b - a)[0]) > 0.9 * length else (-1.0, 0.0, 0.0)
        self.builder.lathe(a, b, profile, texture, squash=squash, sectors=18, front=front)

    def panel(self, at: Placement, width_m: float, height_m: float, texture: Texture) -> None:
        """Add an upright sheet, seen from the front, whose bottom edge is centred at its placement."""
        self.builder.quad(
            at.points([0, width_m / 2, height_m]), at.vectors([0, -width_m, 0]), at.vectors([0, 0, -height_m]), texture
        )

    def paper(self, at: Placement, width_m: float, depth_m: float, texture: Texture) -> None:
        """Add a sheet that lies on its placement, read from the front."""
        self.builder.quad(
            at.points([depth_m / 2, width_m / 2, 0.003]),
            at.vectors([0, -width_m, 0]),
            at.vectors([-depth_m, 0, 0]),
            texture,
        )


def room(shop: Workshop, *, floor_z: float, depth_m: float, half_width_m: float, height_m: float) -> None:
    """Add floor, ceiling and four walls around the scanner; the wall behind it lets light in."""
    b, p = shop.builder, shop.printer
    behind, wide = -1.5, 2 * half_width_m
    deep = depth_m - behind
    top = floor_z + height_m
    plain = p.plain(p.inks.bright())
    b.quad((depth_m, half_width_m, top), (0, -wide, 0), (0, 0, -height_m), p.wall(wide, height_m))
    side = p.wall(deep, height_m)
    b.quad((behind, half_width_m, top), (deep, 0, 0), (0, 0, -height_m), side)
    b.quad((depth_m, -half_width_m, top), (-deep, 0, 0), (0, 0, -height_m), side)
    b.quad((behind, -half_width_m, top), (0, wide, 0), (0, 0, -height_m), plain)
    b.quad((depth_m, half_width_m, floor_z), (0, -wide, 0), (-deep, 0, 0), p.floor(wide, deep))
    b.quad((behind, half_width_m, top), (0, -wide, 0), (deep, 0, 0), plain)
    board = p.plain(p.inks.wood()[1])
    b.box(Placement(depth_m - 0.01, 0, floor_z), (0.02, wide, 0.09), board)


def carton(shop: Workshop, at: Placement, size: tuple[float, float, float]) -> None:
    """Add a carton of (depth, width, height) with prints on its visible sides."""
    d, w, h = size
    p = shop.printer
    side = p.carton(d, h)
    shop.builder.box(at, size, side, front=p.carton(w, h), top=p.carton(w, d))


def stack(shop: Workshop, at: Placement, width_m: float, height_m: float) -> None:
    """Stack cartons to about a height, sometimes with an ornament on top."""
    rng = shop.rng

    def u(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    z = 0.0
    while z < height_m - 0.1:
        size = (width_m * u(0.6, 0.95), width_m * u(0.75, 1.0), min(u(0.18, 0.5), height_m - z))
        carton(shop, at.on(u(-0.04, 0.04), 0, z, u(-0.3, 0.3)), size)
        z += size[2] + 0.0005
    if rng.random() < 0.5:
        ornament(shop, at.on(0, 0, z), width_m * 0.6, 0.3)


def books(shop: Workshop, at: Placement, length_m: float, *, tallest_m: float, depth_m: float = 0.22) -> None:
    """Add a row of standing books along the placement's y, some leaning out or missing."""
    rng, p = shop.rng, shop.printer
    paper = p.plain(p.inks.bright())
    y = -length_m / 2
    while y < length_m / 2 - 0.02:
        thick = float(rng.uniform(0.018, 0.065))
        if y + thick > length_m / 2:
            break
        if rng.random() < 0.06:
            y += float(rng.uniform(0.04, 0.14))
            continue
        tall, deep = float(rng.uniform(0.6, 0.97)) * tallest_m, depth_m * float(rng.uniform(0.75, 1.0))
        spine = p.spine(thick, tall)
        cover = Texture(np.ascontiguousarray(spine.picture[:3, :3]), gloss=0.1)
        here = at.on(deep / 2 + float(rng.uniform(0, 0.03)), -(y + thick / 2), 0)
        shop.builder.box(here, (deep, thick * 0.96, tall), cover, front=spine, top=paper)
        y += thick


def pile_of_books(shop: Workshop, at: Placement, count: int) -> None:
    """Add a pile of books, each slightly rotated."""
    rng, p = shop.rng, shop.printer
    z = 0.0
    for _ in range(count):
        d, w, h = float(rng.uniform(0.14, 0.22)), float(rng.uniform(0.2, 0.3)), float(rng.uniform(0.015, 0.05))
        cover = p.spine(w, h)
        shop.builder.box(at.on(0, 0, z, float(rng.uniform(-0.4, 0.4))), (d, w, h), cover, top=p.poster(w, d))
        z += h + 0.0005


def bookcase(shop: Workshop, at: Placement, *, width_m: float, height_m: float) -> None:
    """Add a case of shelves with books, boxes and ornaments."""
    rng, p, b = shop.rng, shop.printer, shop.builder
    depth, board = 0.3, 0.022
    tones = p.inks.wood() if rng.random() < 0.6 else (p.inks.muted(), p.inks.muted())
    upright, shelf = p.wood(depth, height_m, tones), p.wood(width_m, 0.03, tones)
    b.box(at.on(depth / 2, width_m / 2, 0), (depth, board, height_m), upright)
    b.box(at.on(depth / 2, -width_m / 2, 0), (depth, board, height_m), upright)
    b.box(at.on(depth - 0.006, 0, 0), (0.01, width_m, height_m), p.wood(width_m, height_m, tones))
    count = max(2, round(height_m / float(rng.uniform(0.32, 0.4))))
    step = (height_m - board) / count
    for i in range(count + 1):
        b.box(at.on(depth / 2, 0, i * step), (depth, width_m - board, board), shelf)
        if i == count:
            break
        here = at.on(0, 0, i * step + board)
        room_m, kind = step - board - 0.02, rng.random()
        inner = width_m - 2 * board - 0.02
        if kind < 0.65:
            books(shop, here.on(0.02, 0, 0), inner, tallest_m=room_m)
        elif kind < 0.85:
            share = float(rng.uniform(0.35, 0.65))
            books(shop, here.on(0.02, inner * (1 - share) / 2, 0), inner * share, tallest_m=room_m)
            ornament(shop, here.on(0.12, -inner * share / 2, 0), inner * (1 - share) * 0.8, room_m)
        else:
            n = int(rng.integers(2, 4))
            for k in range(n):
                size = (0.22, inner / n * float(rng.uniform(0.6, 0.92)), room_m * float(rng.uniform(0.55, 0.95)))
                carton(shop, here.on(0.14, inner * ((k + 0.5) / n - 0.5), 0, float(rng.uniform(-0.06, 0.06))), size)


def ornament(shop: Workshop, at: Placement, width_m: float, height_m: float) -> None:
    """Add an ornament for a shelf: a ball, a vase, a pile of books or a framed picture."""
    rng, p = shop.rng, shop.printer
    kind = int(rng.integers(4))
    if kind == 0:
        radius = min(width_m, height_m) * 0.4
        shop.ball(at, radius, p.ball(2 * np.pi * radius))
    elif kind == 1:
        vase(shop, at, min(height_m * 0.9, 0.3))
    elif kind == 2:
        pile_of_books(shop, at, int(rng.integers(2, 5)))
    else:
        w, h = width_m * 0.8, height_m * 0.8
        shop.builder.box(
            at.on(0, 0, 0, float(rng.uniform(-0.3, 0.3))), (0.02, w, h), p.plain(p.inks.dark()), front=p.poster(w, h)
        )


def vase(shop: Workshop, at: Placement, height_m: float) -> None:
    """Add a vase."""
    p, rng = shop.printer, shop.rng
    t = np.linspace(0, 1, 14)
    waist = 0.16 + 0.14 * np.sin(2.6 * t + float(rng.uniform(-0.3, 0.5)))
    profile = [(float(height_m * a), float(height_m * r)) for a, r in zip(t, waist, strict=True)]
    profile += [(height_m, 0.02 * height_m)]
    shop.builder.lathe(at.points([0, 0, 0]), at.points([0, 0, height_m]), profile, p.wrap(height_m, height_m))


def desk(shop: Workshop, at: Placement, *, width_m: float, depth_m: float = 0.75) -> Placement:
    """Add a desk and return the placement of the middle of its top."""
    p, b = shop.printer, shop.builder
    height, tones = float(shop.rng.uniform(0.7, 0.78)), p.inks.wood()
    edge = p.wood(width_m, 0.035, tones)
    b.box(at.on(0, 0, height - 0.035), (depth_m, width_m, 0.035), edge, top=p.wood(width_m, depth_m, tones))
    leg = p.plain(p.inks.any(), gloss=0.2)
    for y in (-1, 1):
        for x in (-1, 1):
            b.box(at.on(x * (depth_m / 2 - 0.05), y * (width_m / 2 - 0.06), 0), (0.05, 0.05, height - 0.035), leg)
    if shop.rng.random() < 0.7:
        side = float(shop.rng.choice([-1.0, 1.0]))
        drawers(shop, at.on(0.05, side * (width_m / 2 - 0.33), 0), (depth_m - 0.15, 0.42, height - 0.06))
    return at.on(0, 0, height)


def drawers(shop: Workshop, at: Placement, size: tuple[float, float, float]) -> None:
    """Add a chest of drawers with handles and a label on each."""
    p, b = shop.printer, shop.builder
    d, w, h = size
    b.box(at, size, p.plain(p.inks.muted(), metal=0.15))
    n = max(2, round(h / 0.25))
    ink, handle = p.inks.muted(), p.plain(p.inks.dark(), metal=0.3)
    for i in range(n):
        front = p.sheet(w * 0.92, h / n * 0.88, ink)
        p.label(front)
        here = at.on(-d / 2 - 0.008, 0, h * (i + 0.06) / n)
        b.box(here, (0.016, w * 0.92, h / n * 0.88), p.plain(ink), front=Texture(front, gloss=0.1))
        b.box(here.on(-0.02, 0, h / n * 0.68), (0.02, w * 0.35, 0.015), handle)


def chair(shop: Workshop, at: Placement) -> None:
    """Add an office chair: seat, back, stem and a star foot."""
    p, b = shop.printer, shop.builder
    cloth, steel = p.fabric(0.46, 0.5), p.plain(p.inks.dark(), metal=0.5, gloss=0.2)
    b.box(at.on(0, 0, 0.45), (0.46, 0.48, 0.07), cloth)
    b.box(at.on(0.23, 0, 0.58), (0.05, 0.44, 0.5), cloth)
    b.box(at.on(0.26, 0, 0.48), (0.03, 0.08, 0.3), steel)
    shop.cylinder(at.on(0, 0, 0.08), 0.028, 0.38, steel)
    for k in range(5):
        b.box(at.on(0, 0, 0.04, k * 2 * np.pi / 5).on(-0.14, 0, 0), (0.28, 0.04, 0.04), steel)


def monitor(shop: Workshop, at: Placement) -> None:
    """Add a monitor on its foot."""
    p, b = shop.printer, shop.builder
    w = float(shop.rng.uniform(0.48, 0.68))
    h = w * 0.58
    case = p.plain(p.inks.dark(), gloss=0.2, excess_k=_CASE_K)
    b.box(at.on(0, 0, 0), (0.18, 0.24, 0.015), case)
    b.box(at.on(0.03, 0, 0.015), (0.03, 0.05, 0.2), case)
    b.box(at.on(0, 0, 0.12), (0.035, w, h), case)
    shop.panel(at.on(-0.0185, 0, 0.132), w - 0.024, h - 0.024, p.screen(w, h))


def keyboard(shop: Workshop, at: Placement) -> None:
    """Add a keyboard."""
    p = shop.printer
    shop.builder.box(at, (0.15, 0.44, 0.02), p.plain(p.inks.dark()), top=p.keys(0.44, 0.15))


def mug(shop: Workshop, at: Placement) -> None:
    """Add a mug with its handle."""
    p = shop.printer
    r, h = float(shop.rng.uniform(0.036, 0.05)), float(shop.rng.uniform(0.085, 0.12))
    body = p.wrap(2 * np.pi * r, h)
    shop.cylinder(at, r, h, body)
    plain = Texture(np.ascontiguousarray(body.picture[:2, :2]), gloss=0.25)
    points = [(0, r + 0.03 * np.sin(a), h / 2 - 0.03 * np.cos(a)) for a in np.linspace(0, np.pi, 5)]
    for a, c in pairwise(points):
        shop.limb(at.points(a), at.points(c), (0.006, 0.006), plain)


def pencil_cup(shop: Workshop, at: Placement) -> None:
    """Add a cup with pencils."""
    p, rng = shop.printer, shop.rng
    shop.cylinder(at, 0.042, 0.1, p.wrap(0.26, 0.1))
    for _ in range(5):
        foot = at.points([*rng.uniform(-0.02, 0.02, 2), 0.09])
        tip = foot + at.vectors([*rng.uniform(-0.03, 0.03, 2), 0.09])
        shop.limb(foot, tip, (0.005, 0.005), p.plain(p.inks.vivid()))


def lamp(shop: Workshop, at: Placement) -> None:
    """Add a desk lamp with two arms and a shade."""
    p, rng = shop.printer, shop.rng
    steel = p.plain(p.inks.any(), metal=0.4, gloss=0.2)
    shop.cylinder(at, 0.09, 0.02, steel)
    elbow, head = [0.05, float(rng.uniform(-0.12, 0.12)), 0.24], [-0.12, float(rng.uniform(-0.12, 0.12)), 0.42]
    shop.limb(at.points([0, 0, 0.02]), at.points(elbow), (0.01, 0.01), steel)
    shop.limb(at.points(elbow), at.points(head), (0.01, 0.01), steel)
    shade = p.plain(p.inks.vivid(), gloss=0.3, glow=0.15, excess_k=_SHADE_K)
    shop.cylinder(at.on(head[0] - 0.03, head[1], head[2] - 0.1), 0.09, 0.12, shade, top_radius_m=0.04)


def plant(shop: Workshop, at: Placement, height_m: float) -> None:
    """Add a potted plant."""
    p, rng = shop.printer, shop.rng
    r = height_m * 0.2
    shop.cylinder(at, r * 0.75, height_m * 0.3, p.wrap(2 * np.pi * r, height_m * 0.3), top_radius_m=r)
    green = p.leaves(2 * np.pi * r)
    for _ in range(7):
        size = r * float(rng.uniform(0.5, 1.0))
        x, y = (float(v) for v in rng.uniform(-1.1, 1.1, 2) * r)
        here = at.on(x, y, height_m * float(rng.uniform(0.3, 0.75)), float(rng.uniform(0, 6)))
        shop.ball(here, size, green, stretch=float(rng.uniform(0.6, 1.2)))


def bin_or_drum(shop: Workshop, at: Placement, radius_m: float, height_m: float) -> None:
    """Add a waste bin or a drum."""
    p = shop.printer
    shop.cylinder(at, radius_m * 0.9, height_m, p.wrap(2 * np.pi * radius_m, height_m), top_radius_m=radius_m)


def cabinet(shop: Workshop, at: Placement, *, width_m: float, height_m: float, depth_m: float = 0.42) -> Placement:
    """Add a cabinet of drawers or doors, and return the placement of its top."""
    p, b = shop.printer, shop.builder
    if shop.rng.random() < 0.5:
        drawers(shop, at, (depth_m, width_m, height_m))
    else:
        front = p.door(width_m, height_m)
        b.box(at, (depth_m, width_m, height_m), p.plain(p.inks.muted()), front=front)
    return at.on(0, 0, height_m)


def clutter(shop: Workshop, top: Placement, *, width_m: float, depth_m: float, count: int) -> None:
    """Scatter papers, mugs, boxes and books over a table top."""
    rng, p = shop.rng, shop.printer
    slots = rng.permutation(count)
    for k in range(count):
        y = ((slots[k] + 0.5) / count - 0.5) * (width_m - 0.2) + float(rng.uniform(-0.02, 0.02))
        here = top.on(float(rng.uniform(-0.3, 0.1)) * depth_m, y, 0, float(rng.uniform(-0.5, 0.5)))
        kind = int(rng.integers(7))
        if kind < 2:
            shop.paper(here, 0.21, 0.297, p.page(0.21, 0.297))
        elif kind == 2:
            mug(shop, here)
        elif kind == 3:
            pile_of_books(shop, here, int(rng.integers(2, 6)))
        elif kind == 4:
            carton(shop, here, tuple(float(v) for v in rng.uniform(0.08, 0.24, 3)))  # type: ignore[arg-type]
        elif kind == 5:
            pencil_cup(shop, here)
        else:
            radius = float(rng.uniform(0.04, 0.09))
            shop.ball(here, radius, p.ball(2 * np.pi * radius))


def person(shop: Workshop, at: Placement, *, height_m: float) -> None:
    """Add a standing person of capsules: shoes, trousers, shirt, arms, head."""
    rng, p = shop.rng, shop.printer
    k = height_m / 1.75
    skin_ink = p.inks.skin()
    skin = p.plain(skin_ink, excess_k=SKIN_K)
    shirt, trousers = p.fabric(1.0, 0.6, excess_k=_SHIRT_K), p.fabric(0.5, 0.8, excess_k=_TROUSERS_K)
    sleeve = Texture(np.ascontiguousarray(shirt.picture[: len(shirt.picture) // 3]), excess_k=_SHIRT_K)
    shoe, hand_side = p.plain(p.inks.dark(), gloss=0.2, excess_k=_SHOES_K), float(rng.choice([-1.0, 1.0]))

    def q(x: float, y: float, z: float) -> NDArray[np.float64]:
        return at.points(np.array([x, y, z]) * k)

    for s in (-1, 1):
        step = float(rng.uniform(-0.09, 0.09))
        hip, knee, ankle = q(0, s * 0.1, 0.92), q(step / 2 - 0.02, s * 0.12, 0.5), q(step, s * 0.12, 0.09)
        shop.limb(knee, hip, (0.065 * k, 0.09 * k), trousers)
        shop.limb(ankle, knee, (0.05 * k, 0.065 * k), trousers)
        shop.limb(q(step + 0.05, s * 0.12, 0.05), q(step - 0.14, s * 0.14, 0.045), (0.05 * k, 0.042 * k), shoe)
    shop.limb(q(0, 0, 0.95), q(0.01, 0, 1.34), (0.165 * k, 0.19 * k), shirt, squash=0.66)
    for s in (-1, 1):
        shoulder = q(0.01, s * 0.2, 1.39)
        if s == hand_side:
            elbow = q(-0.06, s * (0.3 + float(rng.uniform(0, 0.08))), 1.14)
            hand = q(-0.28, s * float(rng.uniform(0.1, 0.3)), 1.1 + float(rng.uniform(0, 0.3)))
        else:
            elbow = q(0.02, s * 0.28, 1.1)
            hand = q(-0.04, s * 0.3, 0.84)
        shop.limb(elbow, shoulder, (0.047 * k, 0.062 * k), sleeve)
        shop.limb(hand, elbow, (0.033 * k, 0.045 * k), sleeve if rng.random() < 0.5 else skin)
        shop.limb(hand, hand + at.vectors([-0.05, 0, -0.05]), (0.042 * k, 0.035 * k), skin)
        if s == hand_side and rng.random() < 0.7:
            sheet = Placement.at(hand + at.vectors([-0.06, 0, -0.1]), at.yaw_rad)
            shop.panel(sheet, 0.24, 0.32, p.page(0.24, 0.32))
    shop.limb(q(0.01, 0, 1.42), q(0, 0, 1.54), (0.055 * k, 0.05 * k), skin)
    head = Placement.at(q(-0.01, 0, 1.5), at.yaw_rad + float(rng.uniform(-0.5, 0.5)))
    shop.ball(head, 0.098 * k, p.face(skin_ink), stretch=1.27)


def heating(shop: Workshop, *, depth_m: float, floor_z: float, half_width_m: float) -> None:
    """Add a pair of heating pipes along the far wall above its board, and the risers that feed them."""
    rng, p = shop.rng, shop.printer
    hot = p.plain(p.inks.bright(), gloss=0.1, excess_k=_PIPE_K)
    cooler = p.plain(p.inks.bright(), gloss=0.1, excess_k=0.7 * _PIPE_K)
    x, riser = depth_m - 0.05, float(rng.uniform(-0.8, 0.8)) * half_width_m
    for k, pipe in enumerate((hot, cooler)):
        z, y = floor_z + 0.16 + 0.1 * k, riser + 0.12 * k
        shop.limb((x, -half_width_m, z), (x, half_width_m, z), (_PIPE_RADIUS_M, _PIPE_RADIUS_M), pipe)
        shop.limb((x, y, z), (x, y, floor_z + 3.0), (_PIPE_RADIUS_M, _PIPE_RADIUS_M), pipe)
