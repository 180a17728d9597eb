// What a person does to the labels: clicks, classes, undo. Keeps what the program does not know yet and adds it to its state.
import {EventQueue, Ids, safeStorage} from './events.js';
import {MarkBirths, combined, merged, strokeParts} from './model.js';

const kMostHistory = 300;

/// What an event did, for a message.
function inWords(event) {
  switch (event.type) {
    case 'click': return `${event.points.length > 1 ? 'stroke' : 'click'} "${event.class}" in ${event.frame}`;
    case 'class': return `class "${event.name}"`;
    case 'rename': return event.class === event.name ? `colour of "${event.name}"` : `"${event.class}" is "${event.name}"`;
    default: return 'skipped proposal';
  }
}

export class Labeller {
  /// changed(): something shown is another; tell(text): a word of what was done; refuse(sentence, remedy, passes): an error to show, passes: until all is saved.
  constructor({changed, tell, refuse}) {
    Object.assign(this, {changed, tell, refuse});
    this.ids = new Ids();
    this.storage = safeStorage('sessionStorage');
    this.state = null;
    this.classes = [];
    this.marks = [];
    this.births = new MarkBirths();
    this.pending = [];      // [{event, revision}]; revision: of the answer, null before it came
    this.everyEvent = new Map();
    this.undoable = [];     // own events, the last one last
    this.redoable = [];     // undo events
    this.chosen = null;     // name of the class of the next click
    this.skipped = null;    // id of the proposal that was taken or skipped here
    this.queue = new EventQueue({
      tab: this.ids.tab,
      changed: () => this.changed(),
      acknowledged: (event, answer) => {
        const item = this.pending.find((entry) => entry.event.id === event.id);
        if (item) item.revision = answer.revision;
        this.settle();
      },
      refused: (event, error) => {
        this.forget(event);
        this.refuse(`Not taken (${inWords(event)}): ${error.message}`, error.remedy);
      },
      failed: (error) => {
        if (error.status >= 500) this.refuse(error.message, error.remedy || 'It stays in this browser and is sent again.', true);
      },
    });
  }

  get unsaved() { return this.queue.unsent.length; }

  /// A state that the program told; anew: it may be another process.
  take(answer, anew) {
    const first = this.state === null;
    this.births.see(merged(this.state, answer), anew);
    this.state = merged(this.state, answer);
    if (first) {
      this.remembered();
      this.queue.open(this.state.run.id);
      for (const event of this.queue.unsent) {
        this.everyEvent.set(event.id, event);
        this.pending.push({event, revision: null});
      }
    }
    if (anew) {
      // What was acknowledged is in the file, so this process knows it.
      for (const item of this.pending) if (item.revision !== null) item.revision = 0;
      this.queue.poke();
    }
    if (this.skipped && this.state.proposal?.id !== this.skipped) this.skipped = null;
    this.settle();
  }

  settle() {
    if (!this.state) return;
    this.pending = this.pending.filter((item) => item.revision === null || item.revision > this.state.revision);
    const index = this.classes.find((row) => row.name === this.chosen)?.index ?? -1;
    Object.assign(this, combined(this.state, this.pending, this.everyEvent));
    if (this.chosen !== null && !this.classes.some((row) => row.name === this.chosen)) {
      this.chosen = this.classes.find((row) => row.index === index && index >= 0)?.name ?? null;
    }
    this.changed();
  }

  /// The proposal, unless it was answered here already.
  get proposal() {
    const {proposal} = this.state ?? {};
    return proposal && proposal.id !== this.skipped ? proposal : null;
  }

  classOf(name) { return this.classes.find((row) => row.name === name); }

  choose(name) {
    this.chosen = name;
    this.changed();
  }

  add(event, undoable = true) {
    const whole = {id: this.ids.next(), ...event};
    this.everyEvent.set(whole.id, whole);
    this.pending.push({event: whole, revision: null});
    if (undoable) {
      this.undoable = [...this.undoable, whole].slice(-kMostHistory);
      this.redoable = [];
    }
    this.keep();
    this.queue.add(whole);
    this.settle();
    return whole;
  }

  /// A click (one point) or a stroke in pixels of the view, with the chosen class.
  click(view, points, radius) {
    const {frame, width, height} = this.state.views[view];
    const within = points.map(([x, y]) => [Math.min(Math.max(x, 0), width - 0.1), Math.min(Math.max(y, 0), height - 0.1)]);
    for (const part of strokeParts(within, Math.max(0.7, radius / 3))) {
      this.add({type: 'click', frame, size: [width, height], points: part, radius, class: this.chosen});
    }
  }

  addClass(name, color) {
    this.add({type: 'class', name, color});
    this.choose(name);
  }

  changeClass(old, name, color) {
    this.add({type: 'rename', class: old, name, color});
    if (this.chosen === old) this.chosen = name;
    this.settle();
  }

  takeProposal(radius) {
    const {id, view, at} = this.proposal;
    this.skipped = id;
    this.click(view, [at], radius);
  }

  skipProposal() {
    const {id, view, at} = this.proposal;
    const {frame, width, height} = this.state.views[view];
    this.skipped = id;
    this.add({type: 'skip', frame, size: [width, height], points: [at]});
  }

  /// Undoes the last own event; after a new start the last click of this browser.
  undo() {
    let event = this.undoable.pop();
    if (!event) {
      const mark = this.marks.findLast(({id}) => this.ids.isOurs(id));
      if (mark) event = {id: mark.id, type: 'click', frame: this.state.views[mark.view].frame, points: mark.points, class: mark.name};
    }
    if (!event) return this.tell('There is nothing to undo.');
    if (!this.everyEvent.has(event.id)) this.everyEvent.set(event.id, event);
    this.redoable.push(this.add({type: 'undo', of: event.id}, false));
    this.keep();
    this.tell(`Undone: ${inWords(event)}`);
  }

  redo() {
    const undo = this.redoable.pop();
    if (!undo) return this.tell('There is nothing to redo.');
    const event = this.everyEvent.get(undo.of);
    this.undoable.push(event);
    this.add({type: 'undo', of: undo.id}, false);
    if (event.type === 'class') this.choose(event.name);
    this.tell(`Done again: ${inWords(event)}`);
  }

  forget(event) {
    const others = (entry) => entry.id !== event.id;
    this.pending = this.pending.filter((item) => others(item.event));
    this.undoable = this.undoable.filter(others);
    this.redoable = this.redoable.filter(others);
    this.keep();
    this.settle();
  }

  keep() {
    try {
      this.storage.setItem(`semfield.done.${this.state.run.id}`, JSON.stringify({undoable: this.undoable, redoable: this.redoable}));
    } catch { /* full: undo forgets at a reload */ }
  }

  remembered() {
    try {
      const kept = JSON.parse(this.storage.getItem(`semfield.done.${this.state.run.id}`) ?? '{}');
      this.undoable = kept.undoable ?? [];
      this.redoable = kept.redoable ?? [];
    } catch { /* not ours to read */ }
    for (const event of [...this.undoable, ...this.redoable]) this.everyEvent.set(event.id, event);
    for (const undo of this.redoable) if (!this.everyEvent.has(undo.of)) this.redoable = [];
  }
}
