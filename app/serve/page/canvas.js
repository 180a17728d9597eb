// The canvas of a view: where the image lies on it, and what is drawn there. Knows nothing of the program.
import {toImage, toScreen} from './camera.js';
import {cssColor, inkOn} from './dom.js';

// The canvas in the middle: picture, overlay, marks of clicks, the proposal's ring and the brush.

const kMostLayer_px = 2e6;  // the overlay is drawn at every move of the pointer

/// Adds lines from (x0, y0) to (x1, y1) to the path.
function lines(context, ends) {
  for (const [x0, y0, x1, y1] of ends) {
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
  }
}

const packed = ([r, g, b]) => (0xff000000 | b << 16 | g << 8 | r) >>> 0;  // as an opaque pixel of a picture lies in memory

let hatch = null;

/// Stripes for what is ignored, as wide at every zoom; `scale`: of the context.
function hatchOf(context, scale) {
  if (!hatch) {
    hatch = new OffscreenCanvas(8, 8);
    const stripes = hatch.getContext('2d');
    stripes.fillStyle = 'rgb(40 40 44)';
    stripes.fillRect(0, 0, 8, 8);
    for (const at of [-8, 0, 8]) stroked(stripes, 2.5, 'rgb(190 190 190)', () => lines(stripes, [[at - 2, 10, at + 10, -2]]));
  }
  const pattern = context.createPattern(hatch, 'repeat');
  pattern.setTransform(new DOMMatrix().scale(1 / scale));
  return pattern;
}

/// Paints what a mark covers: discs along its points, a pixel alone when the radius is 0, the inside of an outline.
export function paintClick(context, {points, radius, color, fill}, style = cssColor(color)) {
  context.fillStyle = context.strokeStyle = style;
  context.lineCap = context.lineJoin = 'round';
  const trace = () => points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (fill) {
    context.beginPath();
    trace();
    context.fill('evenodd');
    return;
  }
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
  trace();
  context.stroke();
}

function stroked(context, width, style, path) {
  Object.assign(context, {lineWidth: width, strokeStyle: style});
  context.beginPath();
  path();
  context.stroke();
}

/// A path drawn in `color` between a light and a dark line, so that it shows on every picture.
function outlined(context, width, color, path) {
  for (const [extra, style] of [[4, 'rgb(0 0 0 / 0.75)'], [2, '#fff'], [0, color]]) stroked(context, width + extra, style, path);
}

export class ViewCanvas {
  /// camera: a PictureCamera.
  constructor(canvas, camera) {
    Object.assign(this, {camera, context: canvas.getContext('2d')});
    this.layer = new OffscreenCanvas(1, 1);
    this.borders = new Path2D();
    this.share = 1;  // of the image's size
    this.layerContext = this.layer.getContext('2d', {willReadFrequently: true});
  }

  get port() { return this.camera.port; }
  get image() { return this.camera.image; }
  get screen() { return this.camera.screen; }

  /// Labels (or entropy) at their own size, at least that of the view, a very large one smaller; clicks that they do not know painted over.
  /// `shown`: the colours in place of those that the labels have, as pairs [given, shown].
  paintLayer(overlay, paints, shown = []) {
    const {width, height} = this.image;
    this.share = Math.min(Math.max(1, (overlay?.width ?? 0) / width), Math.sqrt(kMostLayer_px / (width * height)));
    const size = {width: Math.ceil(width * this.share), height: Math.ceil(height * this.share)};
    if (this.layer.width !== size.width || this.layer.height !== size.height) Object.assign(this.layer, size);
    const context = this.layerContext;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.imageSmoothingEnabled = false;
    context.clearRect(0, 0, size.width, size.height);
    context.scale(this.share, this.share);
    if (overlay) context.drawImage(overlay, 0, 0, width, height);
    this.recolor(shown);
    for (const mark of paints) {
      context.globalCompositeOperation = mark.isIgnore ? 'destination-out' : 'source-over';
      paintClick(context, mark);
    }
    context.globalCompositeOperation = 'source-over';
  }

