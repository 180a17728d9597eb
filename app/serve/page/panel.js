// The right side: classes, exports and notes; and the line at the foot.
import {cssColor} from './colors.js';
import {byId, make, setAttribute, setStyle, setText} from './dom.js';
import {duration, short} from './model.js';
import {Plots} from './plots.js';

const kWords = {labels: 'Label images', coco: 'COCO', mesh: 'Mesh'};
const percent = (share) => (share >= 0.0995 ? `${Math.round(100 * share)}` : (100 * share).toFixed(1));

export class Panel {
  /// calls: choose(name), ignore(), rename(row), point(name or null), export(what).
  constructor(calls) {
    this.calls = calls;
    this.plots = new Plots(byId('plots'));
    this.rows = [];
    for (const button of document.querySelectorAll('#exports button')) {
      button.addEventListener('click', () => calls.export(button.dataset.what));
    }
    byId('ignore').addEventListener('click', () => calls.ignore());
    byId('classes').addEventListener('keydown', (event) => {
      const step = {ArrowDown: 1, ArrowUp: -1}[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      const at = this.rows.findIndex(({item}) => item === document.activeElement);
      const row = this.rows[Math.min(Math.max(at + step, 0), this.rows.length - 1)];
      row.item.focus();
      calls.choose(row.shown.name);
    });
  }

  addRow() {
    const row = {shown: null};
    const parts = ['key', 'swatch', 'name', 'clicks', 'area', 'sure'].map((name) => make('span', {class: name}));
    [row.key, row.swatch, row.name, row.clicks, row.area, row.sure] = parts;
    row.item = make('button', {
      role: 'radio',
      onclick: () => this.calls.choose(row.shown.name),
      ondblclick: () => this.calls.rename(row.shown),
      onpointerenter: () => this.calls.point(row.shown.name),
      onpointerleave: () => this.calls.point(null),
    }, ...parts);
    this.rows.push(row);
    byId('classes').append(row.item);
  }

  /// keys: digit of a class's name, or none; ignore: the row of what is ignored.
  updateClasses(classes, ignore, chosen, keys, room) {
    setAttribute(byId('ignore'), 'aria-pressed', chosen === ignore.name);
    setText(byId('ignore').querySelector('.clicks'), ignore.clicks ? String(ignore.clicks) : '');
    while (this.rows.length < classes.length) this.addRow();
    while (this.rows.length > classes.length) this.rows.pop().item.remove();
    const hasChosen = classes.some(({name}) => name === chosen);
    classes.forEach((shown, i) => {
      const row = this.rows[i];
      row.shown = shown;
      const key = keys.get(shown.name) ?? '';
      setText(row.key, key);
      setStyle(row.swatch, '--color', cssColor(shown.color));
      setText(row.name, shown.name);
      setText(row.clicks, shown.clicks ? String(shown.clicks) : '');
      setText(row.area, shown.area_share > 0 ? `${percent(shown.area_share)} %` : '');
      setText(row.sure, shown.area_share > 0 ? `${Math.round(100 * shown.confidence)} %` : '');
      setAttribute(row.item, 'aria-checked', shown.name === chosen);
      setAttribute(row.item, 'tabindex', shown.name === chosen || (!hasChosen && i === 0) ? 0 : -1);
      const told = shown.saved ? '' : ', not saved yet';
      setAttribute(row.item, 'aria-label', `${shown.name}${key ? `, key ${key}` : ''}, ${shown.clicks} clicks, ${percent(shown.area_share)} % of the area, ` +
        `${Math.round(100 * shown.confidence)} % sure${told}`);
      setAttribute(row.item, 'title', `${shown.name}${told}: click to choose, double click to rename, merge or delete`);
      row.item.classList.toggle('unsaved', !shown.saved);
    });
    setText(byId('room'), `${classes.length} of ${room.most}`);
    setAttribute(byId('room'), 'title', `This run has room for ${room.most} classes`);
    byId('new-class').disabled = classes.length >= room.most;
  }

  updateRun(state) {
    this.plots.update(state.history);
    this.updateExports(state.exports ?? []);
    const notes = byId('notes');
    const told = (state.notes ?? []).join('\n');
    notes.hidden = !told;
    if (this.told !== told) {
      this.told = told;
      notes.replaceChildren(make('header', {}, make('h2', {}, 'Notes')), ...(state.notes ?? []).slice(-5).map((note) => make('p', {}, note)));
    }
    const {run} = state;
    const parts = [run.name, run.phase, `step ${run.step.toLocaleString('en')}`, duration(run.train_s), `${short(run.rays_per_s)} rays/s`, run.device];
    setText(byId('run-line'), parts.filter(Boolean).join('  ·  '));
    setAttribute(byId('run-line'), 'title', run.folder);
  }

  updateExports(exports) {
    const told = JSON.stringify(exports);
    if (this.exports === told) return;
    this.exports = told;
    byId('export-list').replaceChildren(...exports.toReversed().map(({id, what, state, text, files}) => {
      const links = (files ?? []).map((name, n) => make('a', {href: `./export/${encodeURIComponent(id)}/${n}`, download: name.split('/').at(-1)}, name));
      const many = links.length > 3;
      const list = make('div', {class: 'files'}, ...links);
      const body = many ? make('details', {}, make('summary', {}, `${links.length} files`), list) : list;
      const open = state === 'waiting' || state === 'running';
      const cancel = open ? make('button', {title: `Cancel the export ${id}`}, 'Cancel') : null;
      cancel?.addEventListener('click', () => { cancel.disabled = true; this.calls.cancelExport(id); });
      return make('div', {class: `export ${state}`}, make('p', {}, make('b', {}, `${kWords[what] ?? what}: ${state}`), text ? ` ${text}` : ''),
                  ...(state === 'running' ? [progressOf(text, `${kWords[what] ?? what} is being written`)] : []), ...(open ? [cancel] : []), ...(links.length ? [body] : []));
    }));
  }
}

/// A bar as long as the "3/35" in what the program says of its progress.
function progressOf(text, label) {
  const [, done, all] = /(\d+)\/(\d+)/.exec(text) ?? [];
  return make('progress', {'aria-label': label, ...(all ? {value: done, max: all} : {})});
}

/// What the program says begins small and ends open.
const sentence = (text) => (text ? text[0].toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? '' : '.') : '');

