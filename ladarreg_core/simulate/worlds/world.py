"""The mesh that is scanned and photographed: flat faces with printed textures, some with the normals of curved ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.foundations.arrays import FloatArray, IntArray

_EMISSIVITY, _METAL_REFLECTS = 0.94, 0.6
_CLEARANCE_M = 0.003  # above a surface, so that a shadow ray does not hit the face that it leaves

Picture = NDArray[np.uint8]
"""(h, w, 4): inks of a surface."""


@dataclass(frozen=True)
class Texture:
    """Texture of a surface with its optical and thermal properties."""

    picture: Picture
    """(h, w, 4) uint8: gamma-encoded red, green, blue; linear laser albedo."""
    metal: float = 0.0
    """Specular share of the return, 0..1."""
    gloss: float = 0.0
    """Gloss of a coat of lacquer, 0..1."""
    glow: float = 0.0
    """Emitted light, in units of its colour, for screens and windows."""
    excess_k: float = 0.0
    """Temperature over the air, K; visible to a thermal camera only."""

    @property
    def emissivity(self) -> float:
        """Thermal emissivity at normal incidence: nearly 1 for paint and paper, low for bare metal."""
        return _EMISSIVITY - _METAL_REFLECTS * self.metal


@dataclass(frozen=True, eq=False)
class World:
    """A complete scene; face 0 stands for rays that hit nothing."""

    triangles: NDArray[np.float32]
    """(T, 3, 3), scanner frame, m."""
    face_of_triangle: NDArray[np.int32]
    """(T,)."""
    normals: NDArray[np.float64]
    """(3, F), unit."""
    offsets_m: NDArray[np.float64]
    """(F,): normal . point."""
    texel_from_point: NDArray[np.float64]
    """(2, 4, F): the texel (s, t) of a point is linear in it."""
    texel_start: NDArray[np.int64]
    """(F,): where the face's texture starts in `texels`."""
    texture_size: NDArray[np.int64]
    """(2, F): width and height of the face's texture."""
    finish: NDArray[np.float32]
    """(3, F): metal, gloss, glow."""
    heat: NDArray[np.float32]
    """(2, F): excess over the air, K, and emissivity."""
    body_of_face: NDArray[np.int32]
    """(F,): body of the face; each body has one temperature."""
    curve_of_face: NDArray[np.int32]
    """(F,): row of `curves`, or -1 for flat faces."""
    curves: NDArray[np.float32]
    """(K, 3, 4): the unnormalised normal of a curved surface is linear in the point."""
    texels: NDArray[np.uint32]
    """All textures, flat, four bytes each."""
    focus_m: float
    """Distance ahead of the objects at which the camera aims."""
    lights: FloatArray
    """(L, 3), m."""


@dataclass(frozen=True)
class Placement:
    """Position and yaw of an object: its x axis points away from its front, y left, z up from its underside."""

    x: float
    y: float
    z: float
    yaw_rad: float = 0.0

    @staticmethod
    def at(point: ArrayLike, yaw_rad: float) -> Placement:
        """Return the placement at a point (3,), scanner frame, m."""
        x, y, z = np.asarray(point, dtype=np.float64)
        return Placement(float(x), float(y), float(z), yaw_rad)

    def points(self, local: ArrayLike) -> NDArray[np.float64]:
        """Return local points (..., 3) in the scanner frame."""
        return np.asarray(self.vectors(local) + np.array([self.x, self.y, self.z]), dtype=np.float64)

    def vectors(self, local: ArrayLike) -> NDArray[np.float64]:
        """Return local vectors (..., 3) in the scanner frame."""
        p = np.asarray(local, dtype=np.float64)
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        out = p.copy()
        out[..., 0] = c * p[..., 0] - s * p[..., 1]
        out[..., 1] = s * p[..., 0] + c * p[..., 1]
        return out

    def on(self, x: float, y: float, z: float, yaw_rad: float = 0.0) -> Placement:
        """Return the placement of an object at a local point, rotated by `yaw_rad` relative to this one."""
        return Placement.at(self.points([x, y, z]), self.yaw_rad + yaw_rad)