  /// change(pixels as 0xAABBGGRR, width) of the layer; what it returns says whether it wrote any.
  withPixels(change) {
    const {width, height} = this.layer;
    const image = this.layerContext.getImageData(0, 0, width, height);
    if (change(new Uint32Array(image.data.buffer), width)) this.layerContext.putImageData(image, 0, 0);
  }

  recolor(shown) {
    const table = new Map(shown.map((pair) => pair.map(packed)));
    if (table.size === 0) return;
    this.withPixels((pixels) => {
      for (let i = 0; i < pixels.length; ++i) pixels[i] = table.get(pixels[i]) ?? pixels[i];
      return true;
    });
  }

  /// Where the layer's colours meet, as a path in its pixels: lines between classes; with `isEmpty` there are none.
  traceBorders(isEmpty) {
    this.borders = new Path2D();
    this.lines = null;
    if (isEmpty) return;
    const path = this.borders;
    this.withPixels((pixels, width) => {
      const height = pixels.length / width;
      const follow = (lanes, length, differs, add) => {  // runs of borders along a lane are one line
        for (let lane = 1; lane < lanes; ++lane) {
          for (let at = 0; at < length; ++at) {
            const from = at;
            while (at < length && differs(lane, at)) ++at;
            if (at > from) add(lane, from, at);
          }
        }
      };
      follow(height, width, (y, x) => pixels[y * width + x] !== pixels[(y - 1) * width + x], (y, from, to) => { path.moveTo(from, y); path.lineTo(to, y); });
      follow(width, height, (x, y) => pixels[y * width + x] !== pixels[y * width + x - 1], (x, from, to) => { path.moveTo(x, from); path.lineTo(x, to); });
      return false;
    });
  }

  /// The lines between classes over the screen: a light one, one or two device pixels thin, within a dark one. Kept while the view stands.
  drawBorders() {
    const {port, screen, share} = this;
    const key = [port.x, port.y, port.scale, screen.width, screen.height, screen.ratio].join();
    if (this.lines?.key !== key) {
      const canvas = new OffscreenCanvas(Math.max(1, screen.width * screen.ratio), Math.max(1, screen.height * screen.ratio));
      const context = canvas.getContext('2d');
      const scale = port.scale * screen.ratio / share;
      context.setTransform(scale, 0, 0, scale, port.x * screen.ratio, port.y * screen.ratio);
      for (const [wide, style] of [[2.6, 'rgb(0 0 0 / 0.7)'], [1, 'rgb(255 255 255 / 0.9)']]) {
        Object.assign(context, {lineWidth: wide / scale, strokeStyle: style, lineCap: 'square'});
        context.stroke(this.borders);
      }
      this.lines = {key, canvas};
    }
    this.context.drawImage(this.lines.canvas, 0, 0, screen.width, screen.height);
  }

  /// Leaves `alpha` of 255 to every pixel that is not of the colour.
  dimOthers(color, alpha) {
    const own = packed(color);
    this.withPixels((pixels) => {
      for (let i = 0; i < pixels.length; ++i) if (pixels[i] >>> 24 && pixels[i] !== own) pixels[i] = (pixels[i] & 0xffffff | alpha << 24) >>> 0;
      return true;
    });
  }

  /// [r, g, b] of the layer at a pixel, or null where nothing is.
  layerColor(x, y) {
    const [r, g, b, a] = this.layerContext.getImageData(Math.floor(x * this.share), Math.floor(y * this.share), 1, 1).data;
    return a ? [r, g, b] : null;
  }

