// The program behind the viewer: meshes, pictures that the field itself renders while the camera rests, points, edits.
import {getScene, postBitmap, postJson} from './api.js';
import {byId} from './dom.js';
import {Layer, bytesOf, inflated, unpacked} from './drawing.js';

const kSizes_px = [240, 640, 1600];  // longest sides of rendered pictures, one after another
const kRest_ms = 250;                // the camera rests

/// The run with a mesh: 0 none, which is there at once, 1 a coarse one, 2 a fine one.
export async function liveScene(number) {
  const {facts, mesh} = await getScene(number);
  return {facts, mesh: unpacked(await inflated(mesh), facts)};
}

export class Live {
  constructor(page) {
    this.page = page;
    this.loadMeshes().catch((error) => this.refuse(error));
    page.followProgram();
    this.drop(0);
  }

  refuse({message, remedy}) { this.page.messages.refuse(message, remedy); }

  async loadMeshes() {
    for (const [number, name] of [[1, 'coarse'], [2, 'fine']]) {
      const {facts, mesh} = await this.scene(number);
      this.page.replace(new Layer(this.page.drawing, facts, mesh));
      document.body.dataset.mesh = name;
    }
  }

  /// A mesh, with the objects as they are after every edit that was made here meanwhile.
  async scene(number) {
    for (let tries = 0;; ++tries) {
      const scene = await liveScene(number);
      const {objects, facts} = this.page;
      if (tries > 20 || (!objects.saving && (tries > 0 || scene.facts.state === facts.state))) return scene;
      await new Promise((resolve) => setTimeout(resolve, 100));
    }
  }

  /// The picture is of another view or in other colours: a new one comes when the camera rests.
  drop(rest_ms = kRest_ms) {
    this.pending?.abort();
    this.image = null;
    byId('still').hidden = true;
    document.body.dataset.still = 'none';
    clearTimeout(this.rest);
    this.rest = setTimeout(() => this.render(), rest_ms);
  }

  async render() {
    const {page} = this;
    const {canvas, camera, mode} = page;
    const still = byId('still');
    const longest = Math.max(canvas.width, canvas.height);
    if (page.hides() || document.hidden || page.isBeforeAWall()) return;
    const pending = this.pending = new AbortController();
    const rows = camera.worldFromCamera();
    const from = {position: rows.map((row) => row[3]), rotation: rows.flatMap((row) => row.slice(0, 3)), fov_deg: camera.fovDeg()};
    try {
      for (const size of kSizes_px.filter((s) => s < longest).concat(Math.min(longest, kSizes_px.at(-1)))) {
        const [width, height] = [canvas.width, canvas.height].map((side) => Math.max(16, Math.round(Math.min(1, size / longest) * side)));
        const image = await postBitmap('./picture', {camera: from, width, height, map: mode, range: page.range()}, pending.signal);
        if (pending.signal.aborted) return;
        this.image = image;
        Object.assign(still, {width: canvas.width, height: canvas.height, hidden: false});
        const context = still.getContext('2d');
        context.imageSmoothingQuality = 'high';
        context.drawImage(image, 0, 0, still.width, still.height);
        document.body.dataset.still = String(width);
      }
    } catch (error) {
      if (!pending.signal.aborted && error.status !== 0) this.refuse(error);  // without a connection another line says so
    }
  }

  async askPoint(point) {
    try {
      const told = await postJson('./point', {at: point.place});
      const sure = told.classes.slice(0, 2).map(({name, probability}) => `${name} ${probability.toFixed(2)}`).join(', ');
      if (sure) point.told = told.object ? `${told.object} (${sure})` : sure;
      this.page.redraw();
    } catch (error) {
      this.refuse(error);
    }
  }

  async edit(what) {
    const {facts} = this.page;
    const after = await postJson('./edit', {...what, made_on: facts.state, mesh: facts.mesh});
    Object.assign(facts, {edits: after.edits, state: after.state});
    return {...after, ids: new Uint16Array(bytesOf(after.ids).buffer)};
  }
}
