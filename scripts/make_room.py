#!/usr/bin/env python3
"""Writes the shipped room: scenes/room/{room.obj, room.mtl, textures/*.png, classes.yaml}.

A living, dining and working room of 5 x 4 x 2.7 m. Axes: x east, y north, z up, metres, origin in the south-west
corner on the floor. Object names are <class>_<number>. Plain Python, no input, the same bytes on every run.
"""
import math
import os
import sys

sys.dont_write_bytecode = True  # leaves no cache folder beside the scripts
from room_geometry import Room  # noqa: E402
from room_png import write_png  # noqa: E402
from room_textures import TEXTURES  # noqa: E402

if len(sys.argv) > 2 or sys.argv[1:] and sys.argv[1].startswith("-"):
    print(__doc__.strip() + "\n\nusage: make_room.py [FOLDER]   (default: scenes/room)")
    sys.exit(0 if sys.argv[1] in ("-h", "--help") else 2)
OUT = sys.argv[1] if len(sys.argv) > 1 else os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "scenes", "room")

CLASSES = [  # id, name, colour
    (0, "void", (0, 0, 0)), (1, "wall", (196, 200, 208)), (2, "floor", (176, 128, 84)), (3, "ceiling", (236, 232, 220)),
    (4, "door", (150, 92, 60)), (5, "window", (120, 196, 236)), (6, "curtain", (232, 170, 120)), (7, "rug", (206, 84, 92)),
    (8, "sofa", (58, 112, 158)), (9, "cushion", (244, 196, 66)), (10, "table", (134, 86, 164)), (11, "desk", (96, 158, 120)),
    (12, "chair", (228, 108, 56)), (13, "bookshelf", (110, 74, 58)), (14, "book", (64, 176, 170)), (15, "cabinet", (166, 152, 92)),
    (16, "lamp", (252, 238, 128)), (17, "plant", (66, 148, 60)), (18, "picture", (214, 110, 178)), (19, "monitor", (52, 60, 92)),
    (20, "keyboard", (132, 136, 144)), (21, "vase", (96, 96, 220)), (22, "bin", (120, 120, 60)), (23, "clock", (240, 72, 160)),
    (24, "mug", (40, 210, 120)),
]

# name: (Kd, texture or None, Ke)
MATERIALS = {
    "plaster": ((0.80, 0.77, 0.71), "plaster", None), "wallpaper": ((0.45, 0.55, 0.52), "wallpaper", None),
    "ceiling_paint": ((0.88, 0.87, 0.84), "ceiling", None), "skirting": ((0.86, 0.85, 0.82), None, None),
    "planks": ((0.5, 0.33, 0.2), "planks", None), "oak": ((0.62, 0.45, 0.28), "oak", None),
    "walnut": ((0.3, 0.18, 0.1), "walnut", None), "door_wood": ((0.5, 0.34, 0.22), "door", None),
    "rug": ((0.5, 0.2, 0.2), "rug", None), "sofa_fabric": ((0.16, 0.3, 0.36), "sofa", None),
    "curtain_fabric": ((0.75, 0.62, 0.45), "curtain", None), "cushion_zigzag": ((0.8, 0.6, 0.2), "zigzag", None),
    "cushion_dots": ((0.7, 0.3, 0.25), "dots", None), "seat_fabric": ((0.72, 0.36, 0.2), "seat", None),
    "spines": ((0.5, 0.4, 0.3), "spines", None), "paper": ((0.86, 0.83, 0.74), None, None),
    "black_metal": ((0.035, 0.035, 0.04), None, None), "steel": ((0.55, 0.56, 0.58), None, None),
    "brass": ((0.62, 0.45, 0.17), None, None), "white_lacquer": ((0.82, 0.82, 0.8), None, None),
    "terracotta": ((0.58, 0.26, 0.15), "terracotta", None), "soil": ((0.07, 0.045, 0.03), None, None),
    "leaf": ((0.12, 0.35, 0.1), "leaf", None), "stem": ((0.2, 0.28, 0.1), None, None),
    "landscape": ((0.5, 0.5, 0.5), "landscape", None), "shapes": ((0.5, 0.5, 0.5), "shapes", None),
    "poster": ((0.5, 0.5, 0.5), "poster", None), "outside": ((0.2, 0.2, 0.2), "outside", (1.7, 1.7, 1.7)),
    "screen": ((0.1, 0.1, 0.1), "screen", (0.8, 0.8, 0.8)), "keys": ((0.3, 0.3, 0.3), "keys", None),
    "clock_face": ((0.9, 0.9, 0.86), "clock", None), "shade": ((0.86, 0.72, 0.5), "shade", (0.5, 0.42, 0.3)),
    "pendant": ((0.75, 0.3, 0.14), None, None), "bulb": ((0.9, 0.9, 0.85), None, (1.6, 1.4, 1.0)),
    "glaze": ((0.1, 0.22, 0.5), "glaze", None), "wicker": ((0.5, 0.37, 0.2), "wicker", None),
    "mug_red": ((0.66, 0.1, 0.08), None, None), "mug_cream": ((0.8, 0.73, 0.55), None, None),
    "dark_fabric": ((0.06, 0.065, 0.075), "dark", None),
}