  /// The part of a picture of the whole image that is on the screen, drawn there: a photograph may have many megapixels.
  drawPicture(picture) {
    const {context, port, image, screen} = this;
    const share = picture.width / image.width;
    const [left, top] = toImage(port, 0, 0).map((v) => Math.max(0, Math.floor(v)));
    const [right, bottom] = toImage(port, screen.width, screen.height).map(Math.ceil);
    const [width, height] = [Math.min(right, image.width) - left, Math.min(bottom, image.height) - top];
    if (width <= 0 || height <= 0) return;
    const [x, y] = toScreen(port, left, top);
    context.imageSmoothingEnabled = port.scale / share < 6;
    context.imageSmoothingQuality = 'high';
    const tall = picture.height / image.height;
    context.drawImage(picture, left * share, top * tall, width * share, height * tall, x, y, width * port.scale, height * port.scale);
  }

  /// what: {picture, opacity, marks, others: clicks of other views, selected and hovered mark,
  /// showNames, ring, brush: {x, y, radius, color}, cross: [x, y], stroke, outline: {points, color, tip}, thing: of thing.js}
  draw(what) {
    const {context, port, image} = this;
    context.setTransform(this.screen.ratio, 0, 0, this.screen.ratio, 0, 0);
    context.clearRect(0, 0, this.screen.width, this.screen.height);
    const place = [port.x, port.y, image.width * port.scale, image.height * port.scale];
    context.fillStyle = '#0c0d0f';
    context.fillRect(...place);
    if (what.picture) this.drawPicture(what.picture);
    context.globalAlpha = Math.max(what.opacity, 0.3);
    for (const mark of what.marks) if (mark.isIgnore) this.inImage(() => paintClick(context, mark, hatchOf(context, port.scale)));
    context.imageSmoothingEnabled = true;  // edges of labels without steps where a pixel that trains is large
    context.globalAlpha = what.opacity;
    if (what.opacity > 0) context.drawImage(this.layer, ...place);
    if (what.opacity > 0) this.drawBorders();
    context.globalAlpha = 1;
    if (what.thing) this.drawThing(what.thing);
    if (what.stroke) this.drawStroke(what.stroke);
    for (const mark of what.others) this.drawOther(mark, what.showNames || mark === what.hovered);
    for (const mark of what.marks) this.drawMark(mark, what.showNames || mark === what.hovered, mark === what.selected, what.doomed?.has(mark.id));
    if (what.outline) this.drawOutline(what.outline);
    if (what.ring) this.drawRing(what.ring);
    if (what.cross) this.drawTicks(...toScreen(port, ...what.cross), 4, 14, 1, '#111');
    if (what.brush) {
      const {x, y, radius, color} = what.brush;
      outlined(context, 1, cssColor(color), () => context.arc(...toScreen(port, x, y), Math.max(radius * port.scale, 3), 0, 2 * Math.PI));
    }
  }

  inImage(path) {
    const {context, port} = this;
    context.save();
    context.translate(port.x, port.y);
    context.scale(port.scale, port.scale);
    path(context);
    context.restore();
  }

  /// A thing that is found: faint where a click would label it, and with a clear outline where it is held.
  drawThing({outlines, sides, color, isFaint, isHeld, stroke}) {
    const {context, port} = this;
    context.globalAlpha = isFaint ? 0.22 : 0.4;
    context.fillStyle = cssColor(color);
    context.beginPath();
    for (const outline of outlines) this.trace(outline, true);
    context.fill('evenodd');
    context.globalAlpha = isFaint ? 0.6 : 1;
    context.lineCap = 'round';
    const path = () => lines(context, sides.map(([a, b]) => [...toScreen(port, ...a), ...toScreen(port, ...b)]));
    if (isFaint) stroked(context, 1, '#fff', path);
    else outlined(context, isHeld ? 2 : 1, isHeld ? '#ffd54a' : cssColor(color), path);
    context.globalAlpha = 1;
    if (stroke?.length > 1) outlined(context, 2, '#fff', () => this.trace(stroke, false));
  }

  drawStroke(stroke) {
    this.context.globalAlpha = 0.75;
    this.inImage((context) => paintClick(context, stroke, stroke.isIgnore ? hatchOf(context, this.port.scale) : cssColor(stroke.color)));
    this.context.globalAlpha = 1;
  }

