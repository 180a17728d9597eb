#!/usr/bin/env python3
"""Error of every rule of the rendering integral against evaluations and time, on media whose integrals are known.

    studies/quadrature.py --out FOLDER        # tables.md

Samples and composited rays are the program's own; the media, their integrals by Gauss' rule, what theory predicts
(docs/reference/quadrature.md derives it), and the rules of the literature, marked *, are written down here. Time is CPU
time of one ray: sampling, the medium's formulas in NumPy, compositing. Exit code 1 where a measured order is not the
predicted one.
"""
import argparse
import dataclasses
import math
import sys
import time
from typing import Callable

import numpy as np

from common import table, write
from semfield import _core

COUNTS = (8, 16, 32, 64, 128, 256, 512, 1024)
LEVELS = (2e-3, 1e-4, 1e-6)
LEAST_TIMED_S = 0.002  # shorter measurements are repeated


@dataclasses.dataclass
class Medium:
    """A medium along a ray. Its functions take distances t [..., n]; `shift` [..., 1] moves the jumps, if any."""
    name: str
    key: str
    sigma: Callable
    depth: Callable  # integral of sigma from 0 to t
    slope: Callable = lambda t: 0 * t  # of sigma
    color: Callable = lambda t: t / 4
    color_slope: Callable = lambda t: 0 * t + 0.25
    jumps: tuple = ()  # for shift 0, ascending
    near: float = 0.0
    far: float = 4.0
    longest_shift: float = 0.0


def slabs(name, key, walls, color=lambda t: t / 4, far=4.0, near=0.0, longest_shift=0.5):
    """Vacuum with slabs (begin, end, sigma)."""
    def sigma(t, shift=0.0):
        return sum(np.where((t >= b + shift) & (t < e + shift), s, 0.0) for b, e, s in walls)

    def depth(t, shift=0.0):
        return sum(s * np.clip(t - (b + shift), 0, e - b) for b, e, s in walls)
    jumps = tuple(edge for b, e, _ in walls for edge in (b, e) if math.isfinite(edge))
    return Medium(name, key, sigma, depth, color=color, jumps=jumps, near=near, far=far,
                  longest_shift=longest_shift)


def constant(sigma):
    return Medium("sigma everywhere, c = t/4", "stiff", lambda t, shift=0: sigma + 0 * t, lambda t, shift=0: sigma * t)


def one(t):
    return 1 + 0 * t


MEDIA = [
    dataclasses.replace(constant(1.0), name="sigma = 1, c = 1", key="constant", color=one, color_slope=lambda t: 0 * t),
    dataclasses.replace(constant(1.0), name="sigma = 1, c = t/4", key="linear_colour"),
    Medium("sigma = t, c = 1", "linear_density", lambda t, shift=0: t, lambda t, shift=0: t * t / 2, one, one,
           lambda t: 0 * t),
    Medium("sigma = e^-t, c = cos t", "decay_cosine", lambda t, shift=0: np.exp(-t), lambda t, shift=0: -np.expm1(-t),
           lambda t: -np.exp(-t), np.cos, lambda t: -np.sin(t)),
    slabs("slabs, edges off the grid", "slabs", [(0.7, 1.3, 5), (2.1, 3.2, 1)]),
    slabs("wall, sigma = 10^4 from 1.234", "wall", [(1.234, math.inf, 1e4)]),
]


def logits(t):
    return np.stack([3 * np.sin(t), 3 * np.cos(t / 2), 1 + 0 * t], -1)


def channels(medium, t):
    """What a sample shows: colour and logits [..., 4]."""
    return np.concatenate([medium.color(t)[..., None], logits(t)], -1)


def probability(logit):
    """Of class 0; logits [..., 3]."""
    return 1 / np.exp(logit - logit[..., :1]).sum(-1)


# Integrals: Gauss' rule of 16 points on panels. Light decays within 1/sigma, so the panels of a piece without jumps
# double in length from its near end.
NODE, WEIGHT = np.polynomial.legendre.leggauss(16)


