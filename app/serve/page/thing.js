// One click, one thing: what is under the pointer as a mask, which a person grows, splits and accepts; and what a click of the brush would label, shown
// faintly where the pointer rests.
import {Refusal, getThing} from './api.js';
import {isInside} from './camera.js';
import {byHand} from './dom.js';
import {isWithin} from './model.js';

const kRest_ms = {thing: 60, brush: 500};  // of the pointer, before the program is asked
const kNotch_ms = 90;                      // a turn of the wheel is one level, however many reports it makes
const kMostPlaces = 24;                    // of a stroke

const keyOf = ([a, b]) => `${a}-${b}`;

/// Sides of an outline; a hole hangs on the rest by a line there and back, which is no side.
export function sidesOf(outline) {
  const sides = outline.map((point, i) => [point, outline[(i + 1) % outline.length]]);
  const there = new Set(sides.map(keyOf));
  return sides.filter(([a, b]) => !there.has(keyOf([b, a])));
}

/// By the even-odd rule.
export const holds = (outlines, at) => outlines.filter((outline) => isWithin(outline, ...at)).length % 2 > 0;

export class ThingTool {
  constructor(tools) {
    Object.assign(this, {tools, stage: tools.stage, page: tools.page, labeller: tools.labeller});
    this.forget();
  }

  /// True: something was held.
  forget() {
    const {isHeld} = this;
    clearTimeout(this.timer);
    Object.assign(this, {wish: null, shown: null, isHeld: false, isFaint: false, isNew: false, stroke: null});
    return Boolean(isHeld);
  }

  get isChosen() { return this.tools.kind === 'thing'; }

  /// What is drawn, or null.
  get picture() {
    const {shown, stroke} = this;
    if (!shown || shown.view !== this.page.index) return null;
    return {outlines: shown.outlines, sides: shown.sides, color: this.stage.chosenRow.color, isFaint: this.isFaint, isHeld: this.isHeld, stroke};
  }

  /// The pointer is at a point of the screen, or left (null).
  follow(x, y) {
    if (this.isHeld || this.stroke) return;
    clearTimeout(this.timer);
    const {page, stage, tools} = this;
    const at = x === null ? null : stage.view.imageAt(x, y);
    if (this.shown && at && this.isChosen && this.shown.view === page.index && holds(this.shown.outlines, at)) return;
    const mayAsk = at && kRest_ms[tools.kind] !== undefined && page.state && stage.shown === page.index && !page.view.held_out &&
      !tools.stroke && isInside(stage.view.image, ...at);
    if (!this.isChosen || !mayAsk) this.wish = this.shown = null;
    if (mayAsk) this.timer = setTimeout(() => this.ask({view: page.index, also: [at], not: [], level: 0, isFaint: !this.isChosen}), kRest_ms[tools.kind]);
  }

  /// One request after the other; the newest wish takes the place of one that waits.
  async ask(wish) {
    this.wish = wish;
    if (this.isAsking) return;
    this.isAsking = true;
    for (let asked = null; this.wish && this.wish !== asked;) {
      asked = this.wish;
      const {view, also, not, level} = asked;
      try {
        const facts = await getThing({client: `${this.labeller.ids.tab}-thing`, view, also, not, level});
        if (this.wish === asked && !facts.stale) this.took(asked, facts);
      } catch (error) {
        if (!(error instanceof Refusal)) throw error;
        this.page.messages.wrong(error);
      }
    }
    this.isAsking = false;
  }

  took(wish, facts) {
    if (this.tools.kind !== (wish.isFaint ? 'brush' : 'thing')) return;
    this.shown = {...wish, ...facts, sides: facts.outlines.flatMap(sidesOf)};
    this.isFaint = wish.isFaint;
    if (this.isNew) this.tellHeld();
    this.page.redraw();
  }

  /// One level larger or smaller; false: there is nothing to change.
  resize(step) {
    if (!this.isChosen || !this.shown) return false;
    const {view, also, not, level, least, most} = this.shown;
    const to = Math.min(Math.max((this.wish?.level ?? level) + step, least), most);
    if (to === level) this.page.messages.tell(step > 0 ? 'It is the whole picture.' : 'It has no smaller parts.');
    else this.ask({view, also, not, level: to});
    return true;
  }

  wheel(factor, now = performance.now()) {
    if (!this.isChosen || !this.shown) return false;
    if (now - (this.turned ?? -Infinity) < kNotch_ms) return true;
    this.turned = now;
    return this.resize(factor > 1 ? 1 : -1);
  }

  down(at) { this.stroke = [at]; }
  draw(at) { this.stroke?.push(at); }

  /// A click holds what is shown, accepts what is held, or adds what lies beside it; a stroke from inside splits off, one from beside adds.
  up(at, isClick) {
    const stroke = this.stroke ?? [at];
    this.stroke = null;
    if (!this.tools.isOpenToLabels()) return;
    const {shown, isHeld} = this;
    const isIn = shown && holds(shown.outlines, stroke[0]);
    this.isHeld = true;
    this.isNew = !isHeld;
    clearTimeout(this.timer);
    if (isClick && isIn) return isHeld ? this.accept() : this.tellHeld();
    if (!shown || (isClick && !isHeld)) return this.ask({view: this.page.index, also: [stroke[0]], not: [], level: 0});
    const every = isClick ? 1 : Math.ceil(stroke.length / kMostPlaces);
    const places = stroke.filter((_, i) => i % every === 0);
    const {view, also, not, level} = shown;
    this.ask({view, level, also: isIn ? also : [...also, ...places], not: isIn ? [...not, ...places] : not});
  }

  tellHeld() {
    this.isNew = false;
    const guess = this.labeller.classes.find(({index}) => index >= 0 && index === this.shown.class_guess);
    const looks = guess && guess.name !== this.labeller.chosen ? `; it looks like "${guess.name}"` : '';
    this.page.messages.tell(`${byHand('Enter or a click', 'A tap')} labels it${looks}. ${byHand('The wheel grows and shrinks it, a', 'A')} stroke splits off or adds.`);
  }

  /// The thing gets the chosen class and a number of its own; false: none is held.
  accept() {
    if (!this.isChosen || !this.shown) return false;
    if (!this.tools.isOpenToLabels()) return true;
    const {view, outlines} = this.shown;
    this.tools.whenNamed((label) => {
      this.labeller.thing(view, outlines, label);
      this.forget();
    });
    return true;
  }
}