def shell(r):
    X, Y, Z = 5.0, 4.0, 2.7
    r.object("floor_1")
    r.quad("planks", (0, 0, 0), (X, 0, 0), (X, Y, 0), (0, Y, 0), ((0, 0), (X / 2, 0), (X / 2, Y / 2), (0, Y / 2)))
    r.object("ceiling_1")
    r.quad("ceiling_paint", (0, Y, Z), (X, Y, Z), (X, 0, Z), (0, 0, Z), ((0, 0), (X / 2, 0), (X / 2, Y / 2), (0, Y / 2)))
    r.object("wall_1")  # west, papered
    r.quad("wallpaper", (0, Y, 0), (0, 0, 0), (0, 0, Z), (0, Y, Z), ((0, 0), (Y, 0), (Y, Z), (0, Z)))
    r.box("skirting", (0, 0, 0), (0.015, Y, 0.09))
    r.object("wall_2")  # south
    r.quad("plaster", (0, 0, 0), (X, 0, 0), (X, 0, Z), (0, 0, Z), ((0, 0), (X / 2, 0), (X / 2, Z / 2), (0, Z / 2)))
    r.box("skirting", (0, 0, 0), (3.93, 0.015, 0.09))
    r.object("wall_3")  # east
    r.quad("plaster", (X, 0, 0), (X, Y, 0), (X, Y, Z), (X, 0, Z), ((0, 0), (Y / 2, 0), (Y / 2, Z / 2), (0, Z / 2)))
    r.box("skirting", (X - 0.015, 0, 0), (X, Y, 0.09))
    r.object("wall_4")  # north, with the window's opening
    a, b, lo, hi, deep = 1.5, 3.5, 0.95, 2.25, 0.16
    for x0, x1, z0, z1 in ((0, a, 0, Z), (b, X, 0, Z), (a, b, 0, lo), (a, b, hi, Z)):
        r.quad("plaster", (x1, Y, z0), (x0, Y, z0), (x0, Y, z1), (x1, Y, z1),
               ((x1 / 2, z0 / 2), (x0 / 2, z0 / 2), (x0 / 2, z1 / 2), (x1 / 2, z1 / 2)))
    r.quad("skirting", (a, Y, lo), (b, Y, lo), (b, Y + deep, lo), (a, Y + deep, lo))
    r.quad("skirting", (a, Y + deep, hi), (b, Y + deep, hi), (b, Y, hi), (a, Y, hi))
    r.quad("skirting", (a, Y + deep, lo), (a, Y + deep, hi), (a, Y, hi), (a, Y, lo))
    r.quad("skirting", (b, Y, lo), (b, Y, hi), (b, Y + deep, hi), (b, Y + deep, lo))
    r.box("skirting", (0, Y - 0.015, 0), (X, Y, 0.09))
    r.object("window_1")
    y = Y + 0.11
    r.quad("outside", (b, y + 0.03, lo), (a, y + 0.03, lo), (a, y + 0.03, hi), (b, y + 0.03, hi), ((1, 0), (0, 0), (0, 1), (1, 1)))
    for x0, x1, z0, z1 in ((a, b, lo, lo + 0.06), (a, b, hi - 0.06, hi), (a, a + 0.06, lo, hi), (b - 0.06, b, lo, hi),
                           (2.47, 2.53, lo, hi), (a, b, 1.82, 1.86)):
        r.box("white_lacquer", (x0, y - 0.04, z0), (x1, y + 0.02, z1))
    r.box("white_lacquer", (a - 0.05, Y - 0.06, lo - 0.04), (b + 0.05, Y + deep, lo))  # sill
    r.object("door_1")
    r.quad("door_wood", (4.02, 0.035, 0), (4.82, 0.035, 0), (4.82, 0.035, 2.02), (4.02, 0.035, 2.02))
    for x0, x1, z1 in ((3.93, 4.02, 2.11), (4.82, 4.91, 2.11)):
        r.box("white_lacquer", (x0, 0, 0), (x1, 0.05, z1))
    r.box("white_lacquer", (4.02, 0, 2.02), (4.82, 0.05, 2.11))
    r.rod("brass", (4.12, 0.03, 1.03), (4.12, 0.09, 1.03), 0.012)
    r.rod("brass", (4.11, 0.085, 1.03), (4.24, 0.085, 1.03), 0.01)
    for i, (x0, x1) in enumerate(((1.12, 1.62), (3.38, 3.88))):
        r.object("curtain_%d" % (i + 1))
        n = 36
        points, uvs, normals, faces = [], [], [], []
        for k in range(n + 1):
            x = x0 + (x1 - x0) * k / n
            phase = 2 * math.pi * 5 * k / n
            slope = -0.035 * 2 * math.pi * 5 / (x1 - x0) * math.sin(phase)
            size = math.hypot(slope, 1)
            for z in (0.06, 2.42):
                points.append((x, 3.90 + 0.035 * math.cos(phase), z))
                uvs.append((k / n * 1.5, z))
                normals.append((slope / size, -1 / size, 0))
        for k in range(n):
            faces.append((2 * k, 2 * k + 2, 2 * k + 3, 2 * k + 1))
        r.mesh("curtain_fabric", points, uvs, faces, normals)
        if i == 0:
            r.rod("black_metal", (0.98, 3.9, 2.44), (4.02, 3.9, 2.44), 0.012)


