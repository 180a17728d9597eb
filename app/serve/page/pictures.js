// Photographs and overlays of views: fetched when a view is looked at, kept for the last few.
import {getBitmap, getPicture, photoAddress} from './api.js';
import {kRamp} from './dom.js';

const kKept = 16;
const kKeptLarge = 3;      // photographs larger than the view: some have many megapixels
const kLevels_px = [1024, 2048, 4096];

/// Longest side to request, so that a photograph shown `wanted_px` long is sharp: what the program has at hand for the view, a level, or
/// 0 for all that there is.
export function photoLevel(wanted_px, view_px) {
  if (wanted_px <= view_px) return view_px;
  return kLevels_px.find((level) => level >= wanted_px && level > view_px) ?? 0;
}
const isLess = (level, other) => level !== 0 && (other === 0 || level < other);

/// Keeps what was used last; what was used longest ago is forgotten.
function remember(kept, key, value, most) {
  kept.delete(key);
  kept.set(key, value);
  if (kept.size > most) kept.delete(kept.keys().next().value);
}

/// The grey picture of entropy in colours.
export function entropyCanvas(bitmap) {
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = canvas.getContext('2d', {willReadFrequently: true});
  context.drawImage(bitmap, 0, 0);
  const image = context.getImageData(0, 0, bitmap.width, bitmap.height);
  for (let i = 0; i < image.data.length; i += 4) image.data.set(kRamp[image.data[i]], i);
  context.putImageData(image, 0, 0);
  return canvas;
}

export class Pictures {
  constructor({changed, messages}, client) {
    Object.assign(this, {changed, messages, client, photos: new Map(), large: new Map(), overlays: new Map()});
    this.wished = null;
    this.next = null;      // the newest wish takes the place of one that waits
    this.isAsking = false;
  }

  /// The best photograph of the view that is there, or null; one that is sharp when it is shown `wanted_px` long is fetched.
  /// name: of the photograph, which is another when the scene was changed and the program started again.
  photo(view, name, view_px, wanted_px) {
    const small = this.fetched(this.photos, kKept, view, name, view_px);
    const level = photoLevel(wanted_px, view_px);
    const large = level === view_px ? this.large.get(view) : this.fetched(this.large, kKeptLarge, view, name, level);
    return (large?.name === name ? large.bitmap : null) ?? small.bitmap;
  }

  /// {bitmap, level}: of a photograph at this level or a higher one; a lower one until it comes.
  fetched(kept, most, view, name, level) {
    const before = kept.get(view);
    const entry = before?.name === name ? before : {name, bitmap: null, level: undefined, coming: undefined};
    const has = entry.level !== undefined && !isLess(entry.level, level);
    const comes = entry.coming !== undefined && !isLess(entry.coming, level);
    remember(kept, view, entry, most);
    if (has || comes || entry.isAll || entry.rests) return entry;
    entry.coming = level;
    getBitmap(photoAddress(view, name, level)).then((bitmap) => {
      if (isLess(level, entry.level)) return;
      entry.bitmap?.close();
      Object.assign(entry, {bitmap, level, isAll: level === 0 || Math.max(bitmap.width, bitmap.height) < level});
      this.changed();
    }, (error) => {
      entry.coming = undefined;
      entry.rests = true;
      if (error.status !== 400) setTimeout(() => { entry.rests = false; this.changed(); }, 3000);
      this.messages.wrong(error);
    });
    return entry;
  }

  /// {labels, entropy, color, revision, events that the labels know at least...} of the view, or null; older than the newest while that is fetched.
  overlay(view) { return this.overlays.get(view) ?? null; }

  /// Everything may be another: the program was started anew.
  forget() {
    for (const entry of this.overlays.values()) Object.assign(entry, {revision: -1, entropyRevision: -1, colorRevision: -1});
    this.wished = null;
  }

  /// Asks for what is missing or old. wish: {view, entropy, color}; `revision` and `events` of the newest label maps; `pause_ms` between renderings.
  want({view, entropy, color}, {revision, events}, pause_ms) {
    const entry = this.overlays.get(view);
    const fresh = (at) => at !== undefined && at >= revision;
    const rested = performance.now() - (entry?.colored_ms ?? -Infinity) > pause_ms;
    const needsColor = color && (!entry?.color || (!fresh(entry.colorRevision) && rested));
    if (entry && fresh(entry.revision) && (!entropy || fresh(entry.entropyRevision)) && !needsColor) return;
    const key = `${view} ${entropy} ${needsColor} ${revision}`;
    if (this.wished === key) return;
    this.wished = key;
    this.next = {key, events, request: {client: this.client, view, labels: true, entropy, color: needsColor}};
    if (!this.isAsking) this.ask();
  }

  /// One request after the other.
  async ask() {
    this.isAsking = true;
    while (this.next) {
      const {key, events, request} = this.next;
      this.next = null;
      try {
        this.took(request.view, events, await getPicture(request));
      } catch (error) {
        setTimeout(() => { if (this.wished === key) { this.wished = null; this.changed(); } }, 1000);
        this.messages.wrong(error);
      }
    }
    this.isAsking = false;
  }

  took(view, events, picture) {
    this.wished = null;
    if (!picture.stale) {
      const entry = this.overlays.get(view) ?? {};
      const revision = picture.overlay_revision;
      Object.assign(entry, {revision, events, labels: picture.labels ?? entry.labels ?? null, marks: picture.marks, width: picture.width});
      if (picture.entropy) Object.assign(entry, {entropy: entropyCanvas(picture.entropy), entropyRevision: revision});
      if (picture.color) Object.assign(entry, {color: picture.color, colorRevision: revision, colored_ms: performance.now()});
      entry.version = (entry.version ?? 0) + 1;
      remember(this.overlays, view, entry, kKept);
    }
    this.changed();
  }
}
