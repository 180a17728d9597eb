// The middle of the page: what of a view is drawn, and what the pointer does there.
import {ViewCanvas, isInside, moved, toScreen, zoomed} from './canvas.js';
import {byId, setText} from './dom.js';
import {markAt} from './model.js';
import {followPointer} from './pointer.js';

// What the pointer does to the view: a brush that labels, a polygon, an eraser of marks.

const kSnap_px = 9;  // of the screen: what lies nearer is meant
const kCorner_px = 4;

export class Tools {
  constructor(stage) {
    Object.assign(this, {stage, page: stage.page});
    this.kind = 'brush';
    this.forget();
  }

  /// What is under way is dropped; a sentence that says so, or nothing.
  forget() {
    const dropped = this.stroke ? 'The stroke is dropped. ' : this.outline ? 'The polygon is dropped. ' : '';
    this.stroke = null;
    this.outline = null;
    this.doomed = new Map();
    return dropped;
  }

  drop() {
    const dropped = this.forget();
    if (dropped) this.page.messages.tell(dropped);
  }

  use(kind) {
    const dropped = this.forget();
    this.kind = kind;
    this.page.messages.tell(dropped + {
      brush: 'Brush: a click or a drag labels.',
      polygon: 'Polygon: click its corners, or drag along its edge; the first corner, a double click or enter closes it.',
      erase: 'Eraser: click or drag over clicks, strokes and polygons to delete them.',
    }[kind]);
    this.page.redraw();
  }

  get slack() { return kSnap_px / this.stage.view.port.scale; }

  down(x, y) {
    const {stage} = this;
    const at = stage.view.imageAt(x, y);
    const isShown = this.page.isShown();
    this.isIn = isShown && isInside(stage.view.image, ...at);
    if (isShown && !this.isIn) this.page.messages.tell('Click into the picture.');
    if (!this.isIn) return;
    const {color, isIgnore} = stage.chosenRow;
    if (this.kind === 'brush') this.stroke = {points: [at], radius: stage.settings.radius, color, isIgnore, view: stage.shown, label: stage.labeller.label};
    if (this.kind === 'erase') {
      this.erasedAt = null;
      this.doom(at);
    }
    this.page.redraw();
  }

  draw(x, y) {
    if (!this.isIn) return;
    const [ix, iy] = this.stage.view.imageAt(x, y);
    const {width, height} = this.stage.view.image;
    const at = [Math.min(Math.max(ix, 0), width - 0.01), Math.min(Math.max(iy, 0), height - 0.01)];
    if (this.kind === 'brush') this.stroke?.points.push(at);
    if (this.kind === 'erase') this.doom(at);
    if (this.kind === 'polygon') this.corner(at, kCorner_px);
    this.page.redraw();
  }

  up(x, y, isClick) {
    if (!this.isIn) return;
    const at = this.stage.view.imageAt(x, y);
    const {stroke} = this;
    this.stroke = null;
    if (this.kind === 'brush' && stroke) {
      const mark = isClick && this.stage.markUnder(x, y);
      if (mark && (mark.name === stroke.label.class || stroke.label.class === null)) this.page.select(mark);
      else this.page.click({...stroke, points: isClick ? stroke.points.slice(0, 1) : stroke.points});
    }
    if (this.kind === 'erase') this.finishErasing();
    if (this.kind === 'polygon' && isClick) this.clickCorner(at);
    this.page.redraw();
  }

  /// The browser took the pointer away, or a second finger came, which says that the first did not label.
  cancel(isPinch) {
    if (this.stroke && !isPinch) this.page.messages.tell('Not stored: the stroke was broken off. Draw it again.');
    this.stroke = null;
    this.doomed = new Map();
    this.page.redraw();
  }