def nodes(medium, begin, shift):
    """Nodes and weights [R, n] of a fine rule on [begin, far] for each of `begin` [R, 1], with shifts [R, 1]."""
    borders = [begin] + [np.clip(j + shift, begin, medium.far) for j in medium.jumps] + [medium.far + 0 * begin]
    t, w = [], []
    for low, high in zip(borders, borders[1:]):
        tau = float(np.max(medium.depth(high, shift) - medium.depth(low, shift)))
        levels = math.ceil(math.log2(tau)) + 1 if tau > 4 else 0
        share = np.concatenate([[0.0], np.ldexp(1.0, -np.arange(levels, -1, -1))])
        share = np.unique(np.concatenate([a + (b - a) * np.arange(5) / 4 for a, b in zip(share, share[1:])]))
        edge = low + (high - low) * share
        half, middle = np.diff(edge) / 2, (edge[:, 1:] + edge[:, :-1]) / 2
        t.append((middle[..., None] + half[..., None] * NODE).reshape(len(edge), -1))
        w.append((half[..., None] * WEIGHT).reshape(len(edge), -1))
    return np.concatenate(t, 1), np.concatenate(w, 1)


def seen_from(medium, begin, shift):
    """Integrals of sigma T v from `begin` [R, 1], where T is 1: opacity, colour, distance, three logits [R, 6]."""
    t, w = nodes(medium, begin, shift)
    before = medium.depth(begin, shift)
    w = w * medium.sigma(t, shift) * np.exp(before - medium.depth(t, shift))
    seen = channels(medium, t)
    opacity = -np.expm1(before - medium.depth(medium.far + 0 * begin, shift))
    return np.concatenate([opacity, (w * seen[..., 0]).sum(1, keepdims=True), (w * t).sum(1, keepdims=True),
                           (w[..., None] * seen[..., 1:]).sum(1)], 1)


def quantities(seen):
    """[R, 6] of seen_from -> colour, opacity, depth, probability [R, 4]."""
    return np.stack([seen[:, 1], seen[:, 0], seen[:, 2], probability(seen[:, 3:])], 1)


def truth(medium, shifts):
    return quantities(seen_from(medium, medium.near + 0 * shifts[:, None], shifts[:, None]))


@dataclasses.dataclass
class Rule:
    name: str
    shape: str  # what theory says of it: left, paper_training, paper_rendering, midpoint, bin_training, second, fourth
    sampler: str = ""  # "": of the literature
    choice: str = ""
    training: bool = False

    @property
    def label(self):
        return self.name if self.sampler else self.name + " *"

    @property
    def guided(self):
        return self.sampler == "importance"  # a second pass, drawn by the weights of a first one of a quarter of it


def samplers_rules():
    for sampler in ("stratified", "importance"):
        of = "" if sampler == "stratified" else sampler + " "
        yield Rule(of + "paper, training", "left" if of else "paper_training", sampler, "paper", True)
        yield Rule(of + "paper, rendering", "left" if of else "paper_rendering", sampler, "paper")
        yield Rule(of + "midpoint", "second" if of else "midpoint", sampler, "midpoint")
        yield Rule(of + "stratified_bin", "second" if of else "bin_training", sampler, "stratified_bin", True)


RULES = [*samplers_rules(), Rule("left grid", "left", choice="left"), Rule("trapezoid", "second", choice="trapezoid"),
         Rule("linear colour", "second", choice="linear"), Rule("Gauss 2", "fourth", choice="gauss")]


