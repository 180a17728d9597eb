// What is shown: the program's state with the events on top that it does not know yet. Pure.
import {freeColor} from './colors.js';

/// The state with what a newer answer brings; marks and history stay where it leaves them out.
export function merged(state, answer) {
  return {...answer, marks: answer.marks ?? state?.marks ?? [], history: answer.history ?? state?.history ?? []};
}

/// Classes and marks as they will be when every pending event is known. Pending: [{event}], in order; an event's undo hides it.
/// classes: [{index, name, color, clicks, area_share, confidence, saved}], index -1 while the program has not named it;
/// marks: [{id, view, points, radius, name, color, saved}].
export function combined(state, pending, everyEvent) {
  const undone = new Set();
  const revived = new Set();
  const events = new Map(pending.map(({event}) => [event.id, event]));
  for (const {event} of pending) {
    if (event.type !== 'undo') continue;
    const of = events.get(event.of) ?? everyEvent.get(event.of);
    if (of?.type === 'undo') {
      undone.delete(of.of);
      revived.add(of.of);
    } else {
      undone.add(event.of);
      revived.delete(event.of);
    }
  }
  const alive = pending.map(({event}) => event).filter((event) => !undone.has(event.id));
  for (const id of revived) {
    if (!events.has(id) && everyEvent.has(id)) alive.push(everyEvent.get(id));
  }

  const classes = state.classes.map((row) => ({...row, saved: true}));
  for (const event of alive) {
    if (event.type === 'class' && !classes.some((row) => row.name === event.name)) {
      const color = event.color ?? freeColor(classes.map((row) => row.color));
      classes.push({index: -1, name: event.name, color, clicks: 0, area_share: 0, confidence: 0, saved: false});
    }
    if (event.type === 'rename') {
      const row = classes.find(({name}) => name === event.class);
      if (row) Object.assign(row, {name: event.name, color: event.color ?? row.color, saved: false});
    }
  }
  const byIndex = new Map(classes.map((row) => [row.index, row]));
  const byName = new Map(classes.map((row) => [row.name, row]));
  const marks = [];
  for (const mark of state.marks) {
    const row = byIndex.get(mark.class);
    if (!undone.has(mark.id)) marks.push({...mark, name: row?.name ?? 'void', color: row?.color ?? [160, 160, 160], saved: true});
  }
  const known = new Set(state.marks.map((mark) => mark.id));
  const viewOf = new Map(state.views.map((view, i) => [view.frame, i]));
  for (const event of alive) {
    if (event.type !== 'click' || known.has(event.id) || !viewOf.has(event.frame)) continue;
    const row = byName.get(event.class);
    marks.push({id: event.id, view: viewOf.get(event.frame), points: event.points, radius: event.radius, name: event.class,
                color: row?.color ?? [160, 160, 160], saved: false});
  }
  for (const row of classes) row.clicks = marks.filter(({name}) => name === row.name).length;
  return {classes, marks};
}

/// Which events of `overlay` (a revision of the label maps) are known, from the pairs that states told.
export class OverlayEvents {
  constructor() { this.pairs = []; }
  tell({revision, events}) {
    const last = this.pairs.at(-1);
    if (last && revision < last[0]) this.pairs = [];
    if (last?.[0] === revision) last[1] = events;
    else this.pairs.push([revision, events]);
    if (this.pairs.length > 64) this.pairs.shift();
  }
  known(revision) {
    let events = -1;
    for (const [at, count] of this.pairs) if (at <= revision) events = count;
    return events;
  }
}

/// From which number of events on a label map knows each mark: the count when the mark was first seen.
export class MarkBirths {
  constructor() { this.births = new Map(); }
  see(state, anew) {
    const count = anew && this.births.size === 0 ? state.overlay.events : state.events;
    const births = new Map();
    for (const {id} of state.marks) births.set(id, this.births.get(id) ?? count);
    this.births = births;
  }
  isPainted(id, events) { return this.births.has(id) && this.births.get(id) <= events; }
}

/// The order in which the strip shows views.
export function orderedViews(views, order) {
  const all = views.map((_, i) => i);
  if (order === 'uncertain') all.sort((a, b) => views[b].entropy - views[a].entropy || a - b);
  if (order === 'few') all.sort((a, b) => views[a].clicks - views[b].clicks || views[b].entropy - views[a].entropy || a - b);
  return all;
}

/// Events of one stroke in parts of at most `most` points that share their ends, rounded to a tenth of a pixel and without
/// points that lie nearer than `step` to the one before.
export function strokeParts(points, step, most = 4096) {
  const kept = [];
  for (const [i, point] of points.entries()) {
    const last = kept.at(-1);
    if (last && i + 1 < points.length && Math.hypot(point[0] - last[0], point[1] - last[1]) < step) continue;
    kept.push(point.map((v) => Math.round(v * 10) / 10));
  }
  const parts = [];
  for (let at = 0; at < kept.length; at += most - 1) {
    if (at > 0 && at + 1 >= kept.length) break;
    parts.push(kept.slice(at, at + most));
  }
  return parts;
}

/// What is wrong with a class's name, or nothing.
export function nameProblem(name, others) {
  if (!name) return 'A class needs a name.';
  if ([...name].length > 100) return 'The name is longer than 100 characters.';
  if (/[\u0000-\u001f\u007f]/.test(name)) return 'The name has a control character.';
  if (others.includes(name)) return `There is a class "${name}" already.`;
  return '';
}

const kWhy = {
  uncertain: 'the model is uncertain',
  unseen: 'no label reaches it yet',
  border: 'classes meet here',
};
export const reason = (why) => kWhy[why] ?? why;

export function duration(seconds) {
  const s = Math.floor(seconds);
  const two = (v) => String(v).padStart(2, '0');
  return s >= 3600 ? `${Math.floor(s / 3600)}:${two(Math.floor(s / 60) % 60)}:${two(s % 60)}` : `${Math.floor(s / 60)}:${two(s % 60)}`;
}

/// 950, 12.3 k, 4.5 M
export function short(value) {
  for (const [unit, size] of [['M', 1e6], ['k', 1e3]]) {
    if (value >= size) return `${(value / size).toFixed(value >= 100 * size ? 0 : 1)} ${unit}`;
  }
  return String(Math.round(value));
}
