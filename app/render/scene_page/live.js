// The program behind the page: meshes, pictures that the field itself renders while the camera rests, points, edits.
const kSizes = [240, 640, 1600];  // longest sides of rendered pictures, one after another

class Live {
  async ask(what, body, signal) {
    const answer = await fetch(what, body === undefined ? {signal} : {method: "POST", body: JSON.stringify(body), signal});
    if (answer.ok) return answer;
    const told = await answer.json().catch(() => ({error: `${answer.status}`}));
    throw new Error(told.remedy ? `${told.error}: ${told.remedy}` : told.error);
  }
  /** The run's mesh, coarse at first. */
  async scene(fine) {
    const bytes = await (await this.ask(`surface?fine=${fine ? 1 : 0}`)).arrayBuffer();
    const head = new DataView(bytes).getUint32(0, true);
    const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, head)));
    return {facts, mesh: unpacked(await inflated(new Uint8Array(bytes, 4 + head)), facts)};
  }
  /** The fine one, with the objects as they are after every edit that was made here meanwhile. */
  async fine_scene() {
    for (let tries = 0;; ++tries) {
      const scene = await this.scene(true), page = this.page;
      if (tries > 20 || (!page.objects.saving && (tries > 0 || scene.facts.state === page.facts.state))) return scene;
      await new Promise((done) => setTimeout(done, 100));
    }
  }

  begin(page) {
    this.page = page;
    this.fine_scene().then(({facts, mesh}) => {
      page.replace(new Layer(page.drawing, facts, mesh));
      document.body.dataset.mesh = "fine";
    }).catch((error) => this.note(error.message));
    setInterval(() => this.look(), 5000);
    this.changed();
  }
  note(text) { byId("about").lastElementChild.append(made("p", {textContent: text})); }

  // ---- pictures of the field

  changed(same_picture = false) {
    if (!this.page) return;
    if (same_picture) return this.show();
    if (this.pending) this.pending.abort();
    this.image = null;
    byId("still").hidden = true;
    document.body.dataset.still = "none";
    clearTimeout(this.rest);
    this.rest = setTimeout(() => this.render(), kRest_ms);
  }
  async render() {
    const page = this.page, longest = Math.max(canvas.width, canvas.height);
    if (page.hides() || document.hidden || page.is_before_a_wall()) return;
    const pending = this.pending = new AbortController();
    const rows = page.camera.world_from_camera();
    const camera = {position: rows.map((row) => row[3]), rotation: rows.flatMap((row) => row.slice(0, 3)), fov_deg: page.camera.fov_deg()};
    const [near, far] = page.camera.depths();
    try {
      for (const size of kSizes.filter((s) => s < longest).concat(Math.min(longest, kSizes.at(-1)))) {
        const scale = Math.min(1, size / longest);
        const wanted = {camera, width: Math.max(16, Math.round(scale * canvas.width)), height: Math.max(16, Math.round(scale * canvas.height)), map: page.mode, near, far};
        const image = await createImageBitmap(await (await this.ask("picture", wanted, pending.signal)).blob());
        if (pending.signal.aborted) return;
        this.image = image;
        this.show();
        document.body.dataset.still = String(Math.round(scale * canvas.width));
      }
    } catch (error) {
      if (error.name !== "AbortError") this.note(error.message);
    }
  }
  show() {
    const still = byId("still");
    if (!this.image) return;
    still.width = canvas.width;
    still.height = canvas.height;
    const context = still.getContext("2d");
    context.imageSmoothingQuality = "high";
    context.drawImage(this.image, 0, 0, still.width, still.height);
    still.hidden = false;
  }

  // ---- points, objects

  async ask_point(point) {
    try {
      const told = await (await this.ask("point", {at: point.place})).json();
      const sure = told.classes.slice(0, 2).map(({name, probability}) => `${name} ${probability.toFixed(2)}`).join(", ");
      if (sure) point.told = told.object ? `${told.object} (${sure})` : sure;
      this.page.change(true);
    } catch (error) {
      this.note(error.message);
    }
  }
  async edit(what) {
    const {facts} = this.page;
    const after = await (await this.ask("edit", {...what, made_on: facts.state, fine: facts.fine})).json();
    [facts.edits, facts.state] = [after.edits, after.state];
    return {...after, ids: new Uint16Array(bytes_of(after.ids).buffer)};
  }

  // ---- newer steps

  async look() {
    try {
      const state = await (await this.ask("state")).json();
      const is_newer = state.newest > this.page.facts.step;
      if (is_newer && !this.told_newer) this.note(`Step ${state.newest} is there: load the page again to see it.`);
      this.told_newer = is_newer;
    } catch {
      // the program has ended: what is here stays
    }
  }
}