  /// Closed or open line through points of the image, on the screen.
  trace(points, isClosed) {
    const {context} = this;
    points.forEach((point, i) => context[i ? 'lineTo' : 'moveTo'](...toScreen(this.port, ...point)));
    if (isClosed) context.closePath();
  }

  drawDot(x, y, sizes) {
    const {context} = this;
    for (const [radius, style] of sizes) {
      context.fillStyle = style;
      context.beginPath();
      context.arc(x, y, radius, 0, 2 * Math.PI);
      context.fill();
    }
  }

  /// A polygon that is being drawn, up to the pointer.
  drawOutline({points, color, tip, closes}) {
    const {context} = this;
    context.lineJoin = 'round';
    const line = tip ? [...points, tip] : points;
    context.globalAlpha = 0.3;
    context.fillStyle = cssColor(color);
    context.beginPath();
    this.trace(line, true);
    context.fill();
    context.globalAlpha = 1;
    outlined(context, 1.5, cssColor(color), () => this.trace(line, false));
    points.forEach((point, i) => this.drawDot(...toScreen(this.port, ...point), i === 0 && closes ? [[9, '#000c'], [8, '#fff'], [6, cssColor(color)]] : [[5, '#000c'], [4, '#fff']]));
  }

  /// A click of another view, where the surface that it named is seen.
  drawOther({points, color, label}, showName) {
    const {context} = this;
    context.globalAlpha = 0.75;
    for (const point of points) this.drawDot(...toScreen(this.port, ...point), [[5, 'rgb(0 0 0 / 0.6)'], [4, 'rgb(255 255 255 / 0.8)'], [2.8, cssColor(color)]]);
    context.globalAlpha = 1;
    if (showName) this.drawName(label, color, ...toScreen(this.port, ...points[0]));
  }

  drawMark({points, color, label, fill, isIgnore, saved}, showName, isSelected, isDoomed) {
    const {context} = this;
    if (points.length > 1) {
      context.lineCap = context.lineJoin = 'round';
      outlined(context, 1.5, cssColor(color), () => this.trace(points, fill));
    }
    const [x, y] = toScreen(this.port, ...points[0]);
    context.setLineDash([]);
    if (isSelected || isDoomed) {
      outlined(context, 2, isDoomed ? '#ff6b5e' : '#8ab4f8', () => context.arc(x, y, 11, 0, 2 * Math.PI));
    }
    this.drawDot(x, y, [[6.5, 'rgb(0 0 0 / 0.8)'], [5.5, '#fff'], [4, cssColor(color)]]);
    const cross = [[x - 3, y - 3, x + 3, y + 3], [x + 3, y - 3, x - 3, y + 3]];
    if (isIgnore || isDoomed) stroked(context, 2, isDoomed ? '#ff3b30' : '#111', () => lines(context, cross.slice(0, isDoomed ? 2 : 1)));
    if (!saved) {  // a broken ring until the program has it
      context.setLineDash([3, 3]);
      stroked(context, 1.5, '#fff', () => context.arc(x, y, 9.5, 0, 2 * Math.PI));
      context.setLineDash([]);
    }
    if (showName && label) this.drawName(label, color, x, y);
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

  /// Four lines about a point of the screen.
  drawTicks(x, y, from, to, width, color) {
    const ticks = [[1, 0], [-1, 0], [0, 1], [0, -1]].map(([dx, dy]) => [x + dx * from, y + dy * from, x + dx * to, y + dy * to]);
    outlined(this.context, width, color, () => lines(this.context, ticks));
  }

  drawRing(at) {
    const [x, y] = toScreen(this.port, ...at);
    outlined(this.context, 2.5, '#ffd54a', () => this.context.arc(x, y, 16, 0, 2 * Math.PI));
    this.drawTicks(x, y, 21, 27, 2, '#ffd54a');
  }

  imageAt(x, y) { return toImage(this.port, x, y); }
}
