// The objects that were found: choose by a click, hide, count by class; where a program is behind the page, edit.
class ObjectList {
  constructor(page) {
    this.page = page;
    this.chosen = new Set();
    this.hidden = new Set();
    byId("edit").hidden = page.live === null;
    byId("rename").addEventListener("click", () => this.edit({do: "rename", object: this.only(), name: byId("name").value.trim()}));
    byId("name").addEventListener("keydown", (event) => { if (event.key === "Enter") byId("rename").click(); });
    byId("merge").addEventListener("click", () => this.edit({do: "merge", objects: [...this.chosen]}));
    byId("pieces").addEventListener("click", () => this.edit({do: "split", object: this.only()}));
    byId("cut").addEventListener("click", () => this.edit({do: "split", object: this.only(), at: page.points.map(({place}) => place)}));
    byId("plane").addEventListener("click", () => this.edit({do: "split", object: this.only(), plane: [...page.points.map(({place}) => place), page.camera.world_from_camera().map((row) => row[3])]}));
    byId("undo").addEventListener("click", () => this.edit({do: "undo"}));
    this.list();
  }
  get rows() { return this.page.facts.objects; }
  row(id) { return this.rows.find((one) => one.id === id); }
  only() { return [...this.chosen][0]; }

  /** Another table, after an edit. `ids` [vertices]. */
  set(objects, ids) {
    const {layer} = this.page;
    layer.facts.objects = objects;
    layer.set_objects(objects, ids);
    this.refresh();
  }
  /** After another table. */
  refresh() {
    for (const set of [this.chosen, this.hidden])
      for (const id of [...set]) if (!this.row(id)) set.delete(id);
    this.list();
    this.mark_all();
    this.page.change();
  }
  mark_all() {
    const {layer} = this.page;
    for (const {id} of this.rows) layer.mark(layer.things, id, this.hidden.has(id) ? kHidden : this.chosen.has(id) ? kChosen : kShown);
  }

  list() {
    byId("things").hidden = byId("object").hidden = this.rows.length === 0;
    byId("things").firstElementChild.textContent = `Objects (${this.rows.length})`;
    const groups = Map.groupBy ? Map.groupBy(this.rows, (one) => one.class)
      : this.rows.reduce((all, one) => all.set(one.class, [...(all.get(one.class) ?? []), one]), new Map());
    const open = new Set([...document.querySelectorAll("#things details[open]")].map((one) => one.dataset.class));
    const show = (rows, shown) => {
      for (const {id} of rows) shown ? this.hidden.delete(id) : this.hidden.add(id);
      this.mark_all();
      for (const box of document.querySelectorAll("#things input[data-id]")) box.checked = !this.hidden.has(Number(box.dataset.id));
      this.page.change();
    };
    const box_of = (rows, name) => {
      const box = made("input", {type: "checkbox", checked: rows.some(({id}) => !this.hidden.has(id)), ariaLabel: `show ${name}`});
      box.addEventListener("change", () => show(rows, box.checked));
      return box;
    };
    const items = [...groups].sort().map(([name, rows]) => {
      const list = made("ul", {}, ...rows.map((one) => {
        const box = box_of([one], one.name), swatch = made("span"), button = made("button", {textContent: one.name, className: "thing"});
        box.dataset.id = button.dataset.id = one.id;
        swatch.style.background = `rgb(${one.color})`;
        button.addEventListener("click", (event) => {
          this.choose(one.id, event.shiftKey);
          if (!event.shiftKey) this.page.camera.look_at(one.box.center, Math.max(...one.box.size));
          this.page.change();
        });
        return made("li", {className: "thing-row"}, box, swatch, button);
      }));
      const group = made("details", {open: open.has(name)}, made("summary", {}, box_of(rows, name), ` ${name} (${rows.length})`), list);
      group.dataset.class = name;
      return made("li", {}, group);
    });
    byId("things").lastElementChild.replaceChildren(...items);
  }

  /** 0: none. `more`: beside those that are chosen. */
  choose(id, more = false) {
    if (!more) this.chosen.clear();
    if (id > 0 && this.row(id)) more && this.chosen.has(id) ? this.chosen.delete(id) : this.chosen.add(id);
    byId("name").value = this.chosen.size === 1 ? this.row(this.only()).name : "";
    if (id > 0) byId("things").open = true;
    this.mark_all();
    for (const button of document.querySelectorAll("#things .thing")) button.ariaPressed = this.chosen.has(Number(button.dataset.id));
  }

  /** Edges of the boxes of those that are chosen, pairs of places. */
  edges() {
    const edges = [];
    for (const id of this.chosen) {
      const {center, axes, size} = this.row(id).box;
      const corner = (k) => [0, 1, 2].reduce((p, i) => add(p, axes[i], (k >> i & 1 ? 0.5 : -0.5) * size[i]), center);
      for (let k = 0; k < 8; ++k)
        for (let i = 0; i < 3; ++i) if (!(k >> i & 1)) edges.push([corner(k), corner(k | 1 << i)]);
    }
    return edges;
  }

  tell() {
    const {unit} = this.page.facts, rows = [...this.chosen].map((id) => this.row(id));
    byId("chosen").textContent = rows.map((one) => {
      const size = [...one.box.size].sort((a, b) => b - a).map((v) => length_text(v, this.page.facts, 1)).join(" x ");
      return `${one.name}: ${one.class} (${Math.round(100 * one.class_probability)} %), ${size} ${unit}, seen in ${one.views} views`;
    }).join("\n") || "Click an object, shift and click for several.";
    if (this.page.live === null) return;
    const one = this.chosen.size === 1, on_it = this.page.points.filter((point) => point.object === this.only()).length;
    for (const [id, works] of [["name", one], ["rename", one], ["merge", this.chosen.size > 1], ["pieces", one], ["cut", one && on_it === 2], ["plane", one && this.page.points.length === 2], ["undo", this.page.facts.edits > 0]])
      byId(id).disabled = !works;
  }

  /** What a person chooses and marks until the answer comes stays; an edit until then is refused, for it is of the objects before. */
  edit(what) {
    const hint = byId("edit-hint");
    if (this.saving) {
      hint.textContent = "Not saved: the edit before is being saved. Do it again.";
      return this.saving;
    }
    const {page} = this, points = [...page.points], chosen = String([...this.chosen]);
    hint.textContent = "Saving.";
    this.saving = page.live.edit(what).then(
      (after) => {
        const is_chosen = String([...this.chosen]) === chosen;
        if (is_chosen && (what.do === "undo" || what.do === "split")) this.chosen.clear();
        this.set(after.objects, after.ids);
        if (is_chosen && what.do === "merge") this.choose(what.objects[0]);
        hint.textContent = after.said;
        page.points = page.points.filter((point) => !points.includes(point));
        page.change();
      },
      (error) => { hint.textContent = error.message; }).finally(() => { this.saving = null; });
    return this.saving;
  }
}