def living(r):
    r.object("rug_1")
    r.box("rug", (1.0, 0.95, 0), (2.75, 3.0, 0.004), skip="tb")
    r.quad("rug", (1.0, 0.95, 0.012), (2.75, 0.95, 0.012), (2.75, 3.0, 0.012), (1.0, 3.0, 0.012))
    r.object("sofa_1")
    r.place(0.05, 0.95)
    r.box("sofa_fabric", (0.0, 0.0, 0.10), (0.85, 2.0, 0.26), 2)
    r.pillow("sofa_fabric", (0.12, 1.0, 0.52), (0.24, 2.0, 0.56), 0.2, 0.35, repeat=1.0)
    for y in (0.09, 1.91):
        r.pillow("sofa_fabric", (0.43, y, 0.40), (0.86, 0.18, 0.44), 0.2, 0.4, repeat=2.0)
    for y in (0.59, 1.41):
        r.pillow("sofa_fabric", (0.53, y, 0.33), (0.66, 0.81, 0.20), 0.22, 0.45, repeat=1.6)
    for x in (0.06, 0.79):
        for y in (0.06, 1.94):
            r.rod("walnut", (x, y, 0), (x, y, 0.11), 0.022)
    for i, (y, m, tilt) in enumerate(((0.38, "cushion_zigzag", 66), (0.74, "cushion_dots", 60), (1.66, "cushion_zigzag", 63))):
        r.object("cushion_%d" % (i + 1))
        r.pillow(m, (0.36, y, 0.60), (0.40, 0.40, 0.15), 0.5, 0.9, 12, 24, tilt, repeat=1.5)
    r.place()
    r.object("table_1")  # coffee table
    r.place(1.85, 1.95)
    r.box("walnut", (-0.30, -0.55, 0.37), (0.30, 0.55, 0.41), 1.2)
    r.box("walnut", (-0.26, -0.50, 0.13), (0.26, 0.50, 0.15), 1.2)
    for x in (-0.26, 0.26):
        for y in (-0.50, 0.50):
            r.box("black_metal", (x - 0.015, y - 0.015, 0), (x + 0.015, y + 0.015, 0.37))
    for i, (dx, dy, z, m, turn) in enumerate(((-0.05, 0.20, 0.41, 3, 12), (-0.04, 0.21, 0.44, 9, -9))):
        r.object("book_%d" % (i + 1))
        r.place(1.85 + dx, 1.95 + dy, z, turn)
        book(r, (-0.09, -0.13, 0), (0.09, 0.13, 0.03), m, lying=True)
    r.object("mug_1")
    r.place(1.98, 1.72, 0.41)
    mug(r, "mug_red")
    r.object("vase_1")
    r.place(1.76, 1.62, 0.41)
    r.lathe("glaze", [(0, 0), (0.045, 0), (0.07, 0.05), (0.075, 0.10), (0.05, 0.17), (0.026, 0.22), (0.034, 0.25), (0.024, 0.25),
                      (0.018, 0.2)], 20, u_repeat=2, v_scale=4)
    r.object("lamp_1")  # floor lamp
    r.place(0.42, 0.42)
    r.lathe("black_metal", [(0, 0), (0.15, 0), (0.15, 0.02), (0.02, 0.03), (0.0, 0.03)], 24)
    r.rod("black_metal", (0, 0, 0.02), (0, 0, 1.42), 0.0125)
    r.lathe("shade", [(0.21, 1.35), (0.13, 1.65)], 28, u_repeat=6, v_scale=3)
    r.lathe("bulb", [(0, 1.42), (0.035, 1.45), (0.04, 1.49), (0.02, 1.53), (0, 1.54)], 12)
    r.place()
    plant(r, "plant_1", 0.48, 3.45, 0, 1.0, 17)
    for name, m, wall, at, z, w, h in (("picture_1", "landscape", "w", 1.95, 1.62, 1.05, 0.70), ("picture_2", "shapes", "s", 2.15, 1.72, 0.50, 0.50),
                                       ("picture_3", "poster", "s", 2.90, 1.72, 0.42, 0.60), ("picture_4", "shapes", "e", 3.35, 1.40, 0.42, 0.42),
                                       ("picture_5", "poster", "w", 3.15, 1.60, 0.36, 0.50)):
        r.object(name)
        place_on_wall(r, wall, at, z)
        r.box("black_metal", (-w / 2 - 0.025, 0, -h / 2 - 0.025), (w / 2 + 0.025, 0.022, h / 2 + 0.025))
        r.quad("paper", (-w / 2, 0.024, -h / 2), (w / 2, 0.024, -h / 2), (w / 2, 0.024, h / 2), (-w / 2, 0.024, h / 2))
        g = 0.035
        r.quad(m, (-w / 2 + g, 0.026, -h / 2 + g), (w / 2 - g, 0.026, -h / 2 + g), (w / 2 - g, 0.026, h / 2 - g), (-w / 2 + g, 0.026, h / 2 - g),
               ((1, 0), (0, 0), (0, 1), (1, 1)))
    r.object("clock_1")
    place_on_wall(r, "e", 2.62, 1.98)
    n = 32
    ring = [(0.16 * math.cos(2 * math.pi * k / n), 0.16 * math.sin(2 * math.pi * k / n)) for k in range(n)]
    r.mesh("clock_face", [(x, 0.03, z) for x, z in ring], [(0.5 - x / 0.32, 0.5 + z / 0.32) for x, z in ring], [tuple(range(n))[::-1]])
    r.mesh("black_metal", [(x * s, y, z * s) for x, z in ring for s, y in ((1.0, 0.03), (1.1, 0.034), (1.1, 0.0))], [(0, 0)] * (3 * n),
           [f for k in range(n) for f in ((3 * k, 3 * k + 1, 3 * ((k + 1) % n) + 1, 3 * ((k + 1) % n)),
                                          (3 * k + 1, 3 * k + 2, 3 * ((k + 1) % n) + 2, 3 * ((k + 1) % n) + 1))])
    r.place()