  /// Whatever lies on the way of the eraser, which a quick pointer reports in few points.
  doom(at) {
    const reach = Math.max(this.slack, this.stage.settings.radius);
    const from = this.erasedAt ?? at;
    this.erasedAt = at;
    const steps = Math.ceil(Math.hypot(at[0] - from[0], at[1] - from[1]) / reach) || 1;
    for (let i = 1; i <= steps; ++i) {
      const here = at.map((v, axis) => from[axis] + ((v - from[axis]) * i) / steps);
      const mark = markAt(this.stage.marks.filter(({id}) => !this.doomed.has(id)), here, reach);
      if (mark) this.doomed.set(mark.id, mark);
    }
  }

  finishErasing() {
    const marks = [...this.doomed.values()];
    this.doomed = new Map();
    if (marks.length) this.page.labeller.erase(marks);
    else this.page.messages.tell('No click of this view is there. The eraser takes clicks, strokes and polygons away.');
  }

  near(a, b) { return Math.hypot(a[0] - b[0], a[1] - b[1]) < this.slack; }

  get closes() { return (this.outline?.length ?? 0) >= 3; }

  clickCorner(at) {
    const {outline} = this;
    if (this.closes && (this.near(at, outline[0]) || this.near(at, outline.at(-1)))) return this.close();
    this.corner(at, 0);
  }

  corner(at, step_px) {
    if (!this.page.mayLabel()) return;
    const last = this.outline?.at(-1);
    if (last && Math.hypot(at[0] - last[0], at[1] - last[1]) * this.stage.view.port.scale < step_px) return;
    this.outline = [...(this.outline ?? []), at];
  }

  /// False: no outline is under way.
  close() {
    const {outline} = this;
    if (!outline) return false;
    if (!this.closes) this.page.messages.tell('A polygon needs three corners.');
    else if (this.page.mayLabel()) {
      this.outline = null;
      this.page.polygon(outline, 1 / this.stage.view.port.scale);
    }
    this.page.redraw();
    return true;
  }

  takeBack() {
    if (!this.outline) return false;
    this.outline = this.outline.length > 1 ? this.outline.slice(0, -1) : null;
    this.page.redraw();
    return true;
  }
}

const kDimmed = 50;  // alpha of other classes while one is pointed at
const kHead_px = 9;  // of the screen: a pointer this near to the first point of a mark means the mark

export class Stage {
  constructor(page) {
    Object.assign(this, {page, labeller: page.labeller, settings: page.settings});
    this.view = new ViewCanvas(byId('canvas'));
    this.kind = 'labels';
    this.isHidden = false;     // the overlay is off
    this.pointed = null;       // name of the class whose row is pointed at
    this.pointer = null;       // CSS pixels
    this.cross = null;         // pixels of the view; for clicks without a mouse
    this.marks = [];           // of the view
    this.others = [];          // clicks of other views that are seen
    this.selected = null;      // id of a mark
    this.shown = null;         // number of the view that the person sees
    this.tools = new Tools(this);
    new ResizeObserver(() => { if (this.view.resize()) page.redraw(); }).observe(byId('canvas'));
    this.view.resize();
    followPointer(byId('canvas'), {
      hover: (x, y) => { this.pointer = x === null ? null : [x, y]; if (x !== null) this.cross = null; page.redraw(); },
      down: (x, y) => this.tools.down(x, y),
      draw: (x, y) => this.tools.draw(x, y),
      up: (isClick, x, y) => this.tools.up(x, y, isClick),
      cancel: (isPinch) => this.tools.cancel(isPinch),
      pan: (dx, dy) => this.look(moved(this.view.port, dx, dy, this.view.image, this.view.screen)),
      zoom: (factor, x, y) => this.zoom(factor, x, y),
    });
  }

  get chosenRow() { return this.labeller.classOf(this.labeller.chosen) ?? {color: [255, 255, 255]}; }

  look(port) {
    this.view.look(port);
    this.page.redraw();
  }

  /// At the row of a class, whose labels stand out then; null: at none.
  point(name) {
    this.pointed = name;
    this.page.redraw();
  }

