"""Meshes of scripts/make_room.py: boxes, cylinders and the like as lines of an OBJ file."""
import math


class Room:
    """Collects objects of the given materials; a local frame (origin, turn about z) places furniture."""

    def __init__(self, materials):
        self.materials = materials
        self.lines, self.count = [], [0, 0, 0]
        self.faces = 0
        self.place()

    def place(self, x=0.0, y=0.0, z=0.0, yaw_deg=0.0):
        a = math.radians(yaw_deg)
        self.frame = (x, y, z, math.cos(a), math.sin(a))

    def world(self, p):
        x, y, z, c, s = self.frame
        return (x + c * p[0] - s * p[1], y + s * p[0] + c * p[1], z + p[2])

    def turn(self, n):
        _, _, _, c, s = self.frame
        return (c * n[0] - s * n[1], s * n[0] + c * n[1], n[2])

    def object(self, name):
        self.lines.append("o " + name)

    def material(self, name):
        assert name in self.materials, name
        self.lines.append("usemtl " + name)

    def mesh(self, material, points, uvs, faces, normals=None):
        """points, uvs (and smooth normals) share one numbering; faces are corner lists."""
        self.material(material)
        for p in points:
            self.lines.append("v %.4f %.4f %.4f" % self.world(p))
        for t in uvs:
            self.lines.append("vt %.4f %.4f" % t)
        for n in normals or []:
            self.lines.append("vn %.3f %.3f %.3f" % self.turn(n))
        v, t, n = self.count
        for f in faces:
            if normals:
                self.lines.append("f " + " ".join("%d/%d/%d" % (v + i + 1, t + i + 1, n + i + 1) for i in f))
            else:
                self.lines.append("f " + " ".join("%d/%d" % (v + i + 1, t + i + 1) for i in f))
            self.faces += len(f) - 2
        self.count = [v + len(points), t + len(uvs), n + len(normals or [])]

    def quad(self, material, a, b, c, d, uv=((0, 0), (1, 0), (1, 1), (0, 1))):
        self.mesh(material, [a, b, c, d], list(uv), [(0, 1, 2, 3)])

    def box(self, material, lo, hi, scale=1.0, skip=""):
        """Texture in metres times scale; the grain follows the longest side of each face."""
        (x0, y0, z0), (x1, y1, z1) = lo, hi
        sides = {
            "w": ((x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)), "e": ((x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)),
            "s": ((x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)), "n": ((x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)),
            "t": ((x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)), "b": ((x0, y1, z0), (x1, y1, z0), (x1, y0, z0), (x0, y0, z0)),
        }
        points, uvs, faces = [], [], []
        for key, corners in sides.items():
            if key in skip:
                continue
            across, along = math.dist(corners[0], corners[1]) * scale, math.dist(corners[1], corners[2]) * scale
            shift = 0.137 * len(self.lines) % 1.0
            if across >= along:
                local = [(shift, 0), (shift + across, 0), (shift + across, along), (shift, along)]
            else:
                local = [(shift, 0), (shift, across), (shift + along, across), (shift + along, 0)]
            faces.append(tuple(range(len(points), len(points) + 4)))
            points += corners
            uvs += local
        self.mesh(material, points, uvs, faces)

    def lathe(self, material, profile, sides=20, center=(0, 0, 0), u_repeat=1.0, v_scale=1.0, smooth=True):
        """profile: (radius, z) from bottom to top, outside on the right."""
        points, uvs, normals, faces = [], [], [], []
        run = 0.0
        for i, (r, z) in enumerate(profile):
            a, b = profile[max(0, i - 1)], profile[min(len(profile) - 1, i + 1)]
            dr, dz = b[0] - a[0], b[1] - a[1]
            size = math.hypot(dr, dz) or 1.0
            if i:
                run += math.dist(profile[i - 1], profile[i])
            for k in range(sides + 1):
                w = 2 * math.pi * k / sides
                points.append((center[0] + r * math.cos(w), center[1] + r * math.sin(w), center[2] + z))
                uvs.append((u_repeat * k / sides, run * v_scale))
                normals.append((dz / size * math.cos(w), dz / size * math.sin(w), -dr / size))
        row = sides + 1
        for i in range(len(profile) - 1):
            for k in range(sides):
                a, b, c, d = i * row + k, i * row + k + 1, (i + 1) * row + k + 1, (i + 1) * row + k
                if profile[i][0] < 1e-6:
                    faces.append((a, c, d))
                elif profile[i + 1][0] < 1e-6:
                    faces.append((a, b, c))
                else:
                    faces.append((a, b, c, d))
        self.mesh(material, points, uvs, faces, normals if smooth else None)

    def rod(self, material, a, b, radius, sides=10):
        """Round bar between two points, with flat ends."""
        axis = [q - p for p, q in zip(a, b)]
        size = math.sqrt(sum(c * c for c in axis))
        w = [c / size for c in axis]
        h = (1, 0, 0) if abs(w[0]) < 0.9 else (0, 1, 0)
        u = [w[1] * h[2] - w[2] * h[1], w[2] * h[0] - w[0] * h[2], w[0] * h[1] - w[1] * h[0]]
        s = math.sqrt(sum(c * c for c in u))
        u = [c / s for c in u]
        v = [w[1] * u[2] - w[2] * u[1], w[2] * u[0] - w[0] * u[2], w[0] * u[1] - w[1] * u[0]]
        points, uvs, normals, faces = [], [], [], []
        for end, p in enumerate((a, b)):
            for k in range(sides):
                t = 2 * math.pi * k / sides
                n = [math.cos(t) * u[i] + math.sin(t) * v[i] for i in range(3)]
                points.append(tuple(p[i] + radius * n[i] for i in range(3)))
                uvs.append((end * size, k / sides))
                normals.append(tuple(n))
        for k in range(sides):
            m = (k + 1) % sides
            faces.append((k, m, sides + m, sides + k))
        for end, p in enumerate((a, b)):
            first = len(points)
            sign = 1 if end else -1
            for k in range(sides):
                points.append(points[end * sides + k])
                uvs.append((0, 0))
                normals.append(tuple(sign * c for c in w))
            ring = tuple(range(first, first + sides))
            faces.append(ring if end else ring[::-1])
        self.mesh(material, points, uvs, faces, normals)

    def pillow(self, material, center, size, power=0.45, flat=1.0, rows=10, sides=20, tilt_deg=0.0, repeat=1.0):
        """Superellipsoid: power 1 = ellipsoid, towards 0 = box; tilt about the local y axis."""
        signed = lambda v, e: math.copysign(abs(v) ** e, v)
        c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
        points, uvs, normals, faces = [], [], [], []
        for i in range(rows + 1):
            lat = -math.pi / 2 + math.pi * i / rows
            for k in range(sides + 1):
                lon = 2 * math.pi * k / sides
                d = (signed(math.cos(lat), flat) * signed(math.cos(lon), power),
                     signed(math.cos(lat), flat) * signed(math.sin(lon), power), signed(math.sin(lat), flat))
                n = (signed(math.cos(lat), 2 - flat) * signed(math.cos(lon), 2 - power) / size[0],
                     signed(math.cos(lat), 2 - flat) * signed(math.sin(lon), 2 - power) / size[1],
                     signed(math.sin(lat), 2 - flat) / size[2])
                size_n = math.sqrt(sum(x * x for x in n)) or 1.0
                n = [x / size_n for x in n]
                p = [d[j] * size[j] / 2 for j in range(3)]
                uvs.append(((d[0] * 0.5 + 0.5) * repeat, (d[1] * 0.5 + 0.5) * repeat * size[1] / size[0]))
                points.append((center[0] + c * p[0] + s * p[2], center[1] + p[1], center[2] - s * p[0] + c * p[2]))
                normals.append((c * n[0] + s * n[2], n[1], -s * n[0] + c * n[2]))
        row = sides + 1
        for i in range(rows):
            for k in range(sides):
                a, b, cc, d = i * row + k, i * row + k + 1, (i + 1) * row + k + 1, (i + 1) * row + k
                if i == 0:
                    faces.append((a, cc, d))
                elif i == rows - 1:
                    faces.append((a, b, cc))
                else:
                    faces.append((a, b, cc, d))
        self.mesh(material, points, uvs, faces, normals)