def place_on_wall(r, wall, at, z):
    """Local x along the wall, local y into the room."""
    x, y, yaw = {"w": (0.0, at, -90), "e": (5.0, at, 90), "s": (at, 0.0, 0), "n": (at, 4.0, 180)}[wall]
    r.place(x, y, z, yaw)


def mug(r, material):
    r.lathe(material, [(0, 0), (0.036, 0), (0.04, 0.01), (0.04, 0.09), (0.034, 0.09), (0.033, 0.012), (0, 0.012)], 18)
    for k in range(5):
        a, b = math.pi * (k / 5 - 0.5), math.pi * ((k + 1) / 5 - 0.5)
        r.rod(material, (0.036 + 0.028 * math.cos(a), 0, 0.046 + 0.028 * math.sin(a)),
              (0.036 + 0.028 * math.cos(b), 0, 0.046 + 0.028 * math.sin(b)), 0.006, 6)


def book(r, lo, hi, spine, lying=False):
    """Cover from column `spine` of the 16 drawn spines; pages show on top (standing) or at the sides (lying)."""
    u0, u1 = spine / 16 + 0.004, (spine + 1) / 16 - 0.004
    (x0, y0, z0), (x1, y1, z1) = lo, hi
    cover = lambda a, b, c, d: r.quad("spines", a, b, c, d, ((u0, 0.02), (u1, 0.02), (u1, 0.98), (u0, 0.98)))
    if lying:
        cover((x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1))
        cover((x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1))
        e = 0.004
        r.box("paper", (x0 + e, y0 + e, z0), (x1 - e, y1 - e, z1 - e), skip="tb")
    else:  # standing, the spine towards -x
        cover((x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1))
        cover((x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1))
        cover((x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1))
        r.quad("paper", (x0, y0, z1 - 0.004), (x1, y0, z1 - 0.004), (x1, y1, z1 - 0.004), (x0, y1, z1 - 0.004))


