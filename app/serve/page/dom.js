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

// Colours: of classes, what stands out on them, and the colour map of entropy.

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

const mixed = (rgb, other, share) => rgb.map((v) => Math.round(v + (other - v) * share));
// Where the palette is used up: its colours darker and lighter.
const kShades = [...kPalette.map((rgb) => mixed(rgb, 0, 0.45)), ...kPalette.map((rgb) => mixed(rgb, 255, 0.5))];
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

const kStops = [[18, 20, 40], [66, 30, 110], [150, 45, 110], [225, 90, 70], [250, 165, 60], [255, 245, 175]];

/// [256][3]: entropy 0 to the largest.
export const kEntropyColors = Array.from({length: 256}, (_, i) => {
  const at = (i / 255) * (kStops.length - 1);
  const k = Math.min(kStops.length - 2, Math.floor(at));
  return kStops[k].map((v, c) => Math.round(v + (kStops[k + 1][c] - v) * (at - k)));
});

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
