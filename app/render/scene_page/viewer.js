// The page around the drawing: a picture only when something has changed.
const byId = (id) => document.getElementById(id);
const kGrey = [150, 150, 150];
const kRest_ms = 250;  // the camera rests
const kInside = window !== window.parent;  // of another page

function say_trouble(text) {
  byId("trouble").textContent = text;
  byId("trouble").hidden = false;
  document.body.dataset.state = "failed";
}

function made(name, values = {}, ...children) {
  const element = Object.assign(document.createElement(name), values);
  element.append(...children);
  return element;
}

function save_as(name, blob) {
  const link = made("a", {href: URL.createObjectURL(blob), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

class Page {
  /** `live`: the program behind the page, null in a file that stands alone. */
  constructor(drawing, layer, live) {
    Object.assign(this, {drawing, layer, live, mode: "photo", points: [], views: []});
    this.camera = new OrbitCamera(this.facts);
    this.objects = new ObjectList(this);
    byId("title").textContent = document.title;
    byId("about").lastElementChild.append(...this.facts.about.map((line) => made("p", {textContent: line})));
    for (const mode of ["class", "entropy"]) byId(mode).hidden = !this.facts.labels;
    byId("legend").hidden = !this.facts.labels;
    byId("inside").parentElement.hidden = this.facts.eye === undefined;
    if (canvas.clientWidth < 600 || canvas.clientHeight < 600) byId("legend").open = false;
    this.list_classes();
    this.listen_buttons();
    this.listen_hand();
    this.listen_keys();
    this.listen_path();
    new ResizeObserver(() => this.fit()).observe(canvas);
    this.fit();
  }
  get facts() { return this.layer.facts; }

  /** Another mesh of the same scene. */
  replace(layer) {
    const old = this.layer;
    old.facts.classes.forEach((_, i) => layer.mark(layer.classes, i, old.classes.bytes[4 * i + 3]));
    if (JSON.stringify([old.facts.low, old.facts.high]) !== JSON.stringify([layer.facts.low, layer.facts.high]))
      this.camera.diagonal = distance(layer.facts.low, layer.facts.high);
    old.drop();
    this.layer = layer;
    this.objects.refresh();
    this.change();
  }

  list_classes() {
    const row = (name, color, label) => {
      const box = made("input", {type: "checkbox", checked: true});
      box.addEventListener("change", () => {
        this.layer.mark(this.layer.classes, label, box.checked ? kShown : kHidden);
        this.change();
      });
      const swatch = made("span");
      swatch.style.background = `rgb(${color})`;
      return made("li", {}, made("label", {}, box, swatch, name));
    };
    const rows = this.facts.classes.map((one, i) => row(one.name, one.color, i));
    byId("legend").lastElementChild.append(...rows, row("no class", kGrey, this.facts.classes.length));
  }
  /** Whether the legend or the list of objects hides something, which a rendered picture would show. */
  hides() { return document.querySelector("#legend input:not(:checked), #things input[type=checkbox]:not(:checked)") !== null; }

  /** A room has walls for the field: from outside, its mesh alone is open. */
  is_before_a_wall() {
    const {eye, low, high} = this.facts;
    const at = this.camera.world_from_camera().map((row) => row[3]);
    return eye !== undefined && at.some((v, i) => v < low[i] || v > high[i]);
  }

  set_mode(mode) {
    this.mode = mode;
    for (const button of byId("colors").children) button.setAttribute("aria-pressed", button.id === mode);
    this.change();
  }
  show_scale() {
    const [near, far] = this.camera.depths(), unit = this.facts.unit;
    const ends = {entropy: ["sure", "in doubt"], depth: [`${length_text(far, this.facts, 2)} ${unit}`, `${length_text(near, this.facts, 2)} ${unit}`]}[this.mode];
    byId("scale").hidden = ends === undefined;
    if (ends !== undefined) [byId("scale").firstElementChild.textContent, byId("scale").lastElementChild.textContent] = ends;
  }

  listen_buttons() {
    for (const button of byId("colors").children) button.addEventListener("click", () => this.set_mode(button.id));
    const picture = byId("scale").querySelector("canvas").getContext("2d");
    for (let i = 0; i < 256; ++i) {
      picture.fillStyle = `rgb(${this.drawing.ramp.bytes.slice(4 * i, 4 * i + 3)})`;
      picture.fillRect(i, 0, 1, 1);
    }
    const stand = (on, off, act) => byId(on).addEventListener("click", () => {
      byId(on).setAttribute("aria-pressed", "true");
      byId(off).setAttribute("aria-pressed", "false");
      act();
      this.change();
    });
    stand("outside", "inside", () => this.camera.outside());
    stand("inside", "outside", () => this.camera.inside());
  }

  listen_hand() {
    let last = [0, 0];
    followPointer(canvas, {
      down: (x, y) => { last = [x, y]; },
      draw: (x, y, event) => {
        this.camera[event.shiftKey ? "move" : "turn"](x - last[0], y - last[1]);
        last = [x, y];
        this.change();
      },
      up: (is_click, x, y, event) => { if (is_click) this.point(event.clientX, event.clientY, event.shiftKey); },
      pan: (dx, dy) => { this.camera.move(dx, dy); this.change(); },
      zoom: (factor) => { this.camera.closer(1 / factor); this.change(); },
      wheel_px: 500,
      scrolls: () => kInside && document.activeElement !== canvas,  // the page around it does
    });
    canvas.addEventListener("webglcontextlost", () => say_trouble("The graphics device was lost. Load the page again."));
  }

  listen_keys() {
    const pressed = new Set(), ways = {w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0]};
    let before = 0;
    const fly = (now) => {
      const step = Math.min(0.1, (now - before) / 1000) * 0.25;
      before = now;
      for (const key of pressed) this.camera.fly(...ways[key].map((v) => v * step));
      this.change();
      if (pressed.size > 0) requestAnimationFrame(fly);
    };
    canvas.addEventListener("keydown", (event) => {
      const act = {ArrowLeft: () => this.camera.turn(-20, 0), ArrowRight: () => this.camera.turn(20, 0), ArrowUp: () => this.camera.turn(0, -20),
        ArrowDown: () => this.camera.turn(0, 20), "+": () => this.camera.closer(0.9), "-": () => this.camera.closer(1.1),
        Escape: () => { this.points = []; this.objects.choose(0); }}[event.key];
      const flies = ways[event.key] !== undefined && !event.ctrlKey && !event.metaKey;
      if (act === undefined && !flies) return;
      event.preventDefault();
      if (act !== undefined) act();
      if (flies && pressed.size === 0) {
        before = performance.now();
        requestAnimationFrame(fly);
      }
      if (flies) pressed.add(event.key);
      this.change();
    });
    canvas.addEventListener("keyup", (event) => pressed.delete(event.key));
    canvas.addEventListener("blur", () => pressed.clear());
  }

  // ---- a picture, and a path of the camera

  /** The way through the views as states of the camera, `per_leg` from each to the next. */
  path(per_leg) {
    const out = this.views.slice(0, 1);
    for (let i = 1; i < this.views.length; ++i)
      for (let k = 1; k <= per_leg; ++k) out.push(between(this.views[i - 1], this.views[i], k / per_leg));
    return out;
  }
  /** world_from_camera by rows, a line for each picture, as `semfield render --trajectory` reads it. */
  path_text() {
    const now = this.camera.state();
    const rows = this.path(48).map((state) => Object.assign(this.camera, state).world_from_camera().flat());
    Object.assign(this.camera, now);
    return rows.map((row) => row.map((v) => v.toPrecision(9)).join(" ") + "\n").join("");
  }
  listen_path() {
    const tell = () => {
      const count = this.views.length;
      for (const id of ["play", "save-path"]) byId(id).disabled = count < 2;
      byId("clear").disabled = count === 0;
      byId("path-hint").textContent = count === 0 ? "Fly somewhere and add a view; do so again: the path leads through all of them."
        : `${count} view${count === 1 ? "" : "s"}, ${2 * (count - 1)} s`;
    };
    byId("picture").addEventListener("click", () => this.picture().then((blob) => save_as("semfield.png", blob)));
    byId("add-view").addEventListener("click", () => { this.views.push(this.camera.state()); tell(); });
    byId("clear").addEventListener("click", () => { this.views = []; tell(); });
    byId("save-path").addEventListener("click", () => save_as("path.txt", new Blob([this.path_text()])));
    byId("play").addEventListener("click", () => {
      const begin = performance.now(), states = this.path(120);
      const step = (now) => {
        const at = Math.min(states.length - 1, Math.floor((now - begin) * 0.06));
        Object.assign(this.camera, states[at], {target: [...states[at].target]});
        this.change();
        if (at < states.length - 1) requestAnimationFrame(step);
      };
      requestAnimationFrame(step);
    });
    tell();
  }
  /** What is seen, as a PNG: the mesh, or the rendered picture over it. */
  picture() {
    const both = made("canvas", {width: canvas.width, height: canvas.height}), context = both.getContext("2d");
    context.drawImage(canvas, 0, 0);
    if (!byId("still").hidden && byId("still").width > 0) context.drawImage(byId("still"), 0, 0, both.width, both.height);
    return new Promise((done) => both.toBlob(done, "image/png"));
  }

  // ---- drawing and reading

  fit() {
    const scale = Math.min(2, window.devicePixelRatio || 1);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
    this.change();
  }

  /** `same_picture`: the camera and the colours stay. */
  change(same_picture = false) {
    if (this.live) this.live.changed(same_picture);
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
      this.show_scale();
      this.mark();
    });
  }
  /** Lighter while the camera moves, where the whole takes long, and then whole. */
  draw() {
    const camera = JSON.stringify(this.camera.state()), light = this.drawing.slow && camera !== this.drawn_from;
    const what = [this.layer, kMode[this.mode], this.camera.matrices()];
    this.drawn_from = camera;
    this.layer.depth_range = this.camera.depths();
    clearTimeout(this.rest);
    if (!light) return this.drawing.draw_fine(...what);
    this.drawing.draw(...what, true);
    this.rest = setTimeout(() => this.draw(), kRest_ms);
  }

  /** What lies under a place of the window: {place, label, object}, or null. */
  read(client_x, client_y) {
    const box = canvas.getBoundingClientRect();
    const x = Math.floor((client_x - box.left) * canvas.width / box.width);
    const y = canvas.height - 1 - Math.floor((client_y - box.top) * canvas.height / box.height);
    const found = this.drawing.read(this.layer, this.camera.matrices(), x, y);
    if (found === null) return null;
    return {place: this.camera.unprojected(x + 0.5, y + 0.5, found[0] / 16777215), label: found[1], object: found[2]};
  }

  point(client_x, client_y, more) {
    const found = this.read(client_x, client_y);
    if (this.points.length === 2 || found === null) this.points = [];
    if (found !== null) this.points.push(found);
    this.objects.choose(found === null ? 0 : found.object, more);
    if (this.live && found !== null) this.live.ask_point(found);
    this.change(true);
  }

  mark() {
    const {clip} = this.camera.matrices();
    const on_screen = (p) => [(p[0] + 1) / 2 * canvas.clientWidth, (1 - p[1]) / 2 * canvas.clientHeight];
    const element = (name, values) => {
      const one = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(values)) one.setAttribute(key, value);
      return one;
    };
    const line = (a, b, kind) => {
      const [p, q] = [moved(clip, a), moved(clip, b)];
      if (p[3] <= 0 || q[3] <= 0) return [];
      const [[x1, y1], [x2, y2]] = [on_screen(p), on_screen(q)];
      return [element("line", {x1, y1, x2, y2, class: kind})];
    };
    const boxes = this.objects.edges().flatMap(([a, b]) => line(a, b, "box"));
    const seen = this.points.map(({place}) => moved(clip, place)).filter((p) => p[3] > 0).map(on_screen);
    const between_them = this.points.length === 2 ? line(this.points[0].place, this.points[1].place, "measure") : [];
    byId("marks").replaceChildren(...boxes, ...between_them, ...seen.map(([cx, cy]) => element("circle", {cx, cy, r: 5})));
    const {unit, labels, classes} = this.facts;
    const lines = this.points.map((point) => {
      const name = !labels ? "" : `${point.told ?? classes[point.label]?.name ?? "no class"} at `;
      return `${name}${point.place.map((v) => length_text(v, this.facts)).join(", ")} ${unit}`;
    });
    if (this.points.length === 2) lines.push(`distance ${length_text(distance(this.points[0].place, this.points[1].place), this.facts)} ${unit}`);
    byId("reading").textContent = lines.join("\n");
    byId("reading").hidden = lines.length === 0;
    this.objects.tell();
  }
}

async function open_page() {
  if (typeof DecompressionStream === "undefined") throw new Error("This browser is too old for this page: take one of 2023 or later.");
  const facts = JSON.parse(byId("facts").textContent), live = facts.live ? new Live() : null;
  document.body.classList.toggle("inside", kInside);
  const drawing = new Drawing(bytes_of(facts.ramp));
  const scene = live ? await live.scene(false) : {facts, mesh: unpacked(await inflated(bytes_of(byId("mesh").textContent)), facts)};
  byId("mesh").remove();
  window.semfield = new Page(drawing, new Layer(drawing, scene.facts, scene.mesh), live);
  if (live) live.begin(window.semfield);
  document.body.dataset.state = "ready";
}
open_page().catch((error) => say_trouble(error.message));