  zoom(factor, x = this.view.screen.width / 2, y = this.view.screen.height / 2) {
    this.look(zoomed(this.view.port, factor, x, y, this.view.image, this.view.screen));
  }

  fit() {
    this.view.fit();
    this.page.redraw();
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
    this.page.redraw();
  }

  /// The name of the class that the overlay shows at a point, or null.
  classAt([x, y]) {
    if (this.kind !== 'labels') return null;
    const color = this.view.layerColor(x, y);
    return color && (this.labeller.classes.find((row) => row.color.every((v, i) => Math.abs(v - color[i]) <= 1))?.name ?? null);
  }

  /// The mark whose first point lies under a point of the screen, or null; of the view itself before those of others.
  markUnder(x, y, marks = this.marks) {
    return marks.findLast(({points}) => {
      const [px, py] = toScreen(this.view.port, ...points[0]);
      return Math.hypot(px - x, py - y) < kHead_px;
    }) ?? null;
  }

  /// The mark that keys mean: the one that is selected, or the one under the pointer or the cross.
  get meant() {
    const selected = this.marks.find(({id}) => id === this.selected);
    if (selected) return selected;
    const at = this.cross ? toScreen(this.view.port, ...this.cross) : this.pointer;
    return at && this.markUnder(...at);
  }

  /// Draws a view: photo or rendered colour, its overlay, the marks; `isPainted(mark)`: the overlay knows the mark; others: clicks of other
  /// views; isLocked: it is only looked at.
  drawView({index, picture, overlay, marks, others, isPainted, ring, isLocked}) {
    Object.assign(this, {marks, others, shown: index});
    const isEntropy = this.kind === 'entropy';
    // What is ignored has no label in the overlay; what was named on it later lies over its stripes.
    const ignored = marks.findIndex(({isIgnore}) => isIgnore);
    const paints = isEntropy ? [] : marks.filter((mark, i) => !isPainted(mark) || (ignored >= 0 && i >= ignored));
    this.paint(isEntropy ? overlay?.entropy : overlay?.labels, paints,
               `${index} ${this.kind} ${overlay?.version} ${paints.map(({id, color}) => id + color).join()}`);
    const hovered = this.pointer && (this.markUnder(...this.pointer) ?? this.markUnder(...this.pointer, others));
    const {tools} = this;
    const hasBrush = this.pointer && !this.cross && this.aim && !isLocked && tools.kind !== 'polygon';
    const brush = hasBrush && (tools.kind === 'erase' || this.labeller.chosen !== null)
      ? {x: this.aim[0], y: this.aim[1], radius: this.settings.radius, color: tools.kind === 'erase' ? [255, 107, 94] : this.chosenRow.color} : null;
    const outline = tools.outline && {points: tools.outline, color: this.chosenRow.color, tip: this.aim, closes: tools.closes};
    this.view.draw({picture, opacity: this.opacity, marks, others, hovered, selected: marks.find(({id}) => id === this.selected), doomed: tools.doomed,
                    showNames: this.settings.names, ring, brush, cross: this.cross, stroke: tools.stroke, outline});
    this.tellAim(hovered, isLocked);
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

  tellAim(hovered, isLocked) {
    const {aim, tools} = this;
    const words = [];
    if (isLocked) words.push('Held out for tests: only to look at.');
    if (tools.outline) words.push(`${tools.outline.length} corner${tools.outline.length === 1 ? '' : 's'}`);
    if (aim) {
      words.push(`${aim[0].toFixed(1)}, ${aim[1].toFixed(1)}`);
      if (hovered) {
        const where = hovered.frame ? ` in ${hovered.frame}` : '';
        words.push(`(clicked as ${hovered.label}${where}${hovered.saved ? '' : ', not saved yet'}${where ? '' : '; Delete removes it'})`);
      }
      const name = this.classAt(aim);
      if (name) words.push(name);
    }
    setText(byId('readout'), words.join('  ·  '));
  }
}