def plant(r, name, x, y, z, scale, leaves):
    r.object(name)
    r.place(x, y, z)
    k = scale
    r.lathe("terracotta", [(0, 0), (0.13 * k, 0), (0.17 * k, 0.30 * k), (0.185 * k, 0.30 * k), (0.185 * k, 0.34 * k), (0.16 * k, 0.34 * k),
                           (0.155 * k, 0.30 * k)], 24, u_repeat=3, v_scale=2)
    r.lathe("soil", [(0.158 * k, 0.305 * k), (0, 0.315 * k)], 16)
    for i in range(leaves):
        yaw = i * 2.39996
        rise = (0.35 + 0.65 * ((i * 7) % leaves) / leaves) * k
        reach = (0.26 + 0.16 * ((i * 5) % 7) / 7) * k
        c, s = math.cos(yaw), math.sin(yaw)
        base = (0.03 * c, 0.03 * s, 0.31 * k)
        knee = (0.35 * reach * c, 0.35 * reach * s, 0.31 * k + 0.75 * rise)
        r.rod("stem", base, knee, 0.006 * k, 5)
        size, wide = reach * 1.25, 0.085 * k
        points, uvs, faces = [], [], []
        for j in range(7):
            t = j / 6
            along, height = 0.35 * reach + size * t * 0.8, 0.31 * k + 0.75 * rise + size * (0.55 * t - 0.75 * t * t)
            half = wide * math.sin(math.pi * min(1.0, 0.06 + t * 0.94)) ** 0.7 if j < 6 else 0.001
            for side in (-1, 0, 1):
                points.append((along * c - side * half * s, along * s + side * half * c, height + 0.018 * k * abs(side)))
                uvs.append((0.5 + 0.48 * side, t))
        for j in range(6):
            for q in (0, 1):
                a = 3 * j + q
                faces.append((a, a + 1, a + 4, a + 3))
        r.mesh("leaf", points, uvs, faces)
    r.place()


