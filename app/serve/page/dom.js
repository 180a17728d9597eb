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

/// What is said to a person with a mouse and keys, or to one with fingers alone.
export const byHand = (mouse, fingers) => (matchMedia('(pointer: coarse)').matches ? fingers : mouse);

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

/// Colours that a new class may take, seen on a white wall (told() 0.19 from it or more). Found one by one in a grid of colours with a hue, each as the
/// farthest from those before it for the worst of three eyes, with all cones, without red and without green ones: the nearest two are 0.085 apart.
export const kPalette = [
  [0, 120, 210], [255, 180, 0], [225, 105, 0], [120, 0, 15], [120, 180, 255], [75, 30, 135], [165, 75, 105], [0, 180, 150],
  [0, 0, 225], [195, 60, 0], [0, 150, 180], [30, 150, 255], [120, 45, 90], [90, 75, 150], [150, 45, 45], [255, 120, 105],
];

const linear = (rgb) => rgb.map((v) => (v / 255 <= 0.04045 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4));
const times = (rows, v) => rows.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);

function oklab(light) {
  const lms = times([[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566], [0.0883024619, 0.2817188376, 0.6299787005]], light);
  return times([[0.2104542553, 0.793617785, -0.0040720468], [1.9779984951, -2.428592205, 0.4505937099], [0.0259040371, 0.7827717662, -0.808675766]], lms.map(Math.cbrt));
}

// What eyes without red and without green cones see of linear light [Machado09, severity 1].
const kEyes = [
  [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
  [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
  [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
];
const seenBy = (rgb) => kEyes.map((eye) => oklab(times(eye, linear(rgb)).map((v) => Math.min(1, Math.max(0, v)))));

/// How well every eye tells two colours apart.
export function told(one, other) {
  const [a, b] = [seenBy(one), seenBy(other)];
  return Math.min(...a.map((lab, eye) => Math.hypot(...lab.map((v, i) => v - b[eye][i]))));
}

const mixed = (rgb, other, share) => rgb.map((v, i) => Math.round(v + (other[i] - v) * share));
// Where the palette is used up: its colours darker and lighter.
const kShades = [...kPalette.map((rgb) => mixed(rgb, [0, 0, 0], 0.4)), ...kPalette.map((rgb) => mixed(rgb, [255, 255, 255], 0.35))];
const kApart = 0.06;

/// The colour of the palette that is farthest from all that are used, or a shade of one where all are taken.
export function freeColor(used) {
  const farthest = (colors) => {
    const found = colors.map((rgb) => Math.min(1, ...used.map((other) => told(rgb, other))));
    const most = Math.max(...found);
    return [most, colors[found.indexOf(most)]];
  };
  const [most, best] = farthest(kPalette);
  return most > kApart ? best : farthest(kShades)[1];
}

const kWall = [235, 235, 230];

/// The colour, or where it is too pale for a white wall, as tables have it for walls, a deeper one of its hue.
export function seenOnWhite(rgb) {
  if (told(rgb, kWall) > 0.19) return rgb;
  const most = Math.max(...rgb);
  const deeper = rgb.map((v) => Math.round(0.85 * Math.max(0, most - 2.5 * (most - v))));
  return told(deeper, kWall) > 0.19 ? deeper : mixed(deeper, [0, 0, 0], 0.3);
}

/// Black or white, whichever is easier to read on the colour.
export const inkOn = (rgb) => (oklab(linear(rgb))[0] > 0.62 ? '#111' : '#fff');

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
