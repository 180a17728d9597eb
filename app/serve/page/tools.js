// What the pointer does to the view: a brush that labels, a polygon, whole things, an eraser of marks.
import {isInside} from './camera.js';
import {byHand} from './dom.js';
import {markAt} from './model.js';
import {ThingTool} from './thing.js';

const kSnap_px = 9;  // of the screen: what lies nearer is meant
const kCorner_px = 4;

export class Tools {
  constructor(stage) {
    Object.assign(this, {stage, page: stage.page, labeller: stage.labeller});
    this.kind = 'brush';
    this.thing = new ThingTool(this);
    this.forget();
  }

  /// What is under way is dropped; a sentence that says so, or nothing.
  forget() {
    const dropped = this.thing.forget() ? 'The thing is dropped. ' : this.stroke ? 'The stroke is dropped. ' : this.outline ? 'The polygon is dropped. ' : '';
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
      brush: `Brush: a ${byHand('click', 'tap')} or a drag labels.`,
      polygon: `Polygon: ${byHand('click', 'tap')} its corners, or drag along its edge; the first corner${byHand(', a double click or enter', '')} closes it.`,
      thing: `Thing: ${byHand('point at one, click, and click', 'tap one, and tap')} again to label it. ${byHand('The wheel grows and shrinks it, a', 'A')} stroke splits off or adds.`,
      erase: `Eraser: ${byHand('click', 'tap')} or drag over clicks, strokes and polygons to delete them.`,
    }[kind]);
    this.page.redraw();
  }

  /// Of the brush, or of the thing that is shown.
  resize(step) { if (!this.thing.resize(step)) this.page.setRadius(this.stage.settings.radius + step); }

  get slack() { return kSnap_px / this.stage.view.port.scale; }

  down(x, y) {
    const {stage} = this;
    const at = stage.view.imageAt(x, y);
    const isShown = this.isShown();
    this.isIn = isShown && isInside(stage.view.image, ...at);
    if (isShown && !this.isIn) this.page.messages.tell(`${byHand('Click', 'Tap')} into the picture.`);
    if (!this.isIn) return;
    const {color, isIgnore} = stage.chosenRow;
    if (this.kind === 'brush') this.stroke = {points: [at], radius: stage.settings.radius, color, isIgnore, view: stage.shown, label: this.labeller.label};
    if (this.kind === 'thing') this.thing.down(at);
    else this.thing.forget();
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
    if (this.kind === 'thing') this.thing.draw(at);
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
      else this.click({...stroke, points: isClick ? stroke.points.slice(0, 1) : stroke.points});
    }
    if (this.kind === 'thing') this.thing.up(at, isClick);
    if (this.kind === 'erase') this.finishErasing();
    if (this.kind === 'polygon' && isClick) this.clickCorner(at);
    this.page.redraw();
  }

  /// The browser took the pointer away, or a second finger came, which says that the first did not label.
  cancel(isPinch) {
    if (this.stroke && !isPinch) this.page.messages.tell('Not stored: the stroke was broken off. Draw it again.');
    this.stroke = this.thing.stroke = null;
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
    if (marks.length) this.labeller.erase(marks);
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
    if (!this.mayLabel()) return;
    const last = this.outline?.at(-1);
    if (last && Math.hypot(at[0] - last[0], at[1] - last[1]) * this.stage.view.port.scale < step_px) return;
    this.outline = [...(this.outline ?? []), at];
  }

  /// False: no outline is under way.
  close() {
    const {outline} = this;
    if (!outline) return false;
    if (!this.closes) this.page.messages.tell('A polygon needs three corners.');
    else if (this.mayLabel()) {
      this.outline = null;
      this.labeller.polygon(this.page.index, outline, 1 / this.stage.view.port.scale);
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

  // What a label needs before it begins: the view that is meant, open to labels, and a class.

  /// Whether the person sees the view that is looked at, and not the one before; else says so.
  isShown() {
    const {state, index, messages} = this.page;
    const isShown = state && this.stage.shown === index;
    if (!isShown) messages.tell(state ? 'Not stored: another view is coming. Click again.' : 'Not stored: wait until the program is connected.');
    return isShown;
  }

  /// False for a view that is only looked at, and says so.
  isOpenToLabels() {
    const {view, messages} = this.page;
    if (view?.held_out) messages.tell(`${view.frame} is held out for tests: a label here would train on what tests measure. Label another view.`);
    return !view?.held_out;
  }

  /// Whether a label can be begun now; else says why, or asks for a class.
  mayLabel() {
    if (!this.isOpenToLabels()) return false;
    if (this.labeller.chosen === null) this.nameFirst();
    return this.labeller.chosen !== null;
  }

  /// act(label) at once where a class was chosen, or after the dialog of the first class; else says that nothing is stored.
  whenNamed(act, seen = this.labeller.label) {
    const label = seen.class === null ? this.labeller.label : seen;
    if (label.class !== null) act(label);
    else this.nameFirst(() => act(this.labeller.label));
  }

  nameFirst(then) {
    if (this.labeller.classes.length === 0) this.page.make(then);
    else this.page.messages.tell(`Choose a class first${byHand(': keys 1 to 9, or n for a new one', ', or make one')}.`);
  }

  click({points, radius, view, label}) {
    if (this.isOpenToLabels()) this.whenNamed((named) => this.labeller.click(view, points, radius, named), label);
  }
}