def chair(r, name, x, y, yaw):
    """Dining chair: seat towards local +y, legs 3 cm thick."""
    r.object(name)
    r.place(x, y, 0, yaw)
    for lx in (-0.185, 0.185):
        r.box("oak", (lx - 0.015, 0.16, 0), (lx + 0.015, 0.19, 0.44), 2)
        r.box("oak", (lx - 0.015, -0.21, 0), (lx + 0.015, -0.18, 0.88), 2)
        r.box("oak", (lx - 0.01, -0.18, 0.2), (lx + 0.01, 0.16, 0.225), 2)
    r.box("oak", (-0.2, -0.2, 0.42), (0.2, 0.2, 0.445), 2)
    r.pillow("seat_fabric", (0, 0.005, 0.458), (0.40, 0.39, 0.05), 0.3, 0.5, 6, 20, repeat=1.0)
    for z in (0.58, 0.70, 0.82):
        r.box("oak", (-0.185, -0.205, z), (0.185, -0.187, z + 0.05), 2)
    r.place()


def dining(r):
    r.object("table_2")
    r.place(3.72, 2.72)
    r.box("oak", (-0.62, -0.42, 0.71), (0.62, 0.42, 0.745), 1.0)
    r.box("oak", (-0.56, -0.36, 0.63), (0.56, 0.36, 0.71), 1.0, "tb")
    for x in (-0.55, 0.55):
        for y in (-0.35, 0.35):
            r.box("oak", (x - 0.025, y - 0.025, 0), (x + 0.025, y + 0.025, 0.71), 2)
    for i, (x, y, yaw) in enumerate(((3.42, 2.12, 4), (4.04, 2.16, -6), (3.40, 3.34, 183), (4.02, 3.31, 176))):
        chair(r, "chair_%d" % (i + 1), x, y, yaw)
    r.object("vase_2")  # fruit bowl
    r.place(3.72, 2.72, 0.745)
    r.lathe("glaze", [(0, 0), (0.06, 0), (0.065, 0.015), (0.13, 0.06), (0.16, 0.10), (0.15, 0.10), (0.12, 0.065), (0.05, 0.025), (0, 0.02)],
            28, u_repeat=3, v_scale=3)
    r.object("mug_2")
    r.place(3.38, 2.56, 0.745, 40)
    mug(r, "mug_cream")
    r.object("lamp_2")  # pendant
    r.place(3.72, 2.72)
    r.rod("black_metal", (0, 0, 1.80), (0, 0, 2.70), 0.006, 8)
    r.lathe("pendant", [(0.22, 1.60), (0.20, 1.68), (0.12, 1.78), (0.03, 1.82), (0, 1.82)], 28)
    r.lathe("bulb", [(0, 1.60), (0.04, 1.63), (0.045, 1.67), (0.02, 1.72), (0, 1.73)], 12)
    r.lathe("black_metal", [(0.05, 2.66), (0.05, 2.70)], 16)
    r.place()


