"""Laparoscopic instruments of several kinds: shaft, wrist and two jaws, and how they move over the tissue.

In an instrument's own frame the tip is at the origin and the shaft along +z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.phantom.camera import working_place_mm
from lab.phantom.fields import smoothstep
from lab.phantom.mesh import grid_normals, grid_triangles
from lab.phantom.motion import CUT_SLANT, GRIP_MM, Cut, Pull
from lab.phantom.settings import PhantomSettings, Tool
from lab.phantom.surface import Surface, room_mm

Vertices = NDArray[np.float64]

SIDES = 32  # of a round part
JAW_MM, WRIST_MM, SHAFT_MM = 11.0, 22.0, 150.0  # from the tip, where each part ends
JAW_HALF_MM = (1.7, 0.9)  # half width and half thickness at the jaw's root
WRIST_RADIUS_MM, SHAFT_RADIUS_MM = 2.7, 4.0
PORTS_MM = np.array([[70.0, 62.0, 6.0], [-66.0, 58.0, 4.0], [-24.0, -74.0, 10.0]])
"""The instruments' ports in the abdominal wall, mm: below right, below left and above frame 0's camera."""
HOVER_MM = 3.0  # height of the tip above tissue that it does not grip
RETREAT_MM = 16.0  # distance from the tissue after the release
LEAVE_MM = 60.0  # how far all instruments but the first draw back, which takes them out of view
TURN_RAD = 2.1  # phase on its orbit by which each instrument is ahead of the one before
JAW_OPEN_RAD = 0.30
STEEL = np.array([0.42, 0.43, 0.44])
SHAFT_GREY = np.array([0.075, 0.078, 0.082])
BRASS = np.array([0.40, 0.33, 0.20])
YELLOW = np.array([0.85, 0.55, 0.05])
BLACK = np.array([0.020, 0.020, 0.022])


@dataclass(frozen=True)
class InstrumentLook:
    """Albedo [3], linear, of an instrument's parts, and how strongly jaws, wrist and shaft mirror the lamp.

    collar  the shaft's end beside the wrist
    ring    about the wrist
    """

    jaws: Vertices
    wrist: Vertices
    ring: Vertices
    collar: Vertices
    shaft: Vertices
    glints: tuple[float, float, float]


LOOKS: dict[Tool, InstrumentLook] = {
    "grasper": InstrumentLook(STEEL, STEEL, BRASS, 0.7 * STEEL, SHAFT_GREY, (0.9, 0.8, 0.12)),
    "steel": InstrumentLook(STEEL, STEEL, 0.8 * STEEL, STEEL, 0.75 * STEEL, (0.9, 0.8, 0.6)),
    "yellow": InstrumentLook(0.8 * STEEL, YELLOW, BLACK, YELLOW, BLACK, (0.9, 0.7, 0.35)),
    "dark": InstrumentLook(3 * BLACK, 2 * BLACK, BLACK, 2 * BLACK, BLACK, (0.5, 0.5, 0.4)),
}


@dataclass(frozen=True)
class InstrumentMesh:
    """vertices_mm [V, 3] world, normals [V, 3], albedo [V, 3] linear, glint [V], triangles [F, 3]."""

    vertices_mm: Vertices
    normals: NDArray[np.float32]
    albedo: NDArray[np.float32]
    glint: NDArray[np.float32]
    triangles: NDArray[np.int32]


def instruments_at(surface: Surface, frame: float, settings: PhantomSettings) -> list[InstrumentMesh]:
    """The instruments at a frame. The first is on or above the tissue, depending on the motion; the others hover."""
    meshes = []
    for place, tool in enumerate(settings.tools):
        tip, opening = (
            _tip_and_opening(surface, frame, settings) if place == 0 else _visit(surface, frame, settings, place)
        )
        meshes.append(_placed(LOOKS[tool], tip, opening, PORTS_MM[place]))
    return meshes


def _placed(
    look: InstrumentLook, tip: NDArray[np.float64], opening: float, port: NDArray[np.float64]
) -> InstrumentMesh:
    """An instrument that goes from its port to its tip [3], world."""
    parts = [*_jaws(opening, look), _wrist(look), _shaft(look)]
    rotation = _rotation_along(port - tip)
    vertices, normals, albedo, glint, triangles = [], [], [], [], []
    first = 0
    for grid, colour, shine in parts:
        placed = grid @ rotation.T + tip
        vertices.append(placed.reshape(-1, 3))
        normals.append(_outward(grid_normals(placed), placed).reshape(-1, 3))
        albedo.append(colour.reshape(-1, 3))
        glint.append(np.full(grid.shape[0] * grid.shape[1], shine))
        triangles.append(grid_triangles(grid.shape[0], grid.shape[1], first))
        first += grid.shape[0] * grid.shape[1]
    return InstrumentMesh(
        np.concatenate(vertices),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(albedo).astype(np.float32),
        np.concatenate(glint).astype(np.float32),
        np.concatenate(triangles),
    )


def _tip_and_opening(surface: Surface, frame: float, settings: PhantomSettings) -> tuple[NDArray[np.float64], float]:
    """World position of the first instrument's tip, and its jaws' opening angle in rad."""
    motion, period_frames = surface.motion, settings.period_frames
    if isinstance(motion, Pull):
        tip = surface.point_mm(*GRIP_MM, frame)
        p = (frame / period_frames) % 1.0
        away = float(smoothstep(np.array(p), 0.70, 0.80) * (1 - smoothstep(np.array(p), 0.90, 1.0)))
        direction = (PORTS_MM[0] - tip) / np.linalg.norm(PORTS_MM[0] - tip)
        return tip + RETREAT_MM * away * direction, 0.06 + JAW_OPEN_RAD * away
    if isinstance(motion, Cut):
        v = motion.blade_mm(frame) + 1.5
        snip = 0.5 + 0.5 * np.sin(2 * np.pi * frame / 7)
        return surface.point_mm(CUT_SLANT * v + 0.4, v, frame) - (0.0, 0.0, 0.3), 0.05 + JAW_OPEN_RAD * snip
    return _hover(surface, frame, settings, 2 * np.pi * frame / period_frames)


def _hover(
    surface: Surface, frame: float, settings: PhantomSettings, angle: float
) -> tuple[NDArray[np.float64], float]:
    """Tip and opening of an instrument that goes round above the tissue that is worked at."""
    place_u, place_v = working_place_mm(frame, settings)
    reach_u, reach_v = (0.42 * half for half in room_mm(settings))
    u = 0.1 * reach_u + 0.55 * reach_u * np.sin(angle / 1.7 + 0.6)
    v = 0.25 * reach_v + 0.45 * reach_v * np.sin(angle / 1.13 + 0.2)
    hover = HOVER_MM + 1.5 * np.sin(angle / 0.8)
    opening = 0.08 + JAW_OPEN_RAD * (0.5 + 0.5 * np.sin(angle / 0.6))
    return surface.point_mm(place_u + u, place_v + v, frame) - (0.0, 0.0, hover), float(opening)


def _visit(surface: Surface, frame: float, settings: PhantomSettings, place: int) -> tuple[NDArray[np.float64], float]:
    """The same of an instrument that comes into view along its shaft and leaves it again."""
    angle = 2 * np.pi * frame / settings.period_frames + TURN_RAD * place
    tip, opening = _hover(surface, frame, settings, angle)
    away_mm = LEAVE_MM * (0.5 - 0.5 * np.cos(angle / 1.3))
    return tip + away_mm * (PORTS_MM[place] - tip) / np.linalg.norm(PORTS_MM[place] - tip), opening


def _jaws(opening_rad: float, look: InstrumentLook) -> list[tuple[Vertices, Vertices, float]]:
    """Two tapered jaws that turn about their root."""
    jaws = []
    along = np.linspace(0, 1, 48)
    for side in (-1.0, 1.0):
        taper = 0.45 + 0.55 * along
        rounded = np.sqrt(np.clip(1 - (1 - np.minimum(along / 0.12, 1)) ** 2, 0, 1))
        grid = _lathe(along * JAW_MM, JAW_HALF_MM[0] * taper * rounded, JAW_HALF_MM[1] * taper * rounded)
        grid[..., 1] += side * 0.75 * JAW_HALF_MM[1]
        turn = side * opening_rad / 2
        y, z = grid[..., 1].copy(), grid[..., 2] - JAW_MM
        grid[..., 1] = np.cos(turn) * y - np.sin(turn) * z
        grid[..., 2] = np.sin(turn) * y + np.cos(turn) * z + JAW_MM
        teeth = np.where((np.sin(along * JAW_MM * 2 * np.pi / 0.9) > 0.4) & (along < 0.85), 0.65, 1.0)
        jaws.append((grid, _rings(look.jaws, teeth), look.glints[0]))
    return jaws


def _wrist(look: InstrumentLook) -> tuple[Vertices, Vertices, float]:
    z = np.linspace(JAW_MM - 1.5, WRIST_MM, 90)
    along = (z - z[0]) / np.ptp(z)
    clevis = np.where(along < 0.45, 0.72 + 0.2 * np.sin(along / 0.45 * np.pi), 1.0)
    groove = 1 - 0.08 * (np.sin(along * 34) > 0.75)
    radius = WRIST_RADIUS_MM * clevis * groove * np.minimum(1, 0.4 + along * 14)
    shade = np.where(np.sin(along * 34) > 0.75, 0.35, 1.0)
    colour = _rings(look.wrist, shade)
    colour[np.abs(along - 0.62) < 0.07] = look.ring
    return _lathe(z, radius, radius * np.where(along < 0.45, 0.75, 1.0)), colour, look.glints[1]


def _shaft(look: InstrumentLook) -> tuple[Vertices, Vertices, float]:
    z = np.concatenate([[WRIST_MM - 0.8], np.linspace(WRIST_MM, SHAFT_MM, 120)])
    radius = np.full(z.size, SHAFT_RADIUS_MM)
    radius[0] = WRIST_RADIUS_MM
    brushed = 1 + 0.10 * np.sin(np.arange(z.size) * 2.4) * np.sin(np.arange(z.size) * 0.9)
    colour = _rings(look.shaft, brushed)
    colour[z < WRIST_MM + 4] = look.collar
    return _lathe(z, radius, radius), colour, look.glints[2]


def _lathe(z: NDArray[np.float64], half_x: NDArray[np.float64], half_y: NDArray[np.float64]) -> Vertices:
    """A tube about the z axis [len(z), SIDES + 1, 3] with elliptic sections."""
    angle = np.linspace(0, 2 * np.pi, SIDES + 1)
    x, y = half_x[:, None] * np.cos(angle), half_y[:, None] * np.sin(angle)
    return np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1)


def _rings(colour: NDArray[np.float64], shade: NDArray[np.float64]) -> Vertices:
    """One shade of a colour for each ring of a tube: [rings, SIDES + 1, 3]."""
    return np.repeat((shade[:, None] * colour)[:, None], SIDES + 1, axis=1)


def _outward(normals: Vertices, tube: Vertices) -> Vertices:
    """Normals [rings, SIDES + 1, 3] turned away from the tube's axis; the seam's two ends agree."""
    normals = normals.copy()
    seam = normals[:, 0] + normals[:, -1]
    seam /= np.linalg.norm(seam, axis=-1, keepdims=True) + 1e-9
    normals[:, 0] = normals[:, -1] = seam
    from_axis = tube - tube.mean(axis=1, keepdims=True)
    inward = np.einsum("rsc,rsc->rs", normals, from_axis) < 0
    normals[inward] *= -1
    return normals


def _rotation_along(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """World from instrument [3, 3]: z along direction, y as far down as that allows."""
    z = direction / np.linalg.norm(direction)
    x = np.cross((0.0, 1.0, 0.3), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