def sampled(medium, rule, n, shifts, doubles):
    """Rays by the program's samplers and its compositor. Returns [R, 6] and evaluations of a ray."""
    composite = _core.composite if doubles else _core.composite_float32
    rays = np.tile([0.0, 0, 0, 1, 0, 0, medium.near, medium.far], (len(shifts), 1))

    def one_pass(sampler, count, previous):
        t, delta, first = _core.sample({"type": sampler, "samples": count, "quadrature": rule.choice}, rays,
                                       rule.training, doubles, previous)
        at = t.astype(np.float64).reshape(len(shifts), -1)
        values = channels(medium, at)[..., [0, 0, 0, 1, 2, 3]].reshape(-1, 6)  # three colours
        found = composite(t, delta, first, medium.sigma(at, shifts[:, None]).ravel(), values)
        return (t, delta, first, found[3]), found, at.shape[1]
    coarse, previous, before = (n // 4 if rule.guided else 0), None, 0
    if coarse:
        previous, _, before = one_pass("stratified", coarse, None)
    _, (opacity, depth, sums, _), made = one_pass(rule.sampler, n - coarse, previous)
    return np.column_stack([opacity, sums[:, 0], depth, sums[:, 3:]]).astype(np.float64), made + before


def of_literature(medium, rule, n, shifts, doubles):
    """The same by rules on N equal intervals: values in the precision asked for, sums in float64."""
    real = np.float64 if doubles else np.float32
    h = (medium.far - medium.near) / n
    begin = medium.near + h * np.arange(n)
    gauss = (1 - 1 / math.sqrt(3)) / 2
    if rule.choice == "gauss":
        at = np.stack([begin + h * gauss, begin + h * (1 - gauss)], 1).ravel()
    else:
        at = begin if rule.choice == "left" else np.append(begin, medium.far)
    at = at.astype(real).astype(np.float64)[None]
    sigma = np.broadcast_to(medium.sigma(at, shifts[:, None]), (len(shifts), at.size)).astype(real)
    seen = np.concatenate([np.ones((1, at.size, 1)), medium.color(at)[..., None], at[..., None], logits(at)],
                          -1).astype(real)
    if rule.choice == "gauss":  # two points of the integrand sigma T v itself, T by the line through both densities
        a, b = sigma[:, ::2], sigma[:, 1::2]
        tau = (h * (a.astype(np.float64) + b) / 2).cumsum(1)
        before = np.exp(-np.hstack([np.zeros((len(shifts), 1)), tau[:, :-1]]).astype(real))
        line = (b - a) / (1 - 2 * gauss)
        weight = [h / 2 * s * before * np.exp(-np.maximum(0, h * (a * x + line * (x * x / 2 - gauss * x))))
                  for s, x in ((a, gauss), (b, 1 - gauss))]  # the line may dip below 0
        weight = np.stack(weight, 2).reshape(len(shifts), -1)
    else:
        nodes_too = rule.choice != "left"
        x = ((sigma[:, :-1] + sigma[:, 1:]) / 2 if nodes_too else sigma) * real(h)
        tau = x.astype(np.float64).cumsum(1)
        light = np.exp(-np.hstack([np.zeros((len(shifts), 1)), tau[:, :-1]]).astype(real)) * -np.expm1(-x)
        weight = np.zeros((len(shifts), at.size), real)
        share = mean_place(x) if rule.choice == "linear" else real(0.5 if nodes_too else 0)
        weight[:, :n] += light * (1 - share)
        if nodes_too:
            weight[:, 1:] += light * share
    return (weight.astype(np.float64) @ seen[0].astype(np.float64)), at.size


def mean_place(x):
    """Where in an interval of optical depth x light comes from in the mean."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(x < 1e-2, 0.5 - x / 12 + x ** 3 / 720, 1 / x - 1 / np.expm1(x)).astype(x.dtype)


def shifts_of(medium, rays):
    """Offsets spread evenly and without a common measure with any grid: multiples of the golden ratio."""
    return medium.longest_shift * ((np.arange(rays) * 0.6180339887498949) % 1)


def render(medium, rule, n, shifts, doubles=True, timed=False):
    """What rays show [R, 4], evaluations of a ray, and CPU seconds of a ray."""
    work, best, spent = (sampled if rule.sampler else of_literature), math.inf, 0.0
    while True:
        begin = time.process_time()
        seen, evaluations = work(medium, rule, n, shifts, doubles)
        took = time.process_time() - begin
        best, spent = min(best, took / len(shifts)), spent + took
        if not timed or spent >= LEAST_TIMED_S:
            return quantities(seen), evaluations, best


@dataclasses.dataclass
class Terms:
    """Of a smooth medium: mean error = bias1 h + bias2 h^2; variance over rays = variance2 h^2 + variance3 h^3."""
    bias1: float = 0.0
    bias2: float = 0.0
    variance2: float = 0.0
    variance3: float = 0.0

    def rms(self, h):
        return math.sqrt((self.bias1 * h + self.bias2 * h * h) ** 2 + self.variance2 * h ** 2 + self.variance3 * h ** 3)

    @property
    def exact(self):
        return not any(dataclasses.astuple(self))


def predicted(medium, rule, q):
    """(order, Terms or None) of quantity q. With G = T sigma (v - R), G' = T (sigma' (v - R) + sigma v')."""
    if medium.jumps:
        return (0.0 if rule.shape == "fourth" and medium.key == "wall" else 1.0), None
    if rule.shape in ("second", "fourth"):
        return (2.0 if rule.shape == "second" else 4.0), None
    zero = np.zeros((1, 1))
    mean = seen_from(medium, medium.near + zero, zero)[0, 3:]
    p = np.exp(mean - mean.max()) / np.exp(mean - mean.max()).sum()
    by_logit = p[0] * (np.eye(3)[0] - p)  # dp_0 / ds_j: errors are linear in what a sample shows
    value = (medium.color, one, lambda t: t, lambda t: logits(t) @ by_logit)[q]
    slope = (medium.color_slope, lambda t: 0 * t, one,
             lambda t: np.stack([3 * np.cos(t), -1.5 * np.sin(t / 2), 0 * t], -1) @ by_logit)[q]

    def behind(t):
        seen = seen_from(medium, t[:, None], np.zeros((len(t), 1)))
        return (seen[:, 1], seen[:, 0], seen[:, 2], seen[:, 3:] @ by_logit)[q]

    def light(t):
        return np.exp(medium.depth(np.asarray(medium.near)) - medium.depth(t))

    def g(t):
        return light(t) * medium.sigma(t) * (value(t) - behind(t))

    def g_slope(t):
        return light(t) * (medium.slope(t) * (value(t) - behind(t)) + medium.sigma(t) * slope(t))

    def clean(x):
        return 0.0 if abs(x) < 1e-14 else float(x)  # rounding
    t, w = (a[0] for a in nodes(medium, medium.near + zero, zero))
    ends = np.array([medium.near, medium.far])
    (near_g, far_g), (near_slope, far_slope) = g(ends), g_slope(ends)
    squares = (w * g_slope(t) ** 2).sum()
    if rule.shape == "paper_training":
        return 1.0, Terms(clean(-(7 * far_g - near_g) / 12), 0.0, clean(near_g ** 2 / 12), clean(squares / 80))
    if rule.shape == "bin_training":
        return 1.5, Terms(variance3=clean(squares / 12))
    second = ((w * light(t) * slope(t) * medium.sigma(t) ** 2).sum() - (far_slope - near_slope)) / 24
    if rule.shape == "midpoint":
        return 2.0, Terms(0.0, clean(second))
    sigma = medium.sigma(ends)
    # (sigma v)' at the far end, with the light that gets there.
    shown = light(ends[1:])[0] * (medium.slope(ends) * value(ends) + sigma * slope(ends))[1]
    if rule.shape == "paper_rendering":
        return 1.0, Terms(clean(-far_g / 2), clean(second + (2 * shown - sigma[1] * far_g) / 8))
    second += (shown - near_slope - sigma[0] * near_g + (2 * sigma[0] - sigma[1]) * far_g) / 8
    return 1.0, Terms(clean(-(far_g - near_g) / 2), clean(second))


@dataclasses.dataclass
class Curve:
    evaluations: np.ndarray  # [N]
    seconds: np.ndarray  # [N]
    rms: np.ndarray  # [N, 4]
    orders: list  # [4], None: at rounding throughout
    predictions: list  # [4] of (order, Terms)
    doubles: bool
    rule: Rule
    length: float  # of a ray

    def slope(self, q, errors):
        """Of log error over log h, least squares, from 64 samples on and above rounding."""
        counts = np.array(COUNTS)
        use = (counts >= 64) & (self.rms[:, q] >= (1e-13 if self.doubles else 1e-5))
        return float(np.polyfit(-np.log(counts[use]), np.log(errors[use]), 1)[0]) if use.sum() > 1 else None

    def expected(self, q):
        terms = self.predictions[q][1]
        if terms is None or terms.exact:
            return None
        return self.slope(q, np.array([terms.rms(self.length / n) for n in COUNTS]))

    def holds(self, q):
        """Whether the measured order is the predicted one; None: nothing was predicted that could be compared."""
        terms = self.predictions[q][1]
        if terms is not None and terms.exact:
            return bool((self.rms[:, q] < 1e-12).all())
        expected = self.expected(q)
        if expected is None:
            return None
        band = {"bin_training": 0.2, "paper_training": 0.1}.get(self.rule.shape, 0.05)
        return abs(self.orders[q] - expected) <= band

    def crossing(self, level):
        """Evaluations and seconds of a ray from which the error of colour stays below `level`; None: it never does."""
        below = self.rms[:, 0] <= level
        first = len(below) - int(np.argmin(below[::-1])) if not below.all() else 0
        if first == len(below):
            return None
        if first == 0:
            return self.evaluations[0], self.seconds[0]
        high, low = np.log(np.maximum(self.rms[[first - 1, first], 0], 1e-300))
        share = (high - math.log(level)) / (high - low)
        return tuple(x[first - 1] * (x[first] / x[first - 1]) ** share for x in (self.evaluations, self.seconds))


def measure(medium, rule, rays, doubles):
    shifts = shifts_of(medium, rays if rule.training or medium.jumps else min(rays, 64))
    exact = truth(medium, shifts) if medium.jumps else truth(medium, np.zeros(1))
    rows = [render(medium, rule, n, shifts, doubles, timed=True) for n in COUNTS]
    rms = np.array([np.sqrt(((seen - exact) ** 2).mean(0)) for seen, _, _ in rows])
    predictions = [predicted(medium, rule, q) for q in range(4)]
    if rule.guided:  # its intervals are not equal
        predictions = [(order, None) for order, _ in predictions]
    evaluations, seconds = (np.array([row[i] for row in rows], float) for i in (1, 2))
    curve = Curve(evaluations, seconds, rms, [], predictions, doubles, rule, medium.far - medium.near)
    curve.orders = [curve.slope(q, rms[:, q]) for q in range(4)]
    return curve


def order_text(curve, q):
    order, terms = curve.predictions[q]
    expected = curve.expected(q)
    exact = terms is not None and terms.exact
    says = "exact" if exact else f"{order:g}" if expected is None else f"{expected:.2f}"
    measured = f"{curve.orders[q]:.2f}" if curve.orders[q] is not None else "exact" if exact else "at rounding"
    return f"{measured} ({says})" + (" !" if curve.holds(q) is False else "")


def medium_table(medium, curves):
    rows = []
    for rule in RULES:
        curve, single = curves[medium.key, rule.name, True], curves[medium.key, rule.name, False]
        cells = [rule.label, *(order_text(curve, q) for q in range(4))]
        cells += [f"{curve.rms[COUNTS.index(64), 0]:.1e}", f"{curve.rms[-1, 0]:.1e}", f"{single.rms[-1, 0]:.1e}"]
        for level in LEVELS:
            found = curve.crossing(level)
            cells.append("never" if found is None else f"{found[0]:.0f}, {1e6 * found[1]:.2f} µs")
        rows.append(cells)
    return f"\n## {medium.name}\n\n" + table(
        ["rule", "order of colour (predicted)", "opacity", "depth", "class probability", "rms error, 64 samples",
         "1024", "float32, 1024", *(f"evaluations and time for {level:.0e}" for level in LEVELS)], rows)


def stiff_table(rays):
    """Light of an interval comes from its exponential mean, and a rule takes the colour of its sample."""
    h, powers, rows = 4 / 64, (0, 1, 2, 4, 8), []
    for rule in RULES:
        cells = [rule.label]
        for power in powers:
            sigma = 10.0 ** power
            medium = constant(sigma)
            shifts = shifts_of(medium, rays if rule.training else 1)
            error = render(medium, rule, 64, shifts)[0][:, 0] - truth(medium, np.zeros(1))[0, 0]
            mean, lit = 1 / sigma - (h / math.expm1(sigma * h) if sigma * h < 700 else 0), -math.expm1(-4 * sigma)
            says = None
            if rule.shape == "midpoint":
                says = abs(h / 2 - mean) * lit / 4
            elif rule.choice == "left":
                says = mean * lit / 4
            elif sigma * h > 50 and rule.shape == "paper_rendering":
                says = (h / 2 - 1 / sigma) / 4
            elif sigma * h > 50 and rule.shape in ("paper_training", "bin_training"):
                # The first point is spread evenly over the first bin.
                says = math.sqrt(h * h / 3 - h / sigma + 1 / sigma ** 2) / 4
            cells.append(f"{math.sqrt((error ** 2).mean()):.2e}" + ("" if says is None else f" ({says:.2e})"))
        rows.append(cells)
    return "\n## Stiff media, c = t/4, 64 samples on [0, 4]: rms error of colour (predicted)\n\n" + table(
        ["rule", *(f"sigma = 10^{p}" for p in powers)], rows)


def thin_table(rays):
    """Slabs of optical depth 10 that begin at a fifth of a bin; 256 samples on [0.1, 10]."""
    h, rows = 9.9 / 256, []
    for rule in RULES:
        cells = [rule.label]
        for power in range(6):
            width = 10.0 ** -power
            begin = 0.1 + h * 100.2
            medium = slabs("thin slab", "thin_slab", [(begin, begin + width, 10 / width)], one, 10.0, 0.1, 0.0)
            opacity = render(medium, rule, 256, np.zeros(rays if rule.training else 1))[0][:, 1]
            cells.append(f"{opacity.mean():.5f}")
            if len(opacity) > 1:
                cells[-1] += f" ± {opacity.std(ddof=1) / math.sqrt(len(opacity)):.5f}"
            if rule.shape == "bin_training" and 0.2 * h + width < h:
                cells[-1] += f" ({width / h * -math.expm1(-10 / width * h):.5f})"
        rows.append(cells)
    return (f"\n## Slabs of optical depth 10, 256 samples on [0.1, 10], h = {h:.4f} m\n\nMean opacity (expected); true "
            f"{-math.expm1(-10):.5f}.\n\n" + table(["rule", *(f"{10.0 ** -p:g} m" for p in range(6))], rows))


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--rays", type=int, default=1024, help="rays of jittered rules and of media with jumps")
    p.add_argument("--media", default="", help="keys, with commas (default: all): " + ", ".join(m.key for m in MEDIA))
    p.add_argument("--out", help="folder for tables.md")
    options = p.parse_args()
    media = [m for m in MEDIA if not options.media or m.key in options.media.split(",")]
    curves = {}
    for medium in media:
        print(medium.name, file=sys.stderr)
        for rule in RULES:
            for doubles in (True, False):
                curves[medium.key, rule.name, doubles] = measure(medium, rule, options.rays, doubles)
    text = "".join(medium_table(m, curves) for m in media) + stiff_table(options.rays) + thin_table(8 * options.rays)
    text = f"8 to 1024 samples, {options.rays} rays. Rules with * are not samplers of ours.\n" + text
    held = [h for (_, _, doubles), c in curves.items() if doubles for q in range(4) if (h := c.holds(q)) is not None]
    if options.out:
        write(f"{options.out}/tables.md", text)
    print(f"{text}\nquadrature: rules={len(RULES)} media={len(media)} order_ok={sum(held)}/{len(held)}")
    return 0 if all(held) else 1


if __name__ == "__main__":
    sys.exit(main())
