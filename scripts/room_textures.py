"""Procedural textures of the shipped room: name -> (width, height, paint(x, y) -> (r, g, b) in 0..255 sRGB), top row first."""
import math


def hashed(*key):
    """Uniform in [0, 1) from integers, the same everywhere."""
    h = 2166136261
    for k in key:
        h = ((h ^ (k & 0xFFFFFFFF)) * 16777619) & 0xFFFFFFFF
        h ^= h >> 15
    h = (h * 2246822519) & 0xFFFFFFFF
    h ^= h >> 13
    h = (h * 3266489917) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777216.0


def noise(x, y, nx, ny, seed):
    """Smooth noise in [0, 1], repeating after nx by ny cells; x, y in cells."""
    ix, iy = math.floor(x), math.floor(y)
    fx, fy = x - ix, y - iy
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    at = lambda i, j: hashed(i % nx, j % ny, seed)
    top = at(ix, iy) + (at(ix + 1, iy) - at(ix, iy)) * fx
    low = at(ix, iy + 1) + (at(ix + 1, iy + 1) - at(ix, iy + 1)) * fx
    return top + (low - top) * fy


def mix(a, b, t):
    t = max(0.0, min(1.0, t))
    return tuple(p + (q - p) * t for p, q in zip(a, b))


def shade(color, factor):
    return tuple(c * factor for c in color)


def wood(dark, light, size, seed, rings=6):
    def paint(x, y):
        u, v = x / size, y / size
        warp = noise(u * 4, v * 4, 4, 4, seed) * 1.3 + noise(u * 2, v * 16, 2, 16, seed + 1) * 0.5
        band = 0.5 + 0.5 * math.sin(2 * math.pi * (v * rings + warp))
        fine = noise(u * 8, v * 64, 8, 64, seed + 2)
        return mix(dark, light, 0.55 * band + 0.45 * fine)
    return size, size, paint


