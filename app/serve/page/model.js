// What is shown: the program's state with the events on top that it does not know yet. Pure.
import {freeColor, seenOnWhite} from './dom.js';

/// The state with what a newer answer brings, which leaves out what the page has; `state` null: before the first.
export function merged(state, answer) {
  const {marks_kept, ...news} = answer;
  const next = {...state, ...news};
  if (state && news.views) {
    next.views = [...state.views];
    for (const {index, ...changes} of news.views) next.views[index] = {...next.views[index], ...changes};
  }
  if (state && news.marks) next.marks = [...state.marks.slice(0, marks_kept), ...news.marks];
  return next;
}

/// The name by which events say that a region is ignored: one that means "no class" to the program, and that no class has.
export const ignoreName = (classes) => ['void', 'undefined', 'unlabelled'].find((name) => !classes.some((row) => row.name === name));
/// What stands for it on the page.
export const kIgnore = {index: -1, label: 'ignore', color: [150, 150, 150], isIgnore: true};

/// Classes and marks as they will be when every pending event is known. Pending: [{event}], in order; an event's undo hides it.
/// classes: [{index, name, color, clicks, area_share, confidence, own, saved}], index -1 while the program has not named it;
/// marks: [{id, view, points, radius, fill, object, name, label, color, isIgnore, saved}], points in pixels of the view, label: the name to show.
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

  // `given`: the colour that the program's label pictures have.
  const classes = state.classes.map((row) => ({...row, color: row.own ? seenOnWhite(row.color) : row.color, given: row.color, saved: true}));
  const ignore = {...kIgnore, name: ignoreName(classes)};
  const byIndex = new Map(classes.map((row) => [row.index, row]));
  const byName = new Map(classes.map((row) => [row.name, row]));  // as events name them, one after the other
  const named = new Map();                                        // rows of clicks that are pending
  const end = (name, into) => {
    const row = byName.get(name);
    if (!row || into === undefined) return;
    classes.splice(classes.indexOf(row), 1);
    byName.delete(name);
    row.into = into;  // another row, or null: deleted
  };
  for (const event of alive) {
    if (event.type === 'class' && !byName.has(event.name)) {
      const color = event.color ?? freeColor(classes.map((row) => row.color));
      classes.push({index: -1, name: event.name, color, clicks: 0, area_share: 0, confidence: 0, saved: false});
      byName.set(event.name, classes.at(-1));
    }
    if (event.type === 'merge') end(event.class, byName.get(event.into));
    if (event.type === 'delete') end(event.class, null);
    if (event.type === 'rename' && byName.has(event.class)) {
      const row = byName.get(event.class);
      byName.delete(event.class);
      Object.assign(row, {name: event.name, color: event.color ?? row.color, saved: false});
      byName.set(event.name, row);
    }
    if (event.type === 'click') named.set(event.id, byName.get(event.class) ?? (event.class === ignore.name ? ignore : {name: event.class, color: kIgnore.color}));
  }
  const last = (row) => {
    let now = row;
    while (now && now.into !== undefined) now = now.into;
    return now;
  };
  const shown = ({name, label, color, isIgnore}) => ({name, label: label ?? name, color, isIgnore: Boolean(isIgnore)});
  const marks = [];
  for (const mark of state.marks) {
    const row = mark.class < 0 ? ignore : last(byIndex.get(mark.class));
    if (!undone.has(mark.id) && row) marks.push({...mark, ...shown(row), saved: true});
  }
  const known = new Set(state.marks.map((mark) => mark.id));
  const viewOf = new Map(state.views.map((view, i) => [view.frame, i]));
  for (const event of alive) {
    if (event.type !== 'click' || known.has(event.id) || !viewOf.has(event.frame)) continue;
    const row = last(named.get(event.id));
    const view = viewOf.get(event.frame);
    const share = event.size ? state.views[view].width / event.size[0] : 1;
    if (row) marks.push({id: event.id, view, points: event.points.map((p) => p.map((v) => v * share)), radius: event.radius * share, fill: Boolean(event.fill), object: event.object ?? 0, ...shown(row), saved: false});
  }
  ignore.clicks = marks.filter(({isIgnore}) => isIgnore).length;
  for (const row of classes) row.clicks = marks.filter(({name, isIgnore}) => !isIgnore && name === row.name).length;
  return {classes, marks, ignore};
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
  const last = (a, b) => Boolean(views[a].held_out) - Boolean(views[b].held_out);  // they ask for no clicks
  if (order === 'uncertain') all.sort((a, b) => last(a, b) || views[b].entropy - views[a].entropy || a - b);
  if (order === 'few') all.sort((a, b) => last(a, b) || views[a].clicks - views[b].clicks || views[b].entropy - views[a].entropy || a - b);
  return all;
}

const kDigits = 100;  // a photograph may have many pixels for one of the view
const rounded = (point) => point.map((v) => Math.round(v * kDigits) / kDigits);

/// Where a point (x, y) lies from the polyline `points`.
export function distanceTo(points, x, y) {
  let least = Math.hypot(points[0][0] - x, points[0][1] - y);
  for (let i = 1; i < points.length; ++i) {
    const [[ax, ay], [bx, by]] = [points[i - 1], points[i]];
    const [dx, dy] = [bx - ax, by - ay];
    const t = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / Math.max(1e-12, dx * dx + dy * dy)));
    least = Math.min(least, Math.hypot(ax + t * dx - x, ay + t * dy - y));
  }
  return least;
}

/// Whether the closed outline holds a point, by the even-odd rule.
export function isWithin(outline, x, y) {
  let isIn = false;
  outline.forEach(([bx, by], i) => {
    const [ax, ay] = outline.at(i - 1);
    if ((ay > y) !== (by > y) && x < ax + ((y - ay) / (by - ay)) * (bx - ax)) isIn = !isIn;
  });
  return isIn;
}

/// The latest mark that covers a point, or comes nearer than `slack`; a mark's first point counts before all others. Or null.
export function markAt(marks, [x, y], slack) {
  const first = ({points: [[px, py]]}) => Math.hypot(px - x, py - y);
  const heads = marks.filter((mark) => first(mark) < slack);
  if (heads.length) return heads.reduce((best, mark) => (first(mark) <= first(best) ? mark : best));
  return marks.findLast(({points, radius, fill}) => (fill ? isWithin(points, x, y) : distanceTo(points, x, y) < Math.max(radius, slack / 2))) ?? null;
}

/// An outline of at most `most` corners, rounded, without corners nearer than `step` to the one before.
export function outlineCorners(points, step, most = 4096) {
  const kept = points.filter((p, i) => i === 0 || Math.hypot(p[0] - points[i - 1][0], p[1] - points[i - 1][1]) >= step);
  const every = Math.ceil(kept.length / most);
  return kept.filter((_, i) => i % every === 0).map(rounded);
}

/// Events of one stroke in parts of at most `most` points that share their ends, rounded to a hundredth of a pixel and without
/// points that lie nearer than `step` to the one before.
export function strokeParts(points, step, most = 4096) {
  const kept = [];
  for (const [i, point] of points.entries()) {
    const last = kept.at(-1);
    if (last && i + 1 < points.length && Math.hypot(point[0] - last[0], point[1] - last[1]) < step) continue;
    kept.push(rounded(point));
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
  unseen: 'every click is far from it',
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
