"use strict";
// Plots as SVG: axes with round ticks, several series, linear or logarithmic axes, error bars and bars.

// Text that html`` makes; what else is put into it is escaped.
class Html {
  constructor(text) { this.text = text; }
}
const kEscapes = {"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "'": "&#39;"};
const escaped = (part) => part instanceof Html ? part.text : Array.isArray(part) ? part.map(escaped).join("")
  : part === null || part === undefined || part === false ? "" : String(part).replace(/[&<>"']/g, (c) => kEscapes[c]);
/** Html; lists are put in one after the other, and nothing stands for null and false. */
const html = (strings, ...parts) => new Html(strings.reduce((all, one, i) => all + escaped(parts[i - 1]) + one));

/** A figure for people: `digits` significant digits, no exponent between 1e-4 and 1e6. */
function figure(value, digits = 4) {
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "NaN" : value > 0 ? "∞" : "−∞";
  const size = Math.abs(value), whole = size === 0 ? 1 : Math.floor(Math.log10(size)) + 1;
  const text = size !== 0 && (size < 1e-4 || size >= 1e6)
    ? value.toExponential(digits - 1).replace(/(e[+-])(\d)$/, (_, e, digit) => `${e}0${digit}`)
    : value.toFixed(Math.max(0, digits - whole));
  return text.replace(/^-/, "−");  // a minus sign, not a hyphen
}

// In pixels of the page where there is room for two plots; a phone gets smaller ones, whose texts are no smaller.
const kWidth = innerWidth < 640 ? 330 : 540, kHeight = innerWidth < 640 ? 230 : 290;
const kLeft = 54, kRight = 66, kTop = 14, kBottom = 46, kBase = kHeight - kBottom;
const kDashes = ["", "7 5", "2 5", "10 4 2 4"];
const px = (value) => value.toFixed(1);
const paint = (color) => `var(--s${color % 8})`;
const stroke = (color) => html`stroke="${paint(color)}" stroke-dasharray="${kDashes[color % 4]}"`;
const text_at = (x, y, anchor, text, more = "") =>
  html`<text x="${px(x)}" y="${px(y)}" text-anchor="${anchor}" ${more}>${text}</text>`;
const line = (x1, y1, x2, y2, more) =>
  html`<line x1="${px(x1)}" y1="${px(y1)}" x2="${px(x2)}" y2="${px(y2)}" ${more}/>`;
const line_sample = (color) =>
  html`<svg viewBox="0 0 34 10" aria-hidden="true">${line(1, 5, 33, 5, html`class="ln" ${stroke(color)}`)}</svg>`;

/** Round places that cover [low, high]: 1, 2 or 5 times a power of ten apart, about `wanted` of them. */
function linear_ticks(low, high, wanted) {
  const raw = Math.max(high - low, 1e-12) / wanted, power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((factor) => factor === 10 || factor * power >= raw * (1 - 1e-9));
  const ticks = [];
  for (let i = Math.floor(low / step + 1e-9); ticks.length < 100; ++i) {
    ticks.push(i * step);
    if (ticks.at(-1) >= high - 1e-9 * step) break;
  }
  return ticks;
}
/** Powers of ten in [low, high], with their 2- and 5-fold where that leaves fewer than three; else round numbers. */
function log_ticks(low, high) {
  const inside = (tick) => tick >= low * (1 - 1e-9) && tick <= high * (1 + 1e-9);
  const powers = [];
  for (let e = Math.floor(Math.log10(low)); e <= Math.ceil(Math.log10(high)); ++e) powers.push(10 ** e);
  const tens = powers.filter(inside), more = powers.flatMap((p) => [p, 2 * p, 5 * p]).filter(inside);
  if (tens.length >= 3) return tens;
  return more.length >= 2 ? more : linear_ticks(low, high, 3).filter((tick) => tick >= low && tick <= high);
}
const kSuperscripts = "⁰¹²³⁴⁵⁶⁷⁸⁹";
/** Texts of an axis's ticks, all in one notation: decimals, thousands or millions, or powers of ten. */
function tick_texts(ticks) {
  const sizes = ticks.filter((tick) => tick !== 0).map(Math.abs), least = Math.min(...sizes), most = Math.max(...sizes);
  const power = (v) => {
    const e = Math.floor(Math.log10(Math.abs(v)) + 1e-9), digits = [...String(Math.abs(e))].map((d) => kSuperscripts[d]);
    const factor = Number((v / 10 ** e).toFixed(2));
    return (factor === 1 ? "10" : `${factor}·10`) + (e < 0 ? "⁻" : "") + digits.join("");
  };
  const [unit, letter] = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""]].find(([size]) => most >= Math.max(1e4, size)) ??
    [1, ""];
  const is_wide = least < 1e-4 || most / least >= 1e5;
  return ticks.map((tick) => tick === 0 ? "0" : (is_wide ? power(tick) :
    Number((tick / unit).toPrecision(6)) + letter).replace("-", "−"));
}

/** At most `most` points: neighbours are averaged in equal groups. */
function thinned(points, most) {
  if (points.length <= most) return points;
  return Array.from({length: most}, (_, group) => {
    const some = points.slice(Math.floor(group * points.length / most), Math.floor((group + 1) * points.length / most));
    const mean = (key) => some.reduce((sum, point) => sum + point[key], 0) / some.length;
    return {x: mean("x"), y: mean("y")};
  });
}

/** Value to pixels between `from` and `to`. */
function axis(low, high, from, to, is_log) {
  const at = (v) => (is_log ? Math.log10(v) : v);
  return (value) => from + (at(value) - at(low)) / (at(high) - at(low)) * (to - from);
}
function scale_x({log_x, x_range}, values) {
  const least = Math.min(...values), most = Math.max(...values), room = most > least ? 1 : 2;
  if (log_x) return {low: least / room, high: most * room, ticks: log_ticks(least / room, most * room)};
  const [low, top] = x_range ?? [Math.min(0, least), most], high = top > low ? top : low + 1;
  const slack = 1e-9 * (high - low);
  return {low, high, ticks: linear_ticks(low, high, 5).filter((tick) => tick >= low - slack && tick <= high + slack)};
}
function scale_y({log_y, y_range}, values) {
  let [least, most] = [Math.min(...values), Math.max(...values)];
  if (log_y) return {low: least / 1.15, high: most * 1.15, ticks: log_ticks(least / 1.15, most * 1.15)};
  if (y_range) return {low: y_range[0], high: y_range[1], ticks: linear_ticks(...y_range, 5)};
  if (most - least < 1e-9 * Math.max(1, Math.abs(most))) [least, most] = [least - 0.5, most + 0.5];
  const ticks = linear_ticks(least, most, 5);
  return {low: ticks[0], high: ticks.at(-1), ticks};
}

const has_interval = ({low, high}) => Number.isFinite(low) && Number.isFinite(high);
/** "31.4 (30.9 to 31.8) at 120". */
function point_text(p, digits) {
  const interval = has_interval(p) ? ` (${figure(p.low, digits)} to ${figure(p.high, digits)})` : "";
  return `${figure(p.y, digits)}${interval} at ${figure(p.x, 3)}`;
}

function draw_series({markers, digits, log_y}, series, x, y) {
  const {name, color, points, end, reference} = series;
  const way = points.map((p) => `${px(x(p.x))},${px(y(p.y))}`).join(" ");
  if (reference) return html`<polyline class="rf" points="${way}"/>`;
  const whisker = (p) => {
    const at = x(p.x), low = log_y && p.low <= 0 ? kBase : y(p.low), high = y(p.high);
    const bar = html`class="eb" stroke="${paint(color)}"`;
    return [line(at, low, at, high, bar), line(at - 4, low, at + 4, low, bar), line(at - 4, high, at + 4, high, bar)];
  };
  const dot = (p, r) => html`<circle cx="${px(x(p.x))}" cy="${px(y(p.y))}" r="${r}" fill="${paint(color)}"
><title>${name}: ${point_text(p, digits)}</title></circle>`;
  const dots = points.map((p, i) => [has_interval(p) && whisker(p),
    (markers || i + 1 === points.length) && dot(p, points.length === 1 ? 5 : 3)]);
  return [way && !series.loose && html`<polyline class="ln" ${stroke(color)} points="${way}"/>`, dots, end && dot(end, 5)];
}
const draw_bars = ({color, bars = []}, x, y) => bars.map(({from, to, height, text}) => html`<rect class="br"
x="${px(x(from) + 1)}" y="${px(y(height))}" width="${px(Math.max(0, x(to) - x(from) - 2))}"
height="${px(Math.max(0, kBase - y(height)))}" fill="${paint(color)}"><title>${text}</title></rect>`);

/** The last value of each series at its end, moved apart so that none covers another. */
function end_labels(series, digits, x, y) {
  const labels = series.filter(({points, reference}) => points.length && !reference).map(({points, end, color}) => {
    const last = end || points.at(-1);
    return {at: y(last.y), x: x(last.x), text: figure(last.y, digits), color};
  }).sort((a, b) => a.at - b.at);
  labels.forEach((label, i) => {
    const before = labels[i - 1];
    if (before && Math.abs(label.x - before.x) < 48) label.at = Math.max(label.at, before.at + 15);
  });
  return labels.map(({x, at, text, color}) =>
    text_at(x + 8, at + 4, "start", text, html`class="end" style="fill:${paint(color)}"`));
}

/**
 * spec: {title, x_label, log_x, log_y: points at or below 0 are left out then, markers: a dot at each point, digits,
 * end_values, x_range, y_range: of a linear axis, series: {name, color: 0 to 7, points: {x, y, low, high},
 * bars: {from, to, height, text}, end: a point apart from the line, whose value stands at its end,
 * reference: a thin line to compare with, loose: dots without a line}}. Points that are not finite are not drawn.
 */
function plot(spec) {
  const {title, x_label, log_x, log_y, digits = 3, end_values = true} = spec;
  const drawn = spec.series.map((one) => ({...one, points: one.points.filter(({x, y}) =>
    Number.isFinite(x) && Number.isFinite(y) && (!log_y || y > 0) && (!log_x || x > 0))}));
  const told = spec.series.filter(({points, reference}) => points.length && !reference)
                 .map(({name, points, end}) => ` ${name}: from ${point_text(points[0], digits)} to ${
                        point_text(end || points.at(-1), digits)}.`);
  const ends = (p) => has_interval(p) ? [p.high, p.low].filter((v) => !log_y || v > 0) : [];
  const all_of = ({points, end}) => (end ? [...points, end] : points);
  const xs = drawn.flatMap((one) => [...all_of(one).map((p) => p.x), ...(one.bars ?? []).flatMap((bar) => [bar.from,
    bar.to])]);
  const ys = drawn.flatMap((one) => [...all_of(one).flatMap((p) => [p.y, ...ends(p)]),
    ...(one.bars ?? []).flatMap((bar) => (log_y ? [bar.height] : [bar.height, 0]))]);
  const inside = () => {
    if (ys.length === 0) return text_at(kWidth / 2, kHeight / 2, "middle", "no data");
    const of_x = scale_x(spec, xs), of_y = scale_y(spec, ys), right = kWidth - kRight;
    const x = axis(of_x.low, of_x.high, kLeft, right, log_x), y = axis(of_y.low, of_y.high, kBase, kTop, log_y);
    const [x_texts, y_texts] = [of_x.ticks, of_y.ticks].map(tick_texts);
    return [of_y.ticks.map((tick, i) => [line(kLeft, y(tick), right, y(tick), html`class="g"`),
      text_at(kLeft - 8, y(tick) + 4, "end", y_texts[i])]),
    of_x.ticks.map((tick, i) => [line(x(tick), kBase, x(tick), kBase + 5, html`class="ax"`),
      text_at(x(tick), kBase + 19, "middle", x_texts[i])]),
    line(kLeft, kBase, right, kBase, html`class="ax"`), text_at((kLeft + right) / 2, kHeight - 6, "middle", x_label),
    drawn.map((one) => draw_bars(one, x, y)), drawn.map((one) => draw_series({...spec, digits}, one, x, y)),
    end_values && end_labels(drawn, digits, x, y)];
  };
  return html`<svg viewBox="0 0 ${kWidth} ${kHeight}" role="img" aria-label="${title} over ${x_label}.${told}">${
    inside()}</svg>`;
}