def planks():
    """2 m x 2 m: 12.5 cm wide planks of 1 m, shifted row by row."""
    size, rows = 512, 16
    tones = ((148, 104, 66), (172, 126, 82), (132, 90, 56), (186, 144, 98), (160, 112, 68))

    def paint(x, y):
        high = size // rows
        row = y // high
        shift = int(hashed(row, 5) * 256)
        board = ((x + shift) // 256) % 2
        inside = (x + shift) % 256
        if y % high == 0 or inside == 0:
            return (64, 42, 27)
        tone = tones[int(hashed(row, board, 9) * len(tones))]
        long = noise(x / 64, y / 3.2, 8, 160, 31 + row)
        knot = noise(x / 32, y / 8, 16, 64, 77)
        grain = 0.80 + 0.26 * long + (0.12 if knot > 0.82 else 0.0) * -1
        return shade(tone, grain)
    return size, size, paint


def plaster(base, depth, seed):
    size = 256

    def paint(x, y):
        n = 0.5 * noise(x / 32, y / 32, 8, 8, seed) + 0.3 * noise(x / 8, y / 8, 32, 32, seed + 1) + 0.2 * noise(x / 2.56, y / 2.56, 100, 100, seed + 2)
        return shade(base, 1 - depth + 2 * depth * n)
    return size, size, paint


def wallpaper():
    """1 m: sage ground with staggered leaf sprigs."""
    size, ground, leaf, pale = 256, (134, 158, 146), (92, 122, 110), (196, 208, 190)

    def paint(x, y):
        color = shade(ground, 0.96 + 0.08 * noise(x / 16, y / 16, 16, 16, 3))
        cell_x, cell_y = x // 64, y // 64
        dx = (x + 32 * (cell_y % 2)) % 64 - 32
        dy = y % 64 - 32
        turn = 1 if (cell_x + cell_y) % 2 else -1
        for k in range(-2, 3):
            cx, cy = 7 * turn * k * 0.5, 9 * k
            for side in (-1, 1):
                px, py = dx - cx - side * 9, dy - cy + 4
                rx, ry = px * 0.8 + py * 0.6 * side, -px * 0.6 * side + py * 0.8
                if (rx / 10) ** 2 + (ry / 3.8) ** 2 < 1:
                    color = pale if abs(ry) < 0.7 else leaf
        if abs(dx - 3.5 * turn * dy / 9) < 1.1 and abs(dy) < 24:
            color = pale
        return color
    return size, size, paint


def rug():
    """Bordered rug with a medallion lattice, 1.75 m x 2.05 m."""
    width, height = 320, 375
    red, navy, cream, ochre = (150, 48, 46), (38, 50, 84), (226, 208, 176), (204, 148, 70)

    def paint(x, y):
        edge = min(x, y, width - 1 - x, height - 1 - y)
        if edge < 6:
            color = cream if (x + y) // 3 % 2 else navy
        elif edge < 12:
            color = ochre
        elif edge < 40:
            k = (x + y) % 28 - 14
            m = (x - y) % 28 - 14
            color = cream if abs(k) + abs(m) < 9 else ochre if abs(k) + abs(m) < 13 else navy
        elif edge < 45:
            color = cream
        else:
            dx, dy = abs((x - width / 2) / 40), abs((y - height / 2) / 47)
            ring = (dx + dy) % 1.0
            star = math.hypot((x - width / 2) % 40 - 20, (y - height / 2) % 47 - 23.5)
            color = ochre if ring < 0.10 else navy if ring < 0.22 else cream if star < 5 else (110, 34, 44) if star < 9 else red
        weave = 0.90 + 0.10 * ((x + 2 * y) % 3 == 0) + 0.12 * (noise(x / 6, y / 6, 54, 63, 11) - 0.5)
        return shade(color, weave)
    return width, height, paint


def fabric(base, accent, size, seed, strength=0.16):
    def paint(x, y):
        thread = 0.5 + 0.5 * math.sin(2 * math.pi * x / 8) * math.sin(2 * math.pi * y / 8)
        blotch = noise(x / 16, y / 16, size // 16, size // 16, seed)
        return shade(mix(base, accent, 0.65 * blotch), 1 - strength / 2 + strength * thread)
    return size, size, paint


def curtain():
    size = 192
    stripes = ((214, 190, 152), (196, 128, 84), (214, 190, 152), (120, 132, 116))

    def paint(x, y):
        color = stripes[x // 24 % 4]
        if x % 24 < 2:
            color = (238, 228, 206)
        return shade(color, 0.92 + 0.10 * noise(x / 4, y / 24, 48, 8, 8))
    return size, size, paint


def zigzag():
    size = 128
    colors = ((232, 178, 58), (244, 232, 204), (60, 92, 110), (244, 232, 204))

    def paint(x, y):
        k = (y + abs(x % 32 - 16)) % 64
        return shade(colors[k // 16], 0.95 + 0.05 * ((x + y) % 2))
    return size, size, paint


def dots():
    size = 128

    def paint(x, y):
        px, py = x % 32 - 16, (y + 16 * (x // 32 % 2)) % 32 - 16
        r = math.hypot(px, py)
        color = (240, 224, 196) if r < 6 else (120, 34, 34) if r < 9 else (184, 74, 58)
        return shade(color, 0.95 + 0.05 * ((x + y) % 2))
    return size, size, paint


def spines():
    """16 book spines side by side, each with bands and a title block."""
    width, height = 256, 128
    colors = ((150, 40, 40), (36, 64, 110), (210, 180, 110), (46, 98, 72), (90, 50, 96), (224, 216, 196), (190, 92, 40), (28, 30, 38),
              (64, 140, 150), (170, 60, 92), (120, 110, 60), (70, 80, 160), (236, 196, 60), (100, 62, 40), (150, 160, 168), (20, 90, 96))

    def paint(x, y):
        k, inside = x // 16, x % 16
        color = colors[k]
        light = sum(color) > 380
        ink = (60, 44, 36) if light else (228, 200, 130)
        band = int(hashed(k, 1) * 18) + 8
        if abs(y - band) < 2 or abs(y - (height - band)) < 2 or (abs(y - band - 6) < 1 and k % 2):
            color = ink
        top, bottom = 34 + int(hashed(k, 2) * 12), 78 + int(hashed(k, 3) * 16)
        if top < y < bottom and 4 < inside < 11 and hashed(k, y // 3, inside // 2) > 0.42:
            color = ink
        return shade(color, 0.82 + 0.18 * math.sin(math.pi * (inside + 0.5) / 16))
    return width, height, paint


def landscape():
    """Hills at dusk with a lake and a sun."""
    width, height = 288, 192

    def paint(x, y):
        u, v = x / width, y / height
        sky = mix((52, 66, 122), (250, 176, 108), v * 1.8)
        d = math.hypot((u - 0.66) * 1.5, v - 0.36)
        color = (255, 236, 180) if d < 0.075 else mix((255, 216, 150), sky, (d - 0.075) * 5)
        for k, (base, tall, tone) in enumerate(((0.46, 0.16, (120, 98, 128)), (0.56, 0.14, (84, 80, 112)), (0.66, 0.10, (48, 64, 80)))):
            ridge = base - tall * (noise(u * (3 + 2 * k), 0, 64, 1, 40 + k) - 0.3) - 0.03 * noise(u * 22, 0, 64, 1, 50 + k)
            if v > ridge:
                color = shade(tone, 1.0 + 0.25 * (noise(u * 30, v * 30, 64, 64, 60 + k) - 0.5))
        if v > 0.72:
            ripple = noise(u * 10, v * 70, 64, 128, 70)
            color = mix((58, 74, 110), (240, 170, 112), 0.75 * ripple * math.exp(-abs(u - 0.66) * 4) + 0.2 * ripple)
        if v > 0.90 + 0.05 * noise(u * 14, 0, 64, 1, 80):
            color = shade((40, 52, 34), 0.7 + 0.6 * noise(u * 60, v * 40, 64, 64, 81))
        return color
    return width, height, paint


def shapes():
    size = 160
    items = (("c", 52, 56, 34, (214, 84, 58)), ("c", 104, 98, 40, (44, 92, 124)), ("r", 92, 22, 46, (236, 184, 76)), ("c", 118, 48, 16, (36, 40, 50)),
             ("r", 22, 96, 40, (124, 158, 130)), ("c", 44, 116, 12, (244, 236, 220)))

    def paint(x, y):
        color = (238, 228, 208)
        for kind, cx, cy, s, tone in items:
            if (kind == "c" and math.hypot(x - cx, y - cy) < s) or (kind == "r" and 0 <= x - cx < s and 0 <= y - cy < s):
                color = tone
        if abs((x * 0.8 + y * 0.6) % 74 - 37) < 1.2:
            color = (36, 40, 50)
        return color
    return size, size, paint


def poster():
    """Tall poster: a mountain of stripes under a moon, lines of text below."""
    width, height = 120, 168

    def paint(x, y):
        u, v = x / width, y / height
        color = (30, 58, 84)
        if math.hypot((u - 0.66) * width / height, v - 0.2) < 0.1:
            color = (246, 226, 168)
        peak = 0.28 + 0.9 * abs(u - 0.42) + 0.05 * noise(u * 9, 0, 32, 1, 21)
        if v > peak:
            k = int((v - peak) * 18)
            color = ((236, 236, 228), (208, 126, 92), (164, 76, 72), (108, 52, 70), (66, 40, 66))[min(4, k)]
        if v > 0.80:
            color = (240, 232, 214)
            if 0.83 < v < 0.89 and 0.12 < u < 0.88 and hashed(x // 6, 1) > 0.25:
                color = (30, 58, 84)
            if v > 0.91 and y % 5 < 2 and 0.2 < u < 0.8 and hashed(x // 3, y // 5) > 0.3:
                color = (120, 112, 104)
        return color
    return width, height, paint


def outside():
    """Garden under a bright sky, as seen through the window."""
    width, height = 320, 208

    def paint(x, y):
        u, v = x / width, y / height
        color = mix((112, 164, 222), (222, 234, 240), v * 1.7)
        cloud = 0.6 * noise(u * 5, v * 9, 32, 32, 90) + 0.4 * noise(u * 14, v * 22, 64, 64, 91)
        color = mix(color, (248, 248, 246), (cloud - 0.48) * 4)
        if v > 0.50 - 0.06 * noise(u * 6, 0, 64, 1, 92):
            color = shade((112, 146, 128), 0.8 + 0.4 * noise(u * 40, v * 30, 64, 64, 93))
        crown = noise(u * 7, v * 7, 64, 64, 94) * 0.16
        for cx, cy, r in ((0.14, 0.42, 0.22), (0.84, 0.36, 0.26), (0.52, 0.56, 0.10)):
            if math.hypot((u - cx) * 1.5, v - cy) < r - crown:
                color = shade((64, 116, 52), 0.55 + 0.9 * noise(u * 60, v * 40, 64, 64, 95))
            elif abs(u - cx) < 0.012 and v > cy:
                color = (74, 54, 40)
        if v > 0.70:
            color = shade((104, 156, 70), 0.75 + 0.45 * noise(u * 50, v * 60, 64, 64, 96))
            if abs(u - 0.5 - (v - 0.7) * 0.5) < 0.03 + (v - 0.7) * 0.25:
                color = shade((196, 176, 146), 0.85 + 0.3 * noise(u * 70, v * 60, 128, 64, 97))
        if 0.64 < v < 0.74 and x % 12 < 5:
            color = (228, 222, 210)
        return color
    return width, height, paint


def screen():
    width, height = 192, 112
    inks = ((120, 200, 240), (240, 190, 110), (150, 220, 140), (220, 220, 226), (230, 130, 150))

    def paint(x, y):
        if y < 8:
            return (70, 76, 96) if x > 24 or (x // 6) % 2 else (230, 110, 90)
        if x < 36:
            return (58, 64, 84) if hashed(y // 5, 7) < 0.4 or y % 5 > 2 or x < 5 or x > 8 + 26 * hashed(y // 5, 8) else (150, 160, 186)
        line = (y - 8) // 5
        indent = 40 + 8 * int(hashed(line, 1) * 4)
        if (y - 8) % 5 < 3 and indent < x < indent + 20 + 90 * hashed(line, 2) and hashed(line, x // 4) > 0.22:
            return inks[int(hashed(line, x // 17, 3) * 5)]
        return (34, 38, 54)
    return width, height, paint


def keys():
    width, height = 160, 56

    def paint(x, y):
        row = y // 11
        px = (x + 3 * row) % 11
        if y > 44 and 44 < x < 108:
            px = 5
        if px < 2 or y % 11 < 2:
            return (26, 27, 30)
        special = x < 18 or x > 142 or row == 0
        color = (198, 88, 60) if row == 0 and x < 14 else (92, 96, 104) if special else (212, 212, 206)
        if not special and 5 <= px <= 6 and 4 <= y % 11 <= 7:
            color = (90, 90, 92)
        return color
    return width, height, paint


def clock():
    size = 128

    def paint(x, y):
        dx, dy = x - 63.5, y - 63.5
        r, a = math.hypot(dx, dy), math.atan2(dx, -dy)
        tick = abs((a / (math.pi / 6) + 0.5) % 1.0 - 0.5) * math.pi / 6 * r
        color = (240, 236, 222)
        if 48 < r < 58 and tick < 1.8:
            color = (40, 40, 44)
        for angle, reach, half in ((math.radians(305), 30, 2.4), (math.radians(60), 46, 1.6)):
            along, across = dx * math.sin(angle) - dy * math.cos(angle), dx * math.cos(angle) + dy * math.sin(angle)
            if -6 < along < reach and abs(across) < half:
                color = (40, 40, 44)
        return (190, 50, 40) if r < 3.5 else color
    return size, size, paint


def leaf():
    width, height = 48, 96

    def paint(x, y):
        u, v = abs(x / width - 0.5) * 2, y / height
        vein = abs((v * 9 + u * 1.6) % 1.0 - 0.5) < 0.07
        color = mix((58, 128, 52), (24, 84, 38), u * 0.8 + 0.2 * noise(x / 8, y / 8, 6, 12, 4))
        return (150, 190, 108) if u < 0.07 else shade(color, 1.35) if vein else color
    return width, height, paint


def door():
    width, height = 128, 320

    def paint(x, y):
        grain = 0.84 + 0.30 * noise(x / 3.2, y / 64, 40, 5, 61)
        color = shade((146, 100, 68), grain)
        for x0, x1, y0, y1 in ((18, 58, 24, 130), (70, 110, 24, 130), (18, 58, 160, 296), (70, 110, 160, 296)):
            edge = min(x - x0, x1 - x, y - y0, y1 - y)
            if 0 <= edge < 4:
                color = shade(color, 0.66 if x - x0 == edge or y - y0 == edge else 1.18)
            elif edge >= 4:
                color = shade(color, 1.04)
        return color
    return width, height, paint


def shade_cloth():
    size = 64
    return size, size, lambda x, y: shade((232, 206, 160), 0.86 + 0.1 * (x % 16 < 2) + 0.12 * noise(x / 4, y / 4, 16, 16, 5))


def glaze():
    size = 128

    def paint(x, y):
        if 40 < y < 56 or 84 < y < 92:
            return (232, 226, 208) if (x // 8 + (y // 4)) % 2 else (42, 84, 150)
        return mix((26, 58, 118), (70, 128, 176), noise(x / 16, y / 16, 8, 8, 71))
    return size, size, paint


def wicker():
    size = 64

    def paint(x, y):
        over = (x // 8 + y // 8) % 2
        bulge = math.sin(math.pi * ((x if over else y) % 8 + 0.5) / 8)
        return shade((184, 142, 86), 0.45 + 0.55 * bulge)
    return size, size, paint


TEXTURES = {
    "plaster": plaster((226, 220, 208), 0.07, 1), "ceiling": plaster((240, 238, 232), 0.04, 5), "wallpaper": wallpaper(), "planks": planks(),
    "oak": wood((158, 118, 76), (206, 168, 118), 256, 21), "walnut": wood((78, 50, 34), (124, 86, 58), 256, 25), "door": door(), "rug": rug(),
    "sofa": fabric((52, 92, 112), (84, 128, 142), 128, 33), "seat": fabric((196, 112, 62), (216, 146, 92), 128, 35),
    "dark": fabric((58, 60, 68), (82, 84, 94), 128, 37), "curtain": curtain(), "zigzag": zigzag(), "dots": dots(), "spines": spines(),
    "landscape": landscape(), "shapes": shapes(), "poster": poster(), "outside": outside(), "screen": screen(), "keys": keys(), "clock": clock(),
    "leaf": leaf(), "shade": shade_cloth(), "glaze": glaze(), "wicker": wicker(), "terracotta": plaster((188, 112, 80), 0.12, 45),
}