def work(r):
    r.object("desk_1")
    r.place(2.5, 0.36)
    r.box("oak", (-0.65, -0.31, 0.70), (0.65, 0.31, 0.73), 1.0)
    for x in (-0.62, 0.62):
        for y in (-0.28, 0.28):
            r.box("black_metal", (x - 0.015, y - 0.015, 0), (x + 0.015, y + 0.015, 0.70))
        r.box("black_metal", (x - 0.012, -0.28, 0.06), (x + 0.012, 0.28, 0.085))
    r.box("white_lacquer", (0.22, -0.28, 0.56), (0.60, 0.26, 0.70))
    r.rod("brass", (0.36, 0.27, 0.63), (0.46, 0.27, 0.63), 0.008)
    r.object("monitor_1")
    r.box("black_metal", (-0.14, -0.22, 0.73), (0.14, -0.04, 0.742))
    r.rod("steel", (0, -0.15, 0.74), (0, -0.15, 0.95), 0.018)
    r.box("black_metal", (-0.31, -0.14, 0.87), (0.31, -0.11, 1.24))
    r.quad("screen", (0.295, -0.108, 0.888), (-0.295, -0.108, 0.888), (-0.295, -0.108, 1.225), (0.295, -0.108, 1.225))
    r.object("keyboard_1")
    r.box("black_metal", (-0.22, 0.06, 0.73), (0.22, 0.20, 0.745), skip="t")
    r.quad("keys", (0.22, 0.20, 0.748), (-0.22, 0.20, 0.748), (-0.22, 0.06, 0.748), (0.22, 0.06, 0.748), ((0, 0), (1, 0), (1, 1), (0, 1)))
    r.object("lamp_3")  # desk lamp
    r.lathe("brass", [(0, 0.73), (0.07, 0.73), (0.07, 0.745), (0, 0.75)], 20, center=(-0.50, -0.14, 0))
    r.rod("brass", (-0.50, -0.14, 0.74), (-0.56, -0.18, 1.02), 0.008)
    r.rod("brass", (-0.56, -0.18, 1.02), (-0.44, -0.06, 1.18), 0.008)
    r.lathe("pendant", [(0.075, 1.10), (0.045, 1.19), (0, 1.2)], 20, center=(-0.42, -0.03, 0))
    r.object("book_3")
    r.place(2.96, 0.30, 0.73, 20)
    book(r, (-0.1, -0.14, 0), (0.1, 0.14, 0.028), 12, lying=True)
    r.object("chair_5")  # swivel chair
    r.place(2.42, 0.98, 0, 170)
    for k in range(5):
        a = 2 * math.pi * k / 5
        r.rod("black_metal", (0, 0, 0.09), (0.27 * math.cos(a), 0.27 * math.sin(a), 0.055), 0.016, 8)
        r.lathe("black_metal", [(0, 0), (0.025, 0.005), (0.025, 0.045), (0, 0.05)], 10, center=(0.27 * math.cos(a), 0.27 * math.sin(a), 0))
    r.rod("steel", (0, 0, 0.08), (0, 0, 0.44), 0.025)
    r.pillow("dark_fabric", (0, 0, 0.48), (0.48, 0.46, 0.09), 0.35, 0.5, 8, 24, repeat=2)
    r.rod("black_metal", (0, -0.18, 0.46), (0, -0.25, 0.70), 0.015)
    r.pillow("dark_fabric", (0, -0.25, 0.80), (0.44, 0.07, 0.42), 0.35, 0.4, 10, 24, repeat=2)
    r.object("bin_1")
    r.place(1.62, 0.30)
    r.lathe("wicker", [(0, 0.005), (0.11, 0), (0.14, 0.32), (0.13, 0.32), (0.105, 0.02), (0, 0.02)], 22, u_repeat=5, v_scale=5)
    r.object("bookshelf_1")
    r.place(4.69, 0.98)
    for y in (0.0, 0.97):
        r.box("walnut", (0, y, 0), (0.30, y + 0.03, 1.90), 1.0)
    r.box("walnut", (0.285, 0.03, 0.06), (0.30, 0.97, 1.90), 1.0)
    shelves = (0.06, 0.43, 0.80, 1.17, 1.54, 1.87)
    for z in shelves:
        r.box("walnut", (0.0, 0.03, z), (0.285, 0.97, z + 0.03), 1.0)
    number, pick = 4, 0
    for level, z in enumerate(shelves[:5]):
        y = 0.035
        end = (0.93, 0.62, 0.90, 0.55, 0.88)[level]
        while y < end:
            pick = (pick * 29 + 17) % 251
            width, height, deep = 0.026 + 0.004 * (pick % 7), 0.20 + 0.012 * (pick % 10), 0.03 + 0.006 * (pick % 8)
            r.object("book_%d" % number)
            book(r, (deep, y, z + 0.03), (0.25, y + width, z + 0.03 + height), pick % 16)
            number += 1
            y += width + (0.05 if pick % 11 == 0 else 0.002)
    r.object("vase_3")
    r.place(4.82, 0.98 + 0.78, 0.46)
    r.lathe("terracotta", [(0, 0), (0.05, 0), (0.08, 0.09), (0.06, 0.17), (0.03, 0.20), (0.038, 0.23)], 20, u_repeat=2, v_scale=3)
    plant(r, "plant_2", 4.83, 1.72, 1.20, 0.34, 9)
    r.object("cabinet_1")  # sideboard under the window
    r.place(2.5, 3.76)
    r.box("walnut", (-0.80, -0.20, 0.12), (0.80, 0.20, 0.66), 1.0)
    for k in range(3):
        x0, x1 = -0.78 + 0.525 * k, -0.78 + 0.525 * k + 0.51
        r.box("white_lacquer", (x0, -0.215, 0.14), (x1, -0.20, 0.64))
        r.rod("brass", (x1 - 0.06, -0.235, 0.34), (x1 - 0.06, -0.235, 0.46), 0.008, 8)
    for x in (-0.74, 0.74):
        for y in (-0.15, 0.15):
            r.rod("walnut", (x, y, 0), (x, y, 0.12), 0.018)
    r.object("vase_4")
    r.place(2.02, 3.72, 0.66)
    r.lathe("glaze", [(0, 0), (0.06, 0), (0.10, 0.10), (0.105, 0.16), (0.07, 0.26), (0.04, 0.30), (0.055, 0.34), (0.045, 0.34), (0.03, 0.3)],
            24, u_repeat=2, v_scale=3)
    plant(r, "plant_3", 2.92, 3.74, 0.66, 0.42, 11)
    r.place()