/// Messages over the canvas: errors stay until they are closed, others go after a while.
export class Messages {
  constructor() { this.list = byId('messages'); }

  tell(text) {
    this.list.querySelector('.word')?.remove();
    const message = make('div', {class: 'word'}, text);
    this.list.append(message);
    setTimeout(() => message.remove(), 3500);
  }

  /// All is saved: messages about saving are over.
  settled() {
    for (const message of this.list.querySelectorAll('.passes')) message.remove();
  }

  /// One message under a name, for as long as `what` says something.
  hold(name, what, remedy) {
    const shown = this.list.querySelector(`[data-name="${name}"]`);
    if (shown?.dataset.text === what || (!shown && !what)) return;
    shown?.remove();
    if (what) this.list.append(make('div', {class: 'error', role: 'alert', 'data-name': name, 'data-text': what}, make('p', {}, make('b', {}, sentence(what)), ` ${sentence(remedy)}`)));
  }

  refuse(what, remedy, passes = false) {
    const text = `${sentence(what)} ${sentence(remedy)}`;
    for (const other of this.list.querySelectorAll('.error')) if (other.dataset.text === text) return;
    while (this.list.querySelectorAll('.error').length > 2) this.list.querySelector('.error').remove();
    const close = make('button', {'aria-label': 'Close the message', onclick: () => message.remove()}, 'Close');
    const message = make('div', {class: passes ? 'error passes' : 'error', role: 'alert', 'data-text': text},
                         make('p', {}, make('b', {}, sentence(what)), ` ${sentence(remedy)}`), close);
    this.list.append(message);
  }
}
