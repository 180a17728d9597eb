// The middle of the page: which picture, overlay and marks are drawn, and what the pointer does there.
import {ViewCanvas} from './canvas.js';
import {byId, setText} from './dom.js';
import {followPointer} from './pointer.js';
import {isInside, moved, toScreen, zoomed} from './viewport.js';

const kDimmed = 50;  // alpha of other classes while one is pointed at

export class Stage {
  /// calls: click(points, radius, isClick), changed(), drag(dx, dy) and wheel(factor) of a flight.
  constructor(labeller, settings, calls) {
    Object.assign(this, {labeller, settings, calls});
    this.view = new ViewCanvas(byId('canvas'));
    this.kind = 'labels';
    this.isHidden = false;     // the overlay is off
    this.pointed = null;       // name of the class whose row is pointed at
    this.pointer = null;       // CSS pixels
    this.cross = null;         // pixels of the view; for clicks without a mouse
    this.stroke = null;
    this.flown = null;         // picture of a flight
    new ResizeObserver(() => { if (this.view.resize()) calls.changed(); }).observe(byId('canvas'));
    this.view.resize();
    followPointer(byId('canvas'), {
      hover: (x, y) => { this.pointer = x === null ? null : [x, y]; if (x !== null) this.cross = null; calls.changed(); },
      down: (x, y) => { if (!calls.isFlying()) this.begin(x, y); else this.last = [x, y]; },
      draw: (x, y) => {
        if (calls.isFlying()) { calls.drag(x - this.last[0], y - this.last[1]); this.last = [x, y]; }
        else this.extend(x, y);
      },
      up: (isClick) => { if (!calls.isFlying()) this.finish(isClick); },
      cancel: () => { this.stroke = null; calls.changed(); },
      pan: (dx, dy) => {
        if (calls.isFlying()) calls.drag(dx, dy);
        else this.look(moved(this.view.port, dx, dy, this.view.image, this.view.screen));
      },
      zoom: (factor, x, y) => { if (calls.isFlying()) calls.wheel(factor); else this.zoom(factor, x, y); },
    });
  }

  get chosenColor() { return this.labeller.classOf(this.labeller.chosen)?.color ?? [255, 255, 255]; }

  begin(x, y) {
    const at = this.view.imageAt(x, y);
    this.stroke = isInside(this.view.image, ...at) ? {points: [at], radius: this.settings.radius, color: this.chosenColor} : null;
    this.calls.changed();
  }

  extend(x, y) {
    if (!this.stroke) return;
    const [ix, iy] = this.view.imageAt(x, y);
    const {width, height} = this.view.image;
    this.stroke.points.push([Math.min(Math.max(ix, 0), width - 0.1), Math.min(Math.max(iy, 0), height - 0.1)]);
    this.calls.changed();
  }

  finish(isClick) {
    const {stroke} = this;
    this.stroke = null;
    if (stroke) this.calls.click(isClick ? stroke.points.slice(0, 1) : stroke.points);
    this.calls.changed();
  }

  look(port) {
    this.view.look(port);
    this.calls.changed();
  }

  zoom(factor, x = this.view.screen.width / 2, y = this.view.screen.height / 2) {
    this.look(zoomed(this.view.port, factor, x, y, this.view.image, this.view.screen));
  }

  fit() {
    this.view.fit();
    this.calls.changed();
  }

  isInSight([x, y]) {
    const [sx, sy] = toScreen(this.view.port, x, y);
    return isInside({width: this.view.screen.width, height: this.view.screen.height}, sx, sy);
  }

  /// The point of the view that a key means: the cross, or where the pointer is.
  get aim() {
    if (this.cross) return this.cross;
    const at = this.pointer && this.view.imageAt(...this.pointer);
    return at && isInside(this.view.image, ...at) ? at : null;
  }

  moveCross(dx, dy, isFine) {
    const {width, height} = this.view.image;
    const step = isFine ? 1 : Math.max(1, Math.round(width / 80));
    const [x, y] = this.cross ?? this.aim ?? [width / 2, height / 2];
    const within = (v, most) => Math.min(Math.max(Math.floor(v) + 0.5, 0.5), most - 0.5);
    this.cross = [within(x + dx * step, width), within(y + dy * step, height)];
    if (!this.isInSight(this.cross)) this.view.fit();
    this.calls.changed();
  }

  /// The name of the class that the overlay shows at a point, or null.
  classAt([x, y]) {
    if (this.kind !== 'labels') return null;
    const color = this.view.layerColor(x, y);
    return color && (this.labeller.classes.find((row) => row.color.every((v, i) => Math.abs(v - color[i]) <= 1))?.name ?? null);
  }

  markAt(marks) {
    if (!this.pointer) return null;
    return marks.findLast(({points}) => {
      const [x, y] = toScreen(this.view.port, ...points[0]);
      return Math.hypot(x - this.pointer[0], y - this.pointer[1]) < 9;
    }) ?? null;
  }

  /// Draws a view: photo or rendered colour, its overlay, the marks; `isPainted(mark)`: the overlay knows the mark.
  drawView({index, picture, overlay, marks, isPainted, ring}) {
    const {width, height} = this.labeller.state.views[index];
    this.view.setImage(width, height);
    const isEntropy = this.kind === 'entropy';
    const paints = isEntropy ? [] : marks.filter((mark) => !isPainted(mark));
    this.paint(isEntropy ? overlay?.entropy : overlay?.labels, paints,
               `${index} ${this.kind} ${overlay?.version} ${paints.map(({id, color}) => id + color).join()}`);
    const hovered = this.markAt(marks);
    const brush = this.pointer && !this.cross && this.labeller.chosen !== null && this.aim
      ? {x: this.aim[0], y: this.aim[1], radius: this.settings.radius, color: this.chosenColor} : null;
    this.view.draw({picture, opacity: this.opacity, marks, hovered, showNames: this.settings.names, ring, brush, cross: this.cross, stroke: this.stroke});
    this.tellAim(hovered);
  }

  drawFlight(picture, text) {
    if (picture) {
      this.view.setImage(picture.width, picture.height);
      this.paint(picture.labels, [], `flight ${picture.serial}`);
    }
    this.view.draw({isSmooth: true, picture: picture?.color, opacity: picture ? this.opacity : 0, marks: []});
    setText(byId('readout'), text);
  }

  get opacity() { return this.isHidden ? 0 : this.settings.opacity / 100; }

  paint(overlay, paints, key) {
    const whole = `${key} ${this.pointed} ${this.view.image.width} ${this.view.image.height}`;
    if (this.painted === whole) return;
    this.painted = whole;
    this.view.paintLayer(overlay, paints);
    const color = this.kind === 'labels' ? this.labeller.classOf(this.pointed)?.color : undefined;
    if (color) this.view.dimOthers(color, kDimmed);
  }

  tellAim(hovered) {
    const {aim} = this;
    let text = '';
    if (aim) {
      const name = this.classAt(aim);
      text = `${Math.floor(aim[0])}, ${Math.floor(aim[1])}`;
      if (name) text += `  ${name}`;
      if (hovered) text += `  (clicked as ${hovered.name}${hovered.saved ? '' : ', not saved yet'})`;
    }
    setText(byId('readout'), text);
  }
}
