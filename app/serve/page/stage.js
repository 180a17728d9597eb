// The middle of the page: what of a view is drawn.
import {isInside, toScreen} from './camera.js';
import {ViewCanvas} from './canvas.js';
import {byId, setText} from './dom.js';
import {Tools} from './tools.js';

const kRenderPause_ms = 4000;  // between renderings of a view that is only looked at
const kDimmed = 50;  // alpha of other classes while one is pointed at
const kHead_px = 9;  // of the screen: a pointer this near to the first point of a mark means the mark

export class Stage {
  constructor(page) {
    Object.assign(this, {page, labeller: page.labeller, settings: page.settings});
    this.view = new ViewCanvas(page.canvas, page.camera);
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
    page.followHand({
      hover: (x, y) => { this.pointer = x === null ? null : [x, y]; if (x !== null) this.cross = null; this.tools.thing.follow(x, y); page.redraw(); },
      zoom: (factor, x, y, wheel) => { if (!wheel || wheel.ctrlKey || !this.tools.thing.wheel(factor)) page.look('zoom', factor, x, y); },
      down: (x, y) => this.tools.down(x, y),
      draw: (x, y) => this.tools.draw(x, y),
      up: (isClick, x, y) => this.tools.up(x, y, isClick),
      cancel: (isPinch) => this.tools.cancel(isPinch),
    });
  }

  get chosenRow() { return this.labeller.classOf(this.labeller.chosen) ?? {color: [255, 255, 255]}; }

  /// At the row of a class, whose labels stand out then; null: at none.
  point(name) {
    this.pointed = name;
    this.page.redraw();
  }

  isInSight([x, y]) {
    const [sx, sy] = toScreen(this.view.port, x, y);
    return isInside(this.view.screen, sx, sy);
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
    if (!this.isInSight(this.cross)) this.page.camera.fit();
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

  /// The view: photo or rendered colour, its overlay, marks, and clicks of other views.
  draw() {
    const {page, labeller, tools} = this;
    const {index, view, camera, isRendered, pictures, state} = page;
    const isEntropy = this.kind === 'entropy';
    const overlay = pictures.overlay(index);
    if (!document.hidden && (view.ready || isRendered)) {
      pictures.want({view: index, entropy: isEntropy, color: isRendered}, state.overlay, kRenderPause_ms);
    }
    camera.setImage(view.width, view.height);
    const view_px = Math.max(view.width, view.height);
    const rendered = isRendered ? overlay?.color : null;
    const picture = rendered ?? pictures.photo(index, view.photo, view_px, view_px * camera.port.scale * camera.screen.ratio) ?? overlay?.color;

    const known = new Map(labeller.marks.map((mark) => [mark.id, mark]));
    const share = view.width / (overlay?.width ?? view.width);
    const marks = labeller.marks.filter((mark) => mark.view === index);
    const others = (overlay?.marks ?? []).filter(({id}) => known.has(id) && known.get(id).view !== index).map(({id, points}) => ({
      ...known.get(id), points: points.map((p) => p.map((v) => v * share)), frame: state.views[known.get(id).view].frame}));
    Object.assign(this, {marks, others, shown: index});

    // What is ignored has no label in the overlay; what was named on it later lies over its stripes.
    const events = overlay?.revision >= state.overlay.revision ? state.overlay.events : overlay?.events ?? -1;
    const isPainted = ({id, saved}) => saved && labeller.births.isPainted(id, events);
    const ignored = marks.findIndex(({isIgnore}) => isIgnore);
    const paints = isEntropy ? [] : marks.filter((mark, i) => !isPainted(mark) || (ignored >= 0 && i >= ignored));
    this.paint(isEntropy ? overlay?.entropy : overlay?.labels, paints,
               `${index} ${this.kind} ${overlay?.version} ${paints.map(({id, color}) => id + color).join()}`);

    const hovered = this.pointer && (this.markUnder(...this.pointer) ?? this.markUnder(...this.pointer, others));
    const hasBrush = this.pointer && !this.cross && this.aim && !view.held_out && ['brush', 'erase'].includes(tools.kind);
    const brush = hasBrush && (tools.kind === 'erase' || labeller.chosen !== null)
      ? {x: this.aim[0], y: this.aim[1], radius: this.settings.radius, color: tools.kind === 'erase' ? [255, 107, 94] : this.chosenRow.color} : null;
    const outline = tools.outline && {points: tools.outline, color: this.chosenRow.color, tip: this.aim, closes: tools.closes};
    const ring = labeller.proposal?.view === index ? labeller.proposal.at : null;
    this.view.draw({picture, opacity: this.opacity, marks, others, hovered, selected: marks.find(({id}) => id === this.selected), doomed: tools.doomed,
                    showNames: this.settings.names, ring, brush, cross: this.cross, stroke: tools.stroke, outline, thing: tools.thing.picture});
    this.tellAim(hovered, view.held_out);
  }

  get opacity() { return this.isHidden ? 0 : this.settings.opacity / 100; }

  paint(overlay, paints, key) {
    const whole = `${key} ${this.pointed} ${this.view.image.width} ${this.view.image.height}`;
    if (this.painted === whole) return;
    this.painted = whole;
    const {classes} = this.labeller;
    const isLabels = this.kind === 'labels';
    this.view.paintLayer(overlay, paints, isLabels ? classes.filter(({given, color}) => given && given !== color).map(({given, color}) => [given, color]) : []);
    this.view.traceBorders(!isLabels);
    const color = isLabels ? this.labeller.classOf(this.pointed)?.color : undefined;
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
