"""Panels of lines on logarithmic axes, as SVG."""
import math
from xml.sax.saxutils import escape

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999", "#7f3c8d", "#11a579")
WIDTH, HEIGHT, LEFT, TOP, RIGHT, BOTTOM = 420, 300, 62, 30, 12, 44


def decades(low, high):
    return [10.0 ** e for e in range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)]


def panel(title, x_label, lines, x0, y0, linear):
    points = [p for _, line in lines for p in line] or [(1.0, 1.0), (10.0, 10.0)]
    (low_x, high_x), (low_y, high_y) = ((min(v) / 1.2, max(v) * 1.2) for v in zip(*points))
    if linear:
        low_y, high_y = math.floor(min(y for _, y in points)) - 1, math.ceil(max(y for _, y in points)) + 1

    def place(value, low, high, begin, length, of=math.log):
        return f"{begin + length * (of(value) - of(low)) / (of(high) - of(low)):.1f}"

    def at(x, y):
        return (place(x, low_x, high_x, x0 + LEFT, WIDTH - LEFT - RIGHT),
                place(y, high_y, low_y, y0 + TOP, HEIGHT - TOP - BOTTOM, float if linear else math.log))
    out = [f'<text x="{x0 + LEFT}" y="{y0 + TOP - 8}">{escape(title)}</text>',
           f'<text x="{x0 + (WIDTH + LEFT) / 2}" y="{y0 + HEIGHT - 8}" text-anchor="middle">{escape(x_label)}</text>',
           f'<rect x="{x0 + LEFT}" y="{y0 + TOP}" width="{WIDTH - LEFT - RIGHT}" height="{HEIGHT - TOP - BOTTOM}" '
           'fill="none" stroke="#888"/>']
    for x in decades(low_x, high_x):
        out.append(f'<text x="{at(x, low_y)[0]}" y="{y0 + HEIGHT - BOTTOM + 14}" text-anchor="middle">{x:g}</text>')
    for y in range(low_y, high_y + 1, 2) if linear else decades(low_y, high_y):
        px, py = at(low_x, y)
        out.append(f'<line x1="{px}" x2="{x0 + WIDTH - RIGHT}" y1="{py}" y2="{py}" stroke="#ddd"/>'
                   f'<text x="{x0 + LEFT - 4}" y="{py}" text-anchor="end" dominant-baseline="middle">{y:g}</text>')
    for i, (name, line) in enumerate(lines):
        path = " ".join(",".join(at(*p)) for p in line)
        color = COLORS[i % len(COLORS)]
        dashes = ' stroke-dasharray="5 4"' if ":" in name else ""  # figures of others
        out.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.6"{dashes}/>')
        out += ['<circle cx="{}" cy="{}" r="2" fill="{}"/>'.format(*at(*p), color) for p in line]
    return out


def svg(title, panels, columns=2, linear=False):
    """`panels`: (title, label of x, [(name of a line, [(x, y) above 0])]), all with the same lines. `linear`: the axis of
    y is no logarithm."""
    names = [name for name, _ in panels[0][2]]
    rows = -(-len(panels) // columns)
    width, legend_y = columns * WIDTH, 30 + rows * HEIGHT
    beside = columns + 1  # names in a row of the legend
    height = legend_y + 18 * (-(-len(names) // beside)) + 10
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
           'font-family="sans-serif" font-size="11">',
           f'<rect width="{width}" height="{height}" fill="#fff"/>'
           f'<text x="12" y="20" font-size="14">{escape(title)}</text>']
    for i, (head, x_label, lines) in enumerate(panels):
        out += panel(head, x_label, lines, i % columns * WIDTH, 30 + i // columns * HEIGHT, linear)
    for i, name in enumerate(names):
        x, y = 20 + i % beside * width / beside, legend_y + 18 * (i // beside)
        out.append(f'<line x1="{x:.0f}" x2="{x + 22:.0f}" y1="{y}" y2="{y}" '
                   f'stroke="{COLORS[i % len(COLORS)]}" stroke-width="2"/>'
                   f'<text x="{x + 28:.0f}" y="{y + 4}">{escape(name)}</text>')
    return "\n".join(out) + "\n</svg>\n"
