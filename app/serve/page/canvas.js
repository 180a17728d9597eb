// The canvas in the middle: picture, overlay, marks of clicks, the proposal's ring and the brush.
import {cssColor, inkOn} from './colors.js';
import {fitted, toImage, toScreen} from './viewport.js';

const kMostLayer_px = 2e6;  // the overlay is drawn at every move of the pointer

/// Paints what a click or stroke covers: discs along its points, a pixel alone when the radius is 0.
export function paintClick(context, points, radius, color) {
  context.fillStyle = context.strokeStyle = cssColor(color);
  context.lineCap = context.lineJoin = 'round';
  if (radius < 0.5) {
    for (const [x, y] of points) context.fillRect(Math.floor(x), Math.floor(y), 1, 1);
    if (points.length < 2) return;
  }
  context.lineWidth = Math.max(1, 2 * radius);
  context.beginPath();
  if (points.length === 1) {
    context.arc(points[0][0], points[0][1], radius, 0, 2 * Math.PI);
    context.fill();
    return;
  }
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

/// A path drawn in `color` between a light and a dark line, so that it shows on every picture.
function outlined(context, width, color, path) {
  for (const [extra, style] of [[4, 'rgb(0 0 0 / 0.75)'], [2, '#fff'], [0, color]]) {
    context.lineWidth = width + extra;
    context.strokeStyle = style;
    context.beginPath();
    path();
    context.stroke();
  }
}

export class ViewCanvas {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
    this.layer = new OffscreenCanvas(1, 1);
    this.share = 1;  // of the image's size
    this.layerContext = this.layer.getContext('2d', {willReadFrequently: true});
    this.screen = {width: 1, height: 1};
    this.image = {width: 1, height: 1};
    this.port = fitted(this.image, this.screen);
    this.isFitted = true;
  }

  /// Follows the element's size; true when it changed.
  resize() {
    const {clientWidth: width, clientHeight: height} = this.canvas;
    const ratio = window.devicePixelRatio || 1;
    if (width === this.screen.width && height === this.screen.height && ratio === this.ratio) return false;
    this.ratio = ratio;
    this.screen = {width, height};
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    if (this.isFitted) this.fit();
    return true;
  }

  fit() {
    this.port = fitted(this.image, this.screen);
    this.isFitted = true;
  }

  look(port) {
    this.port = port;
    this.isFitted = port.scale <= fitted(this.image, this.screen).scale * 1.001;
  }

  /// The image's size; another one is fitted.
  setImage(width, height) {
    if (this.image.width === width && this.image.height === height) return;
    this.image = {width, height};
    this.fit();
  }

  /// Labels (or entropy) of the view at its own size, a very large one smaller; clicks that they do not know painted over.
  paintLayer(overlay, paints) {
    const {width, height} = this.image;
    this.share = Math.min(1, Math.sqrt(kMostLayer_px / (width * height)));
    const size = {width: Math.ceil(width * this.share), height: Math.ceil(height * this.share)};
    if (this.layer.width !== size.width || this.layer.height !== size.height) Object.assign(this.layer, size);
    const context = this.layerContext;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.imageSmoothingEnabled = false;
    context.clearRect(0, 0, size.width, size.height);
    context.scale(this.share, this.share);
    if (overlay) context.drawImage(overlay, 0, 0, width, height);
    for (const {points, radius, color} of paints) paintClick(context, points, radius, color);
  }

  /// Leaves `alpha` of 255 to every pixel that is not of the colour.
  dimOthers(color, alpha) {
    const image = this.layerContext.getImageData(0, 0, this.layer.width, this.layer.height);
    const {data} = image;
    for (let i = 0; i < data.length; i += 4) {
      if (data[i + 3] && (data[i] !== color[0] || data[i + 1] !== color[1] || data[i + 2] !== color[2])) data[i + 3] = alpha;
    }
    this.layerContext.putImageData(image, 0, 0);
  }

  /// [r, g, b] of the layer at a pixel, or null where nothing is.
  layerColor(x, y) {
    const [r, g, b, a] = this.layerContext.getImageData(Math.floor(x * this.share), Math.floor(y * this.share), 1, 1).data;
    return a ? [r, g, b] : null;
  }

  /// what: {isSmooth: never show the picture's pixels, picture, opacity, marks, showNames, ring, brush: {x, y, radius, color}, cross: [x, y], stroke}
  draw(what) {
    const {context, port, image} = this;
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.clearRect(0, 0, this.screen.width, this.screen.height);
    const place = [port.x, port.y, image.width * port.scale, image.height * port.scale];
    context.fillStyle = '#0c0d0f';
    context.fillRect(...place);
    context.imageSmoothingEnabled = port.scale < 6 || what.isSmooth;
    context.imageSmoothingQuality = 'high';
    if (what.picture) context.drawImage(what.picture, ...place);
    context.imageSmoothingEnabled = false;
    context.globalAlpha = what.opacity;
    if (what.opacity > 0) context.drawImage(this.layer, ...place);
    context.globalAlpha = 1;
    if (what.stroke) this.drawStroke(what.stroke);
    for (const mark of what.marks) this.drawMark(mark, what.showNames || mark === what.hovered);
    if (what.ring) this.drawRing(what.ring);
    if (what.cross) this.drawCross(what.cross);
    if (what.brush) this.drawBrush(what.brush);
  }

  inImage(path) {
    const {context, port} = this;
    context.save();
    context.translate(port.x, port.y);
    context.scale(port.scale, port.scale);
    path(context);
    context.restore();
  }

  drawStroke({points, radius, color}) {
    this.context.globalAlpha = 0.75;
    this.inImage((context) => paintClick(context, points, radius, color));
    this.context.globalAlpha = 1;
  }

  drawMark({points, color, name, saved}, showName) {
    const {context} = this;
    const at = points.map(([x, y]) => toScreen(this.port, x, y));
    if (at.length > 1) {
      context.lineCap = context.lineJoin = 'round';
      outlined(context, 1.5, cssColor(color), () => at.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y))));
    }
    const [x, y] = at[0];
    context.setLineDash([]);
    for (const [radius, style] of [[6.5, 'rgb(0 0 0 / 0.8)'], [5.5, '#fff'], [4, cssColor(color)]]) {
      context.fillStyle = style;
      context.beginPath();
      context.arc(x, y, radius, 0, 2 * Math.PI);
      context.fill();
    }
    if (!saved) {  // a broken ring until the program has it
      context.setLineDash([3, 3]);
      context.lineWidth = 1.5;
      context.strokeStyle = '#fff';
      context.beginPath();
      context.arc(x, y, 9.5, 0, 2 * Math.PI);
      context.stroke();
      context.setLineDash([]);
    }
    if (showName && name) this.drawName(name, color, x, y);
  }

  drawName(name, color, x, y) {
    const {context} = this;
    context.font = '600 11px system-ui, sans-serif';
    context.textBaseline = 'middle';
    const width = context.measureText(name).width + 10;
    const left = Math.max(2, Math.min(x + 10, this.screen.width - width - 2));
    const top = Math.max(2, y - 8);
    context.fillStyle = cssColor(color);
    context.strokeStyle = 'rgb(0 0 0 / 0.8)';
    context.lineWidth = 2;
    context.beginPath();
    context.roundRect(left, top, width, 16, 4);
    context.stroke();
    context.fill();
    context.fillStyle = inkOn(color);
    context.fillText(name, left + 5, top + 8.5);
  }

  drawRing([x, y]) {
    const {context} = this;
    const [cx, cy] = toScreen(this.port, x, y);
    outlined(context, 2.5, '#ffd54a', () => context.arc(cx, cy, 16, 0, 2 * Math.PI));
    outlined(context, 2, '#ffd54a', () => {
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(cx + dx * 21, cy + dy * 21);
        context.lineTo(cx + dx * 27, cy + dy * 27);
      }
    });
  }

  drawCross([x, y]) {
    const {context} = this;
    const [cx, cy] = toScreen(this.port, x, y);
    outlined(context, 1, '#111', () => {
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(cx + dx * 4, cy + dy * 4);
        context.lineTo(cx + dx * 14, cy + dy * 14);
      }
    });
  }

  drawBrush({x, y, radius, color}) {
    const {context} = this;
    const [cx, cy] = toScreen(this.port, x, y);
    const r = Math.max(radius * this.port.scale, 3);
    outlined(context, 1, cssColor(color), () => context.arc(cx, cy, r, 0, 2 * Math.PI));
  }

  imageAt(x, y) { return toImage(this.port, x, y); }
}