class WorldBuilder:
    """Collects textured faces; each texture is stretched over its face."""

    def __init__(self) -> None:
        self._textures: list[Texture] = []
        self._texture_id: dict[int, int] = {}
        self._corners: list[NDArray[np.float64]] = []  # (F, 4, 3): top left, top right, bottom left, bottom right
        self._texels: list[NDArray[np.float64]] = []  # (F, 4, 2)
        self._face_textures: list[NDArray[np.int64]] = []
        self._face_curves: list[NDArray[np.int64]] = []
        self._curves: list[NDArray[np.float64]] = []
        self._bodies: list[int] = []
        self._body = 0

    def quad(self, top_left: ArrayLike, right: ArrayLike, down: ArrayLike, texture: Texture) -> None:
        """Add a parallelogram by its corner and its sides to the right and down; all (3,), scanner frame, m."""
        self._body += 1
        self._sheet(top_left, right, down, texture)

    def _sheet(self, top_left: ArrayLike, right: ArrayLike, down: ArrayLike, texture: Texture) -> None:
        origin, u, v = (np.asarray(a, dtype=np.float64) for a in (top_left, right, down))
        h, w = texture.picture.shape[:2]
        corners = np.stack([origin, origin + u, origin + v, origin + u + v])
        self._add(corners[None], np.array([[[0, 0], [w, 0], [0, h], [w, h]]], dtype=np.float64), texture, None)

    def box(self, at: Placement, size: Sequence[float], texture: Texture, **sides: Texture) -> None:
        """Add a box of (depth, width, height) whose underside is centred at `at`.

        Args:
            at: its placement.
            size: depth, width, height, m.
            texture: texture of the sides not named in `sides`.
            sides: textures by name: front, back, left, right, top, bottom.
        """
        a, b, c = size[0] / 2, size[1] / 2, float(size[2])
        faces = {
            "front": ((-a, b, c), (0, -2 * b, 0), (0, 0, -c)),
            "back": ((a, -b, c), (0, 2 * b, 0), (0, 0, -c)),
            "left": ((a, b, c), (-2 * a, 0, 0), (0, 0, -c)),
            "right": ((-a, -b, c), (2 * a, 0, 0), (0, 0, -c)),
            "top": ((a, b, c), (0, -2 * b, 0), (-2 * a, 0, 0)),
            "bottom": ((-a, b, 0), (0, -2 * b, 0), (2 * a, 0, 0)),
        }
        self._body += 1
        for name, (origin, u, v) in faces.items():
            self._sheet(at.points(origin), at.vectors(u), at.vectors(v), sides.get(name, texture))

    def lathe(
        self,
        base: ArrayLike,
        tip: ArrayLike,
        profile: Sequence[tuple[float, float]],
        texture: Texture,
        *,
        squash: float = 1.0,
        sectors: int = 28,
        front: ArrayLike = (-1.0, 0.0, 0.0),
    ) -> None:
        """Add a surface of revolution (cylinder, ball, limb, vase); the middle of its texture faces `front`.

        Args:
            base: (3,), one end of the axis, scanner frame, m.
            tip: (3,), the other end; the texture's top is there.
            profile: (height, radius) pairs, m, from the base's end upward.
            texture: wrapped around once.
            squash: depth over width; values below 1 flatten it along `front`.
            sectors: number of facets around the axis.
            front: (3,), a direction not parallel to the axis.
        """
        self._body += 1
        axis = np.asarray(tip, dtype=np.float64) - np.asarray(base, dtype=np.float64)
        axis /= np.linalg.norm(axis)
        ahead = np.asarray(front, dtype=np.float64)
        ahead = ahead - axis * (ahead @ axis)
        ahead /= np.linalg.norm(ahead)
        side = np.cross(axis, ahead)
        frame = np.stack([ahead, side, axis])  # local from world, rows
        z, r = np.asarray(profile, dtype=np.float64).T
        # `side` is right, seen from the front with the tip up, so the texture runs with the angle.
        turn = np.linspace(-np.pi, np.pi, sectors + 1)
        ring = np.stack([np.cos(turn) * squash, np.sin(turn)], axis=-1)
        local = np.empty((len(z), sectors + 1, 3))
        local[..., :2] = r[:, None, None] * ring
        local[..., 2] = z[:, None]
        world = np.einsum("...i,ij->...j", local, frame) + np.asarray(base, dtype=np.float64)
        h, w = texture.picture.shape[:2]
        along = np.concatenate([[0], np.cumsum(np.hypot(np.diff(z), np.diff(r)))])
        grid = np.empty((len(z), sectors + 1, 2))
        grid[..., 0] = np.linspace(0, w, sectors + 1)
        grid[..., 1] = (h * (1 - along / along[-1]))[:, None]
        slope = np.arctan2(-np.diff(r), np.diff(z))  # of each ring's normal above the horizontal
        edge = np.concatenate([slope[:1], (slope[1:] + slope[:-1]) / 2, slope[-1:]])
        sharp = np.abs(np.diff(slope)) > 0.8
        for k in range(len(z) - 1):
            low = slope[k] if k and sharp[k - 1] else edge[k]
            high = slope[k] if k + 1 < len(z) - 1 and sharp[k] else edge[k + 1]
            quads = [a[k + 1, :-1] for a in (world, grid)], [a[k + 1, 1:] for a in (world, grid)]
            lower = [a[k, :-1] for a in (world, grid)], [a[k, 1:] for a in (world, grid)]
            corners, texels = (np.stack([quads[0][i], quads[1][i], lower[0][i], lower[1][i]], axis=1) for i in (0, 1))
            self._add(
                corners, texels, texture, _ring_normals(frame, base, squash, z[k : k + 2], r[k : k + 2], low, high)
            )

    def _add(
        self,
        corners: NDArray[np.float64],
        texels: NDArray[np.float64],
        texture: Texture,
        curve: NDArray[np.float64] | None,
    ) -> None:
        key = id(texture)  # the list keeps every texture alive, so ids are not reused
        if key not in self._texture_id:
            self._texture_id[key] = len(self._textures)
            self._textures.append(texture)
        if curve is not None:
            self._curves.append(curve)
        self._corners.append(corners)
        self._texels.append(texels)
        self._face_textures.append(np.full(len(corners), self._texture_id[key]))
        self._bodies += [self._body] * len(corners)
        self._face_curves.append(np.full(len(corners), -1 if curve is None else len(self._curves) - 1))

    def finish(self, *, focus_m: float, lights: ArrayLike) -> World:
        """Return the complete world."""
        corners = np.concatenate(self._corners)
        texels = np.concatenate(self._texels)
        cross = np.cross(corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1])
        size = np.linalg.norm(cross, axis=-1, keepdims=True)
        assert (size > 0).all(), "a face has no area"
        normals = cross / size
        offsets = np.einsum("fi,fi->f", normals, corners.mean(axis=1))
        texel_from_point = _fit_texels(corners, texels, normals)

        sizes = np.array([t.picture.shape[1::-1] for t in self._textures])
        starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))])
        bytes_ = np.concatenate([np.ascontiguousarray(t.picture).reshape(-1) for t in self._textures])
        finish = np.array([[t.metal, t.gloss, t.glow] for t in self._textures], dtype=np.float32)
        heat = np.array([[t.excess_k, t.emissivity] for t in self._textures], dtype=np.float32)
        which = np.concatenate(self._face_textures)

        faces = np.arange(1, len(corners) + 1)
        triangles = np.concatenate([corners[:, [0, 2, 1]], corners[:, [1, 2, 3]]])
        face_of_triangle = np.concatenate([faces, faces])
        areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=-1)
        real = areas > 1e-12  # facets at the poles of surfaces of revolution have one triangle
        return World(
            triangles=triangles[real].astype(np.float32),
            face_of_triangle=face_of_triangle[real].astype(np.int32),
            normals=np.concatenate([[[1.0, 0, 0]], normals]).T.copy(),
            offsets_m=np.concatenate([[1e3], offsets]),
            texel_from_point=np.concatenate([np.zeros((1, 2, 4)), texel_from_point]).transpose(1, 2, 0).copy(),
            texel_start=np.concatenate([[starts[-1]], starts[which]]).astype(np.int64),
            texture_size=np.concatenate([[[1, 1]], sizes[which]]).T.astype(np.int64),
            finish=np.concatenate([np.zeros((1, 3), np.float32), finish[which]]).T.copy(),
            heat=np.concatenate([np.array([[0, 1]], np.float32), heat[which]]).T.copy(),
            body_of_face=np.array([0, *self._bodies], dtype=np.int32),
            curve_of_face=np.concatenate([[-1], *self._face_curves]).astype(np.int32),
            curves=np.array(self._curves, dtype=np.float32).reshape(-1, 3, 4),
            texels=np.concatenate([bytes_.view(np.uint32), np.zeros(1, np.uint32)]),
            focus_m=focus_m,
            lights=np.asarray(lights, dtype=np.float64),
        )


