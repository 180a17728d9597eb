// Small helpers for elements, colours and the browser's store.

export const byId = (id) => document.getElementById(id);

/// make('button', {class: 'main', title: 'x', onclick: f}, 'text', child...)
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== false) element.setAttribute(name, value === true ? '' : value);
  }
  element.append(...children);
  return element;
}

export function setPressed(isOn) {
  for (const [id, on] of Object.entries(isOn)) setAttribute(byId(id), 'aria-pressed', on);
}
/// children(): what the element holds from now on, made again only where `told`, of which it is made, is another.
export function refill(element, told, children) {
  const key = JSON.stringify(told);
  if (element.told === key) return;
  element.told = key;
  element.replaceChildren(...children());
}

export const onClick = (id, act) => byId(id).addEventListener('click', act);

/// A small square of a colour.
export function swatch(color) {
  const square = make('span', {class: 'swatch'});
  square.style.setProperty('--color', cssColor(color));
  return square;
}

/// Has the browser save a file.
export function saveAs(name, blob) {
  const link = make('a', {href: URL.createObjectURL(blob), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/// Sets what is shown only where it is another, so that nothing flickers and nobody's selection is lost.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
export function setAttribute(element, name, value) {
  if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value);
}
export function setStyle(element, name, value) {
  if (element.style.getPropertyValue(name) !== value) element.style.setProperty(name, value);
}

// Colours: of classes, what stands out on them, and the ramp of entropy and depth.

export const cssColor = ([r, g, b]) => `rgb(${r} ${g} ${b})`;
export const hexColor = (rgb) => '#' + rgb.map((v) => v.toString(16).padStart(2, '0')).join('');
export const rgbOfHex = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));

/// Colours that a new class may take, far apart from each other.
export const kPalette = [
  [230, 75, 70], [70, 150, 240], [75, 190, 95], [245, 190, 50], [165, 100, 225], [250, 135, 60],
  [55, 200, 200], [240, 120, 185], [150, 105, 65], [165, 205, 60], [100, 110, 200], [215, 60, 175],
  [130, 30, 60], [20, 110, 110], [240, 205, 165], [95, 115, 50],
];

function oklab(rgb) {
  const [r, g, b] = rgb.map((v) => (v / 255 <= 0.04045 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4));
  const l = Math.cbrt(0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b);
  const m = Math.cbrt(0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b);
  const s = Math.cbrt(0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b);
  return [0.2104542553 * l + 0.793617785 * m - 0.0040720468 * s, 1.9779984951 * l - 2.428592205 * m + 0.4505937099 * s,
          0.0259040371 * l + 0.7827717662 * m - 0.808675766 * s];
}

/// Hues are told apart better than shades over a photograph, so lightness counts half.
const hue = (rgb) => oklab(rgb).map((v, i) => (i ? v : v / 2));

const mixed = (rgb, other, share) => rgb.map((v, i) => Math.round(v + (other[i] - v) * share));
// Where the palette is used up: its colours darker and lighter.
const kShades = [...kPalette.map((rgb) => mixed(rgb, [0, 0, 0], 0.45)), ...kPalette.map((rgb) => mixed(rgb, [255, 255, 255], 0.5))];
const kApart = 0.03;

/// The colour of the palette that is farthest from all that are used, or a shade of one where all are taken.
export function freeColor(used) {
  const labs = used.map(hue);
  const farthest = (colors) => {
    const found = colors.map((rgb) => Math.min(1, ...labs.map((other) => Math.hypot(...hue(rgb).map((v, i) => v - other[i])))));
    const most = Math.max(...found);
    return [most, colors[found.indexOf(most)]];
  };
  const [most, best] = farthest(kPalette);
  return most > kApart ? best : farthest(kShades)[1];
}

/// Black or white, whichever is easier to read on the colour.
export const inkOn = (rgb) => (oklab(rgb)[0] > 0.62 ? '#111' : '#fff');

const kStops = [
  [41, 5, 60], [45, 28, 83], [45, 49, 104], [41, 71, 122], [33, 94, 137], [19, 117, 149], [7, 139, 156],
  [27, 162, 160], [61, 183, 159], [100, 203, 152], [145, 221, 141], [193, 236, 126], [245, 248, 109],
];

/// [256][3]: from low to high; at most 4 off from the pictures that the program makes (perceptual_color in eval/image_output.h).
export const kRamp = Array.from({length: 256}, (_, i) => {
  const at = (i / 255) * (kStops.length - 1);
  const k = Math.min(kStops.length - 2, Math.floor(at));
  return mixed(kStops[k], kStops[k + 1], at - k);
});
document.documentElement.style.setProperty('--ramp', `linear-gradient(90deg, ${kStops.map(cssColor).join(', ')})`);

/// What the colours of the ramp mean: [low, high]; null: the picture has none of them.
export function showLegend(ends) {
  const legend = byId('legend');
  legend.hidden = !ends;
  if (ends) [legend.firstElementChild, legend.lastElementChild].forEach((end, i) => setText(end, ends[i]));
}

/// What is kept in a store, or `otherwise` where nothing is, or something that is not ours to read.
export function stored(storage, key, otherwise) {
  try {
    return JSON.parse(storage.getItem(key)) ?? otherwise;
  } catch {
    return otherwise;
  }
}

export function store(storage, key, value) {
  try {
    storage.setItem(key, JSON.stringify(value));
  } catch { /* full: it is forgotten at a reload */ }
}

/// A store that works where the browser keeps nothing (private windows): then a reload forgets, and nothing else changes.
export function safeStorage(kind) {
  try {
    const store = window[kind];
    store.setItem('semfield.probe', '1');
    store.removeItem('semfield.probe');
    return store;
  } catch {
    const values = new Map();
    return {
      get length() { return values.size; },
      key: (i) => [...values.keys()][i] ?? null,
      getItem: (key) => values.get(key) ?? null,
      setItem: (key, value) => values.set(key, String(value)),
      removeItem: (key) => values.delete(key),
    };
  }
}