def main():
    os.makedirs(os.path.join(OUT, "textures"), exist_ok=True)
    for name, (width, height, paint) in TEXTURES.items():
        rows = []
        for y in range(height):
            row = bytearray()
            for x in range(width):
                row += bytes(max(0, min(255, round(c))) for c in paint(x, y))
            rows.append(bytes(row))
        write_png(os.path.join(OUT, "textures", name + ".png"), width, height, rows)
    room = Room(MATERIALS)
    for part in (shell, living, dining, work):
        part(room)
    with open(os.path.join(OUT, "room.obj"), "w", newline="\n") as file:
        file.write("# x east, y north, z up, metres; object names are <class>_<number>\nmtllib room.mtl\n" + "\n".join(room.lines) + "\n")
    with open(os.path.join(OUT, "room.mtl"), "w", newline="\n") as file:
        for name, (color, texture, glow) in MATERIALS.items():
            file.write("newmtl %s\nKd %.3f %.3f %.3f\n" % ((name,) + color))
            if glow:
                file.write("Ke %.3f %.3f %.3f\n" % glow)
            if texture:
                file.write("map_Kd textures/%s.png\n" % texture)
            file.write("\n")
    with open(os.path.join(OUT, "classes.yaml"), "w", newline="\n") as file:
        for number, name, color in CLASSES:
            file.write("- {id: %d, name: %s, color: [%d, %d, %d]%s}\n" % ((number, name) + color + (", ignore: true" if number == 0 else "",)))
    print("%d triangles, %d objects" % (room.faces, sum(line.startswith("o ") for line in room.lines)))


main()
