// The objects that were found: choose by a click, hide, count by class; where a program is behind the page, edit.
import {add} from './camera.js';
import {byId, make, onClick, setAttribute, setText, swatch} from './dom.js';
import {kChosen, kHidden, kShown, lengthText} from './drawing.js';

export class ObjectList {
  constructor(page) {
    this.page = page;
    this.chosen = new Set();
    this.hidden = new Set();
    byId('edit').hidden = !page.isLive;
    for (const id of Object.keys(this.edits)) onClick(id, () => this.edit(this.edits[id][1]));
    byId('name').addEventListener('keydown', (event) => { if (event.key === 'Enter') byId('rename').click(); });
    this.list();
  }

  /// By the ids of buttons: whether it can be done now, and what the program is asked for.
  get edits() {
    const {points, camera, facts} = this.page;
    const [isOne, object, places] = [this.chosen.size === 1, this.only, points.map(({place}) => place)];
    return {
      rename: [isOne, {do: 'rename', object, name: byId('name').value.trim()}],
      merge: [this.chosen.size > 1, {do: 'merge', objects: [...this.chosen]}],
      pieces: [isOne, {do: 'split', object}],
      cut: [isOne && points.filter((point) => point.object === object).length === 2, {do: 'split', object, at: places}],
      plane: [isOne && points.length === 2, {do: 'split', object, plane: [...places, camera.place]}],
      undo: [facts.edits > 0, {do: 'undo'}],
    };
  }

  get rows() { return this.page.facts.objects; }
  row(id) { return this.rows.find((one) => one.id === id); }
  get only() { return [...this.chosen][0]; }

  /// Another table, after an edit. ids: of each vertex.
  set(objects, ids) {
    const {layer} = this.page;
    layer.facts.objects = objects;
    layer.setObjects(objects, ids);
    this.refresh();
  }

  /// After another table.
  refresh() {
    for (const set of [this.chosen, this.hidden]) for (const id of [...set]) if (!this.row(id)) set.delete(id);
    this.list();
    this.markAll();
    this.page.changed();
  }

  markAll() {
    const {layer} = this.page;
    for (const {id} of this.rows) layer.mark(layer.things, id, this.hidden.has(id) ? kHidden : this.chosen.has(id) ? kChosen : kShown);
  }

  list() {
    for (const id of ['things', 'object']) byId(id).hidden = this.rows.length === 0;
    byId('things').firstElementChild.textContent = `Objects (${this.rows.length})`;
    const groups = new Map();
    for (const one of this.rows) groups.set(one.class, [...(groups.get(one.class) ?? []), one]);
    const open = new Set([...document.querySelectorAll('#things details[open]')].map((one) => one.dataset.class));
    const boxOf = (rows, name, id) => make('input', {
      type: 'checkbox', checked: rows.some((one) => !this.hidden.has(one.id)), 'aria-label': `show ${name}`, 'data-id': id,
      onchange: ({target}) => this.show(rows, target.checked),
    });
    const items = [...groups].sort().map(([name, rows]) => {
      const list = rows.map((one) => make('li', {}, boxOf([one], one.name, one.id), swatch(one.color), make('button', {
        class: 'thing', 'data-id': one.id, onclick: (event) => {
          this.choose(one.id, event.shiftKey);
          if (!event.shiftKey) this.page.camera.lookAt(one.box.center, Math.max(...one.box.size));
          this.page.changed();
        }}, one.name)));
      return make('li', {}, make('details', {open: open.has(name), 'data-class': name},
        make('summary', {}, boxOf(rows, name), ` ${name} (${rows.length})`), make('ul', {}, ...list)));
    });
    byId('things').lastElementChild.replaceChildren(...items);
  }

  show(rows, isShown) {
    for (const {id} of rows) this.hidden[isShown ? 'delete' : 'add'](id);
    this.markAll();
    for (const box of document.querySelectorAll('#things input[data-id]')) box.checked = !this.hidden.has(Number(box.dataset.id));
    this.page.changed();
  }

  /// 0: none. more: beside those that are chosen.
  choose(id, more = false) {
    if (!more) this.chosen.clear();
    if (id > 0 && this.row(id)) this.chosen[more && this.chosen.has(id) ? 'delete' : 'add'](id);
    byId('name').value = this.chosen.size === 1 ? this.row(this.only).name : '';
    if (id > 0) byId('things').open = true;
    this.markAll();
    for (const button of document.querySelectorAll('#things .thing')) setAttribute(button, 'aria-pressed', this.chosen.has(Number(button.dataset.id)));
  }

  /// Edges of the boxes of those that are chosen, pairs of places.
  edges() {
    const edges = [];
    for (const id of this.chosen) {
      const {center, axes, size} = this.row(id).box;
      const corner = (k) => [0, 1, 2].reduce((p, i) => add(p, axes[i], (k >> i & 1 ? 0.5 : -0.5) * size[i]), center);
      for (let k = 0; k < 8; ++k) {
        for (let i = 0; i < 3; ++i) if (!(k >> i & 1)) edges.push([corner(k), corner(k | 1 << i)]);
      }
    }
    return edges;
  }

  tell() {
    const {facts} = this.page;
    setText(byId('chosen'), [...this.chosen].map((id) => this.row(id)).map((one) => {
      const size = [...one.box.size].sort((a, b) => b - a).map((v) => lengthText(v, facts, 1)).join(' x ');
      return `${one.name}: ${one.class} (${Math.round(100 * one.class_probability)} %), ${size} ${facts.unit}, seen in ${one.views} views`;
    }).join('\n') || 'Click an object, shift and click for several.');
    for (const [id, [can]] of Object.entries(this.edits)) byId(id).disabled = !can;
    byId('name').disabled = this.chosen.size !== 1;
  }

  /// What a person chooses and marks until the answer comes stays; an edit until then is refused, for it is of the objects before.
  edit(what) {
    const hint = byId('edit-hint');
    if (this.saving) {
      hint.textContent = 'Not saved: the edit before is being saved. Do it again.';
      return this.saving;
    }
    const {page} = this;
    const points = [...page.points];
    const chosen = String([...this.chosen]);
    hint.textContent = 'Saving.';
    this.saving = page.live.edit(what).then(
      (after) => {
        const isChosen = String([...this.chosen]) === chosen;
        if (isChosen && (what.do === 'undo' || what.do === 'split')) this.chosen.clear();
        this.set(after.objects, after.ids);
        if (isChosen && what.do === 'merge') this.choose(what.objects[0]);
        hint.textContent = after.said;
        page.points = page.points.filter((point) => !points.includes(point));
        page.changed();
      },
      (error) => { hint.textContent = error.inWords ?? error.message; }).finally(() => { this.saving = null; });
    return this.saving;
  }
}