def _ring_normals(
    frame: NDArray[np.float64],
    base: ArrayLike,
    squash: float,
    z: NDArray[np.float64],
    r: NDArray[np.float64],
    low_rad: float,
    high_rad: float,
) -> NDArray[np.float64]:
    """Return the (3, 4) map from a point of a ring to its normal, tilting from `low_rad` to `high_rad` across it."""
    # (x cos / r, y cos / r, sin), the sine linear in z: exact for balls and cylinders, approximate otherwise.
    scale = (np.cos(low_rad) + np.cos(high_rad)) / max(float(r.sum()), 1e-6)
    low, high = np.sin(low_rad), np.sin(high_rad)
    gradient = (high - low) / (z[1] - z[0]) if abs(z[1] - z[0]) > 1e-9 else 0.0
    local = np.array([[scale / squash**2, 0, 0, 0], [0, scale, 0, 0], [0, 0, gradient, low - gradient * z[0]]])
    to_local = np.concatenate([frame, -(frame @ np.asarray(base, dtype=np.float64))[:, None]], axis=1)
    out: NDArray[np.float64] = frame.T @ (local[:, :3] @ to_local)
    out[:, 3] += frame.T @ local[:, 3]
    return out


def _fit_texels(
    corners: NDArray[np.float64], texels: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (F, 2, 4) maps from point to texel: exact on parallelograms, least squares on facets of balls."""
    centre = corners.mean(axis=1)
    d = corners - centre[:, None]
    middle = texels.mean(axis=1)
    e = texels - middle[:, None]
    # The normal is added as a third direction with constant texels, so that the fit is unique.
    spread = np.einsum("fki,fkj->fij", d, d)
    scale = np.trace(spread, axis1=1, axis2=2)[:, None, None]
    spread += normals[:, :, None] * normals[:, None, :] * scale
    gradient = np.linalg.solve(spread, np.einsum("fki,fkj->fij", d, e)).transpose(0, 2, 1)
    constant = middle - np.einsum("fsi,fi->fs", gradient, centre)
    return np.concatenate([gradient, constant[..., None]], axis=2)


@dataclass(frozen=True, eq=False)
class Surface:
    """Surface points hit by N rays from one viewpoint."""

    range_m: NDArray[np.float32]
    """(N,); 0 without a hit."""
    points: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
    """x, y, z (N,) each, m."""
    normals: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
    """x, y, z (N,) each, unit, towards the viewer."""
    cosine: NDArray[np.float32]
    """(N,): cosine of the incidence angle."""
    texel: NDArray[np.uint8]
    """(N, 4): ink."""
    finish: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
    """metal, gloss, glow (N,) each."""


class Viewpoint:
    """A world seen from one point; quantities that depend on face and point only are precomputed."""

    def __init__(self, world: World, origin: ArrayLike) -> None:
        self._world = world
        o = np.asarray(origin, dtype=np.float64)
        self._origin = o.astype(np.float32)
        n, texel = world.normals, world.texel_from_point
        self._normals = n.astype(np.float32)
        self._distance = (world.offsets_m - (n[0] * o[0] + n[1] * o[1] + n[2] * o[2])).astype(np.float32)
        self._gradient = np.ascontiguousarray(texel[:, :3], dtype=np.float32)
        start = texel[:, 0] * o[0] + texel[:, 1] * o[1] + texel[:, 2] * o[2] + texel[:, 3]
        self._start = start.astype(np.float32)

    def meet(self, faces: IntArray, directions: FloatArray) -> Surface:
        """Intersect rays with the planes of the faces that they hit first.

        Args:
            faces: (N,) face of each ray.
            directions: (N, 3) unit rays, float32.
        """
        normals = [np.take(self._normals[i], faces) for i in range(3)]
        gradient = [[np.take(self._gradient[axis, i], faces) for i in range(3)] for axis in (0, 1)]
        first = [np.take(self._start[axis], faces) for axis in (0, 1)]
        distance = np.take(self._distance, faces)
        return _surface(self._world, faces, directions, self._origin, normals, distance, gradient, first)

    def towards_lamp(
        self, faces: IntArray, directions: FloatArray, lamp: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the origins of shadow rays, and which of them have to be cast.

        Args:
            faces: (N,) face of each ray.
            directions: (N, 3) unit rays, float32.
            lamp: (3,), m.

        Returns:
            starts (N, 3), m, just clear of the surface, and (N,) bool: the surface faces the lamp.
        """
        n = np.stack([np.take(self._normals[i], faces) for i in range(3)], axis=-1)
        along = n[:, 0] * directions[:, 0] + n[:, 1] * directions[:, 1] + n[:, 2] * directions[:, 2]
        along = np.where(np.abs(along) < 1e-6, np.float32(-1e-6), along)
        t = np.take(self._distance, faces) / along
        clear = np.where(along > 0, np.float32(-_CLEARANCE_M), np.float32(_CLEARANCE_M))
        starts = self._origin + t[:, None] * directions + n * clear[:, None]
        to_lamp = np.asarray(lamp, dtype=np.float32) - starts
        height = (n[:, 0] * to_lamp[:, 0] + n[:, 1] * to_lamp[:, 1] + n[:, 2] * to_lamp[:, 2]) * clear
        return starts, (height > 0) & (faces > 0)


def meet_from(world: World, origins: FloatArray, faces: IntArray, directions: FloatArray) -> Surface:
    """Intersect rays, each from an origin of its own, with the planes of the faces that they hit first.

    Args:
        world: the world.
        origins: (N, 3), m.
        faces: (N,) face of each ray.
        directions: (N, 3) unit rays, float32.
    """
    o = np.asarray(origins, dtype=np.float64).T
    n, texel = world.normals[:, faces], world.texel_from_point[:, :, faces]
    distance = (world.offsets_m[faces] - (n[0] * o[0] + n[1] * o[1] + n[2] * o[2])).astype(np.float32)
    first = texel[:, 0] * o[0] + texel[:, 1] * o[1] + texel[:, 2] * o[2] + texel[:, 3]
    normals, gradient = list(n.astype(np.float32)), [list(axis) for axis in texel[:, :3].astype(np.float32)]
    starts = o.astype(np.float32)
    return _surface(world, faces, directions, starts, normals, distance, gradient, list(first.astype(np.float32)))


def _surface(
    world: World,
    faces: IntArray,
    directions: FloatArray,
    origin: NDArray[np.float32],
    normals: Sequence[NDArray[np.float32]],
    distance: NDArray[np.float32],
    gradient: Sequence[Sequence[NDArray[np.float32]]],
    first: Sequence[NDArray[np.float32]],
) -> Surface:
    """Return where rays meet planes: of each ray the face's normal, its distance from the origin along it, the texel's
    gradient and the texel at the origin, which is (3,) or (3, N)."""
    dx, dy, dz = (np.ascontiguousarray(directions[:, i]) for i in range(3))
    nx, ny, nz = normals
    along = nx * dx + ny * dy + nz * dz
    along = np.where(np.abs(along) < 1e-6, np.float32(-1e-6), along)
    t = np.asarray(distance / along, dtype=np.float32)
    texel = [t * sum(gradient[axis][i] * d for i, d in enumerate((dx, dy, dz))) + first[axis] for axis in (0, 1)]
    size = world.texture_size
    s, row = (
        np.clip(texel[i], 0, np.take(size[i], faces).astype(np.float32) - np.float32(1)).astype(np.int64)
        for i in (0, 1)
    )
    index = np.take(world.texel_start, faces) + row * np.take(size[0], faces) + s
    ink = np.take(world.texels, index).view(np.uint8).reshape(-1, 4)
    px, py, pz = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
    flip = np.where(along > 0, np.float32(-1), np.float32(1))
    nx, ny, nz = nx * flip, ny * flip, nz * flip
    cosine = np.abs(along)
    curve = np.take(world.curve_of_face, faces)
    bent = np.flatnonzero(curve >= 0)
    if len(bent):
        C = world.curves[curve[bent]]
        p = [a[bent] for a in (px, py, pz)]
        smooth = [C[:, i, 0] * p[0] + C[:, i, 1] * p[1] + C[:, i, 2] * p[2] + C[:, i, 3] for i in range(3)]
        length = np.sqrt(smooth[0] ** 2 + smooth[1] ** 2 + smooth[2] ** 2) + np.float32(1e-12)
        smooth = [a / length for a in smooth]
        towards = -(smooth[0] * dx[bent] + smooth[1] * dy[bent] + smooth[2] * dz[bent])
        cosine[bent] = np.maximum(towards, np.float32(0.02))
        for a, b in zip((nx, ny, nz), smooth, strict=True):
            a[bent] = b
    t[faces == 0] = 0
    metal, gloss, glow = (np.take(world.finish[i], faces) for i in range(3))
    return Surface(t, (px, py, pz), (nx, ny, nz), cosine, ink, (metal, gloss, glow))
